#![allow(clippy::unwrap_used, clippy::panic, reason = "a failed test should panic")]

use std::path::Path;

use pliant_stream::watch::{BodyDecoder, coordinate_steps};
use tokio::sync::mpsc::Receiver;

use super::*;

const STEP: f64 = 1.0 / 60.0;

fn pip() -> Arc<ModalModel> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
    Arc::new(ModalModel::read(file).unwrap())
}

/// What a host publishes into a queue of this length, which nobody empties by itself.
fn watch(length: usize) -> (HostWatch, Receiver<Item>) {
    let (queue, items) = channel(length);
    let mut options = PublishOptions::new(RelayOptions::new("https://relay.example/", "a"));
    options.bodies.rate = 60.0;
    (HostWatch::with_queue(options, STEP, queue, Arc::default()).unwrap(), items)
}

/// A tick with these bodies, which swing.
fn tick(watch: &mut HostWatch, tick: Tick, bodies: &[u16], model: &Arc<ModalModel>) {
    let q = [1e-3 * (tick as f64).sin(); 30];
    let state = TickState { tick, q: &q, v: &[], a: &[], z: &[], pose: None, grabs: &[], resting: false };
    for &id in bodies {
        let (placement, view) = (Placement::default(), None);
        let (id, name, warps) = (BodyId(id), "pip", true);
        watch.body(&Seen { id, name, model, warps, placement, view, state: &state });
    }
    watch.finish(tick, WatchNumbers::default());
}

/// While nobody carries anything away, nothing waits and nothing grows: frames are dropped and
/// counted, and each body goes on with a snapshot.
#[test]
fn what_the_thread_has_no_room_for_is_dropped_and_counted() {
    let (mut watch, mut items) = watch(8);
    let model = pip();
    for at in 1..=100 {
        tick(&mut watch, at, &[1, 2], &model);
    }
    let stats = watch.stats();
    let sent = std::iter::from_fn(|| items.try_recv().ok()).count() as u64;
    assert_eq!(sent, 8);
    // Two bodies and the hands a tick, and the catalog until it is sent; two models went with it.
    assert_eq!(stats.frames, sent - 2);
    assert!(stats.dropped >= 3 * 100 - sent, "{stats:?}");
    tick(&mut watch, 101, &[1, 2], &model);
    let mut begun = Vec::new();
    while let Ok(item) = items.try_recv() {
        match item {
            Item::Frame(id, 101, begins, _) => begun.push((id.0, begins)),
            Item::Frame(_, at, ..) => panic!("a frame of tick {at}"),
            _ => {}
        }
    }
    assert_eq!(begun, [(1, true), (2, true)]);
    tick(&mut watch, 102, &[1, 2], &model);
    let sent = std::iter::from_fn(|| items.try_recv().ok());
    assert_eq!(sent.filter(|item| matches!(item, Item::Frame(_, 102, false, _))).count(), 2);
}

/// The end of a body waits for room. Another one with its model may come meanwhile, and keeps it;
/// and one with its number comes after it.
#[test]
fn the_end_of_a_body_takes_nothing_from_one_that_came_after() {
    let (mut watch, mut items) = watch(4);
    let model = pip();
    tick(&mut watch, 1, &[1], &model);
    let announced = std::iter::from_fn(|| items.try_recv().ok()).count();
    assert_eq!(announced, 4, "a model, a frame, a catalog and the hands");
    tick(&mut watch, 2, &[1], &model);
    tick(&mut watch, 3, &[1], &model);
    // The queue is full when the body ends, and the same number and another one come.
    tick(&mut watch, 4, &[], &model);
    while items.try_recv().is_ok() {}
    tick(&mut watch, 5, &[1, 2], &model);
    let mut ends = 0;
    let mut models = 0;
    for at in 6..20 {
        while let Ok(item) = items.try_recv() {
            match item {
                Item::Gone(id, model) => {
                    ends += 1;
                    assert_eq!((id, model), (BodyId(1), None), "body 2 has lost its model");
                }
                Item::Frame(BodyId(1), ..) => assert_eq!(ends, 1, "a body goes on before its end"),
                Item::Model(..) => models += 1,
                _ => {}
            }
        }
        tick(&mut watch, at, &[1, 2], &model);
    }
    assert_eq!((ends, models), (1, 2));
}

