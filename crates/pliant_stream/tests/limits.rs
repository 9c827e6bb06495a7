//! No datagram exceeds the size limit of the path, for any number of modes and hands and any
//! policy. Rounding errors are equal on the surface.

use crate::support;

use std::time::Duration;

use pliant_modal::GrabConfig;
use pliant_stream::codec::encoder::Encoder;
use pliant_stream::codec::quantization::Quanta;
use pliant_stream::recovery::History;
use pliant_stream::wire::Datagram;
use pliant_stream::{
    BodyId, GrabKey, GrabState, HostSession, Newmark, RecoveryConfig, RigidState, StepSettings, TickState,
    UserId,
};
use support::{bar, direct};

const H: f64 = 0.025;

fn hands(count: u16) -> Vec<GrabState> {
    let hand = |k: u16| GrabState {
        key: GrabKey { user: UserId(k), grab: 7 },
        vertex: u32::from(k) + 4,
        radius: 0.05,
        target: [1.0, 0.1 * f64::from(k), 0.3],
        reaction: [0.5, f64::from(k), -2.0],
        hold: GrabConfig { stiffness: Some(200.0), relaxation: 0.0625 },
    };
    (0..count).map(hand).collect()
}

#[test]
fn no_frame_is_longer_than_the_path_carries_and_none_of_its_hands_is_lost() {
    let (model, settings) = (bar(500, 0.05), StepSettings::default());
    let newmark = Newmark { h: H, beta: 4.0 / 9.0, gamma: 5.0 / 6.0 };
    for name in ["default", "paper", "paper-repeats", "force-driven"] {
        for limit in [256, 400, 1200] {
            let subscription = RecoveryConfig::by_name(name).unwrap().subscription(None);
            let mut encoder =
                Encoder::new(BodyId(1), model.clone(), &settings, newmark, subscription, limit).unwrap();
            let modes = encoder.modes();
            if name == "default" || limit == 1200 {
                assert_eq!(modes, 500, "{name} at {limit} bytes");
            }
            let quanta = Quanta::new(&model, modes, &newmark);
            let mut history = History::new(0);
            let mut split = 0;
            for tick in 1..=40_u64 {
                let t = tick as f64 * H;
                let q: Vec<f64> =
                    (0..500).map(|k| 0.3 * (t * (1.0 + k as f64) + 0.7).sin() / (1.0 + k as f64)).collect();
                let v: Vec<f64> = (0..500).map(|k| 0.3 * (t * (1.0 + k as f64) + 0.7).cos()).collect();
                let a: Vec<f64> =
                    (0..500).map(|k| -0.3 * (1.0 + k as f64) * (t * (1.0 + k as f64) + 0.7).sin()).collect();
                // The number of hands goes from none to the maximum and jumps back to none.
                let grabs = hands((tick * 13 % 65) as u16);
                let pose = (tick % 3 == 0)
                    .then(|| RigidState { position: [1.0, 2.0, 3.0], ..RigidState::default() });
                let state =
                    TickState { tick, q: &q, v: &v, a: &a, z: &[], pose, grabs: &grabs, resting: false };
                if tick == 1 {
                    encoder.restart(&state);
                    continue;
                }
                let encoded = encoder.encode(&state);
                split += encoded.more.len();
                for body in encoded.all() {
                    assert!(
                        body.len() + 3 <= limit,
                        "{name}: {} of {limit} bytes, {} hands",
                        body.len() + 3,
                        grabs.len()
                    );
                    let mut bytes = vec![1, 0, 0];
                    bytes.extend_from_slice(body);
                    let Datagram::Frame(frame) = Datagram::decode(&bytes).unwrap().1 else { unreachable!() };
                    history.take(&frame, &quanta, |_, _| {});
                }
                let known = history.known(tick).expect("all parts are here");
                assert_eq!(known.grabs.len(), grabs.len(), "{name} at {limit}, tick {tick}");
                assert_eq!(known.pose.is_some(), pose.is_some());
                // Each part that is sent again fits too.
                assert!(encoder.resend(tick).all(|body| body.len() + 3 <= limit));
                assert_eq!(encoder.resend(tick).count(), 1 + encoded.more.len());
            }
            assert!(split > 0, "{name} at {limit} bytes: 64 hands do not fit in one datagram");
        }
    }
}

#[test]
fn a_tick_whose_part_is_missing_is_not_known() {
    let (model, settings) = (bar(20, 0.05), StepSettings::default());
    let newmark = Newmark { h: H, beta: 4.0 / 9.0, gamma: 5.0 / 6.0 };
    let subscription = RecoveryConfig::default().subscription(None);
    let mut encoder = Encoder::new(BodyId(1), model.clone(), &settings, newmark, subscription, 400).unwrap();
    let quanta = Quanta::new(&model, 20, &newmark);
    let (q, grabs) = ([0.01; 20], hands(20));
    let state =
        |tick| TickState { tick, q: &q, v: &q, a: &q, z: &[], pose: None, grabs: &grabs, resting: false };
    encoder.restart(&state(1));
    let encoded = encoder.encode(&state(2));
    let all: Vec<_> = encoded.all().cloned().collect();
    assert!(all.len() >= 3, "{} parts", all.len());
    let mut history = History::new(0);
    let mut take = |body: &[u8]| {
        let mut bytes = vec![1, 0, 0];
        bytes.extend_from_slice(body);
        let Datagram::Frame(frame) = Datagram::decode(&bytes).unwrap().1 else { unreachable!() };
        history.take(&frame, &quanta, |_, _| {});
        history.known(2).map(|d| d.grabs.len())
    };
    // Parts may arrive in any order, and some arrive twice.
    for body in all[1..].iter().rev().chain(&all[1..]) {
        assert_eq!(take(body), None);
    }
    assert_eq!(take(&all[0]), Some(20));
}

#[test]
fn a_step_moves_the_surface_alike_in_every_mode() {
    let model = bar(60, 0.05);
    let newmark = Newmark { h: H, beta: 4.0 / 9.0, gamma: 5.0 / 6.0 };
    let subscription = RecoveryConfig::default().subscription(None);
    let settings = StepSettings::default();
    let mut encoder = Encoder::new(BodyId(1), model.clone(), &settings, newmark, subscription, 1200).unwrap();
    let q: Vec<f64> = (0..60).map(|k| 0.21 / (1.0 + f64::from(k)).powi(2)).collect();
    let v = vec![0.0; 60];
    let state =
        |tick| TickState { tick, q: &q, v: &v, a: &v, z: &[], pose: None, grabs: &[], resting: false };
    encoder.restart(&state(1));
    let quanta = Quanta::new(&model, 60, &newmark);
    let visible = |mode: usize| {
        let size =
            |v: u32| (0..3).map(|x| f64::from(model.displacement_row(v, x, mode)).powi(2)).sum::<f64>();
        (0..model.surface().positions().len() as u32).map(size).fold(0.0, f64::max).sqrt()
    };
    // The first mode is the most visible. The unit is a 16,384th of its displacement.
    let unit = 0.21 * visible(0) / 16_384.0;
    let (mut seen, mut widths) = (std::collections::BTreeSet::new(), Vec::new());
    for tick in 2..60 {
        let mut bytes = vec![1, 0, 0];
        bytes.extend_from_slice(&encoder.encode(&state(tick)).first);
        let Datagram::Frame(frame) = Datagram::decode(&bytes).unwrap().1 else { unreachable!() };
        let slice = frame.slice.expect("every frame has one");
        assert!((f64::from(slice.unit) - unit).abs() < 1e-4 * unit, "{} and {unit}", slice.unit);
        for (e, (_, steps)) in slice.entries(&quanta).zip(&slice.steps) {
            let moved = (e.q - q[e.mode]).abs() * visible(e.mode);
            assert!(moved <= 0.5001 * unit, "mode {}: off by {moved} m of {unit} m", e.mode);
            seen.insert(e.mode);
            widths.push((e.mode, steps[0]));
        }
    }
    assert_eq!(seen.len(), 60, "all modes come round");
    let of = |mode: usize| widths.iter().find(|w| w.0 == mode).unwrap().1.unsigned_abs();
    assert!((16_380..=16_388).contains(&of(0)), "{}", of(0));
    assert!(of(59) < 200, "a faint mode takes few bits: {}", of(59));
}

/// A body that has rested for a day of ticks moves again when it wakes.
#[test]
fn a_body_that_has_rested_for_a_day_wakes_up() {
    let (mut host, mut guest, mut now) = direct::session("default");
    let zero = [0.0; 12];
    let publish = |host: &mut HostSession, now: Duration, tick: u64, moves: f64, resting: bool| {
        let mut q = zero;
        q[0] = moves;
        let (v, a) = (&zero, &zero);
        let state = TickState { tick, q: &q, v, a, z: &[], pose: None, grabs: &[], resting };
        host.publish(now, direct::BODY, &state).unwrap();
    };
    for tick in 60..80 {
        now += Duration::from_millis(25);
        publish(&mut host, now, tick, 0.0, true);
        direct::exchange(&mut host, &mut guest, now);
    }
    assert!(guest.body(direct::BODY).unwrap().is_resting());
    // A day at 40 ticks a second, of which the app publishes one in 200.
    let day = 86_400 * 40;
    for tick in (80..80 + day).step_by(200) {
        now += Duration::from_secs(5);
        publish(&mut host, now, tick, 0.0, true);
        direct::exchange(&mut host, &mut guest, now);
    }
    let mut shown = 0.0;
    for tick in 80 + day..200 + day {
        now += Duration::from_millis(25);
        publish(&mut host, now, tick, 0.01 * (0.1 * (tick - day) as f64).sin(), false);
        direct::exchange(&mut host, &mut guest, now);
        shown = f64::max(shown, guest.body(direct::BODY).unwrap().visual().unwrap().q[0].abs());
    }
    assert!(!guest.is_closed() && shown > 0.005, "the guest shows {shown} of 0.01");
}