/// A sleeping body that is moved between two frames is seen where it is, and sleeps again there.
#[test]
fn a_sleeping_body_that_is_moved_is_sent() {
    let (mut watch, mut items) = watch(1024);
    watch.options.bodies.rate = 30.0;
    let model = pip();
    let mut decoder = BodyDecoder::new(coordinate_steps(&model, 30));
    let (mut frames, q) = (Vec::new(), [0.0; 30]);
    for tick in 1..=40 {
        let moved = if tick >= 21 { 0.25 } else { 0.0 };
        let placement = Placement { position: [moved, 0.0, 0.0], scale: 2.0, ..Placement::default() };
        let state = TickState { tick, q: &q, v: &[], a: &[], z: &[], pose: None, grabs: &[], resting: true };
        let (id, name, warps, view) = (BodyId(1), "pip", true, None);
        let model = &model;
        watch.body(&Seen { id, name, model, warps, placement, view, state: &state });
        watch.finish(tick, WatchNumbers::default());
        while let Ok(item) = items.try_recv() {
            if let Item::Frame(_, tick, _, bytes) = item {
                let (_, state) = decoder.decode(&bytes).unwrap();
                frames.push((tick, state.pose.map(|pose| pose.position[0]), state.resting));
            }
        }
    }
    assert_eq!(
        frames.iter().map(|(tick, _, resting)| (*tick, *resting)).collect::<Vec<_>>(),
        [(2, true), (22, false), (24, true)]
    );
    assert_eq!(frames[0].1, None);
    // In meters of the body, which is twice as large here.
    assert!(frames[1..].iter().all(|frame| frame.1.is_some_and(|x| (x - 0.125).abs() < 1e-3)), "{frames:?}");
}

/// A body at the end of the world, and a hand there, leave the others in the catalog and in the
/// frames.
#[test]
fn what_is_out_of_range_costs_the_others_nothing() {
    let (mut watch, mut items) = watch(1024);
    let (model, q) = (pip(), [0.0; 30]);
    for tick in 1..=20 {
        let state = TickState { tick, q: &q, v: &[], a: &[], z: &[], pose: None, grabs: &[], resting: false };
        // The third one is thrown there, and the fourth one grows without end.
        let far = if tick < 10 { 0.0 } else { 1e30 };
        let size = if tick < 10 { 1.0 } else { 1e30 };
        for (id, x, scale) in [(1, 0.0, 1.0), (2, 1e7, 1.0), (3, far, 1.0), (4, 0.0, size)] {
            let placement = Placement { position: [x, 0.0, 0.0], scale, ..Placement::default() };
            let (id, name, warps, view, model) = (BodyId(id), "pip", true, None, &model);
            watch.body(&Seen { id, name, model, warps, placement, view, state: &state });
        }
        watch.hand(WatchHand { target: [f64::NAN, 0.0, 0.0], ..WatchHand::default() });
        watch.hand(WatchHand { reaction: [0.0, 1e30, 0.0], ..WatchHand::default() });
        watch.hand(WatchHand { target: [1.0, 0.0, 0.0], ..WatchHand::default() });
        watch.finish(tick, WatchNumbers::default());
        while let Ok(item) = items.try_recv() {
            match item {
                Item::Catalog(_, bytes) => {
                    let ids: Vec<u16> =
                        Catalog::decode(&bytes).unwrap().bodies.iter().map(|b| b.id.0).collect();
                    assert_eq!(ids, [1, 3, 4], "tick {tick}");
                }
                Item::Hands(_, bytes) => assert_eq!(WatchHands::decode(&bytes).unwrap().hands.len(), 1),
                _ => {}
            }
        }
    }
}
