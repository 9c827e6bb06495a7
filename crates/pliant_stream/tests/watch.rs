//! What watchers get: frames come back as they were, bytes against error, and hostile bytes.

use crate::support;

use std::sync::Arc;

use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch};
use pliant_stream::watch::{
    Assembler, BodyDecoder, BodyEncoder, Catalog, CatalogBody, CatalogCamera, MAX_GROUP_FRAMES, MAX_MODEL,
    MAX_PIECE, WatchConfig, WatchFrame, WatchHand, WatchHands, WatchNumbers, WatchSurface, WatchedState,
    coordinate_steps, pieces,
};
use pliant_stream::{BodyId, GrabKey, Placement, RigidState, StreamError, TickState, UserId};
use support::direct::random;
use support::{bar, loose_bar};

const STEP: f64 = 1.0 / 60.0;

fn tick_state<'a>(tick: u64, q: &'a [f64], pose: Option<RigidState>) -> TickState<'a> {
    TickState { tick, q, v: &[], a: &[], z: &[], pose, grabs: &[], resting: false }
}

/// Ten seconds of a body at 60 ticks a second: a hand pulls it to and fro by about a fifth of its
/// size, lets go after six seconds, and the body swings.
fn course(model: &Arc<ModalModel>) -> Vec<Vec<f64>> {
    let config = BodyConfig { step: STEP, ..BodyConfig::default() };
    let mut body = Body::new(model.clone(), config).unwrap();
    let [low, high] = model.surface().bounds();
    let far = |p: &[f32; 3]| p.iter().zip(low).map(|(x, low)| f64::from(x - low).powi(2)).sum::<f64>();
    let points = model.surface().positions();
    let free = |v: &usize| !model.surface().anchored()[*v];
    let vertex = (0..points.len()).filter(free).max_by(|a, b| far(&points[*a]).total_cmp(&far(&points[*b])));
    assert!(high[0] > low[0]);
    let patch = Patch::around(model.surface(), vertex.unwrap() as u32, 0.1 * model.size()).unwrap();
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    let start = body.grab_position(grab).unwrap();
    let size = model.size();
    let mut out = Vec::new();
    for tick in 0..600 {
        let time = f64::from(tick) * STEP;
        if tick < 360 {
            let by = [0.05 * (3.1 * time).sin(), 0.2 * (4.4 * time).sin(), 0.12 * (1.7 * time).sin()];
            body.set_target(grab, std::array::from_fn(|k| start[k] + by[k] * size)).unwrap();
        } else if tick == 360 {
            body.release(grab);
        }
        body.step().unwrap();
        out.push(body.q().to_vec());
    }
    out
}

/// Error of the shape at `got` against `want`, as a share of the body's size: root mean square and
/// largest over the vertices.
fn shape_error(model: &ModalModel, warps: bool, got: &[f64], want: &[f64]) -> (f64, f64) {
    let single = |q: &[f64]| q.iter().map(|x| *x as f32).collect::<Vec<_>>();
    let count = model.surface().positions().len();
    let (mut a, mut b) = (vec![[0.0; 3]; count], vec![[0.0; 3]; count]);
    model.basis().reconstruct(&single(got), warps, &mut a);
    model.basis().reconstruct(&single(want), warps, &mut b);
    let off =
        |(a, b): (&[f32; 3], &[f32; 3])| a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
    let all: Vec<f64> = a.iter().zip(&b).map(off).collect();
    let rms = (all.iter().sum::<f64>() / count as f64).sqrt();
    (rms / model.size(), all.iter().fold(0.0_f64, |m, x| m.max(*x)).sqrt() / model.size())
}

struct Measured {
    bytes_per_second: f64,
    /// Error of what was decoded, at the ticks of the frames, over the sent coordinates.
    rounding: f64,
    /// Error of what is drawn, over all ticks and coordinates: root mean square and largest.
    rms: f64,
    largest: f64,
}

/// Sends a course, and draws it with straight lines between the frames.
fn watch(model: &Arc<ModalModel>, course: &[Vec<f64>], config: WatchConfig) -> Measured {
    let warps = model.parts().reduced.is_none();
    let mut encoder = BodyEncoder::new(model, config, STEP).unwrap();
    let mut decoder = BodyDecoder::new(coordinate_steps(model, config.modes));
    let (mut bytes, mut frames, mut rounding) = (0, Vec::<WatchedState>::new(), 0.0_f64);
    for (k, q) in course.iter().enumerate() {
        let tick = 1000 + k as u64;
        let Some(frame) = encoder.encode(&tick_state(tick, q, None)).unwrap() else { continue };
        bytes += frame.bytes.len();
        let (kind, state) = decoder.decode(&frame.bytes).unwrap();
        assert_eq!(frame.begins_group, kind == WatchFrame::Snapshot);
        assert_eq!(state.tick, tick);
        let sent = &q[..state.q.len()];
        rounding = rounding.max(shape_error(model, warps, &state.q, sent).1);
        frames.push(state.clone());
    }
    let (mut sum, mut count, mut largest) = (0.0, 0, 0.0_f64);
    for pair in frames.windows(2) {
        let (from, to) = (&pair[0], &pair[1]);
        for tick in from.tick..to.tick {
            let part = (tick - from.tick) as f64 / (to.tick - from.tick) as f64;
            let q: Vec<f64> = from.q.iter().zip(&to.q).map(|(a, b)| a + (b - a) * part).collect();
            let (rms, most) = shape_error(model, warps, &q, &course[(tick - 1000) as usize]);
            sum += rms * rms;
            count += 1;
            largest = largest.max(most);
        }
    }
    Measured {
        bytes_per_second: bytes as f64 / (course.len() as f64 * STEP),
        rounding,
        rms: (sum / f64::from(count)).sqrt(),
        largest,
    }
}

/// Bytes a second against the error of the shape, by rate and number of coordinates. The table of
/// `docs/watching.md` is this test's output.
#[test]
fn bytes_against_error() {
    let pip = Arc::new(ModalModel::read("../../assets/pip.modal").unwrap());
    for (name, model, counts) in [("bar", bar(60, 0.02), &[8, 30, 60][..]), ("pip", pip, &[8, 30][..])] {
        let course = course(&model);
        println!("{name}: {} coordinates, 60 ticks a second", model.mode_count());
        println!("| Hz | coordinates | bytes a second | rms error, 1e-3 of the size | largest |");
        println!("| --- | --- | --- | --- | --- |");
        let mut before = f64::INFINITY;
        for modes in counts {
            let measured = [10.0, 30.0, 60.0].map(|rate| {
                let measured =
                    watch(&model, &course, WatchConfig { rate, modes: *modes, ..WatchConfig::default() });
                let Measured { bytes_per_second, rms, largest, .. } = measured;
                println!(
                    "| {rate} | {modes} | {bytes_per_second:.0} | {:.2} | {:.1} |",
                    1e3 * rms,
                    1e3 * largest
                );
                // Half a step in each coordinate, if all were off at one vertex in one direction.
                assert!(measured.rounding < 0.5e-4 * *modes as f64, "{}", measured.rounding);
                measured
            });
            // More frames cost more and show more.
            assert!(measured[0].bytes_per_second < measured[1].bytes_per_second);
            assert!(measured[1].bytes_per_second < measured[2].bytes_per_second);
            assert!(measured[0].rms > measured[1].rms && measured[1].rms >= measured[2].rms);
            // More coordinates show more.
            assert!(measured[2].rms <= before, "{} after {before}", measured[2].rms);
            before = measured[2].rms;
            // 16 bits a coordinate without prediction, at the same steps.
            let plain = 60.0 * (2.0 * *modes as f64 + 1.0);
            assert!(
                measured[2].bytes_per_second < 0.6 * plain,
                "{} of {plain}",
                measured[2].bytes_per_second
            );
        }
    }
}

/// A finer resolution costs bytes and lowers the rounding, and rounding does not add up.
#[test]
fn rounding_stays_within_half_a_step() {
    let model = bar(20, 0.02);
    let course = course(&model);
    let places = coordinate_steps(&model, 20);
    let mut cost = 0.0;
    for resolution in [1e-3, 1e-4, 1e-5] {
        let config = WatchConfig { rate: 60.0, modes: 20, resolution, ..WatchConfig::default() };
        let measured = watch(&model, &course, config);
        println!("resolution {resolution}: {:.0} bytes a second", measured.bytes_per_second);
        assert!(measured.bytes_per_second > cost);
        cost = measured.bytes_per_second;
        let mut encoder = BodyEncoder::new(&model, config, STEP).unwrap();
        let mut decoder = BodyDecoder::new(places.clone());
        for (k, q) in course.iter().enumerate() {
            let frame = encoder.encode(&tick_state(k as u64, q, None)).unwrap().unwrap();
            let (_, state) = decoder.decode(&frame.bytes).unwrap();
            for ((got, want), place) in state.q.iter().zip(q).zip(&places) {
                let steps = (got - want).abs() / (f64::from(*place) * resolution * model.size());
                assert!(steps < 0.5001, "off by {steps} steps at frame {k}");
            }
        }
    }
}

/// A free body has a pose in its frames, far away too, and sleeps without frames.
#[test]
fn poses_and_sleep() {
    let model = loose_bar(8, 0.05);
    let config = WatchConfig { rate: 30.0, ..WatchConfig::default() };
    let mut encoder = BodyEncoder::new(&model, config, STEP).unwrap();
    let mut decoder = BodyDecoder::new(coordinate_steps(&model, config.modes));
    let mut groups = 0;
    for k in 0..240_u64 {
        let angle = 0.02 * k as f64;
        // It jumps away after two seconds, beyond what the steps of the group reach.
        let x = if k < 120 { 0.01 * k as f64 } else { 3e8 };
        let pose = RigidState {
            position: [x, -2.0, 0.3],
            // Both signs are the same rotation.
            rotation: [0.0, angle.sin(), 0.0, angle.cos()].map(|c| if k % 20 < 10 { c } else { -c }),
            ..RigidState::default()
        };
        let q = [0.01 * angle.sin(); 8];
        let frame = encoder.encode(&tick_state(k, &q, Some(pose))).unwrap();
        assert_eq!(frame.is_some(), k % 2 == 0);
        let Some(frame) = frame else { continue };
        groups += u32::from(frame.begins_group);
        let (_, state) = decoder.decode(&frame.bytes).unwrap();
        let got = state.pose.unwrap();
        let relative = if k < 120 { 1e-4 } else { 1.0 };
        for axis in 0..3 {
            let off = (got.position[axis] - pose.position[axis]).abs();
            assert!(off < relative * model.size(), "off by {off} m at {k}");
        }
        let along: f64 = got.rotation.iter().zip(pose.rotation).map(|(a, b)| a * b).sum();
        assert!(along.abs() > 1.0 - 1e-8, "turned by {along} at {k}");
        if k % 20 == 10 && k < 120 {
            assert!(frame.bytes.len() < 40, "{} bytes for the other sign", frame.bytes.len());
        }
    }
    assert_eq!(groups, 4, "a group each second, and one at the jump in place of the third");
    let at_rest = TickState { resting: true, ..tick_state(240, &[0.0; 8], Some(RigidState::default())) };
    let frame = encoder.encode(&at_rest).unwrap().unwrap();
    assert!(decoder.decode(&frame.bytes).unwrap().1.resting);
    for tick in 241..3000 {
        assert_eq!(encoder.encode(&TickState { tick, ..at_rest }).unwrap(), None);
    }
    let awake = TickState { tick: 3000, resting: false, ..at_rest };
    let frame = encoder.encode(&awake).unwrap().unwrap();
    let (_, state) = decoder.decode(&frame.bytes).unwrap();
    assert!(!state.resting && state.tick == 3000);
}

#[test]
fn states_that_are_not_finite_and_wrong_settings_are_refused() {
    let model = bar(4, 0.05);
    for config in [
        WatchConfig { rate: f64::NAN, ..WatchConfig::default() },
        WatchConfig { rate: 0.0, ..WatchConfig::default() },
        WatchConfig { modes: 0, ..WatchConfig::default() },
        WatchConfig { resolution: 0.0, ..WatchConfig::default() },
        WatchConfig { group: f64::INFINITY, ..WatchConfig::default() },
    ] {
        assert!(matches!(BodyEncoder::new(&model, config, STEP), Err(StreamError::Config { .. })));
    }
    assert!(BodyEncoder::new(&model, WatchConfig::default(), 0.0).is_err());
    let mut encoder = BodyEncoder::new(&model, WatchConfig::default(), STEP).unwrap();
    assert!(encoder.encode(&tick_state(2, &[f64::NAN; 4], None)).is_err());
    assert!(encoder.encode(&tick_state(2, &[1e12; 4], None)).is_err());
    assert!(encoder.encode(&tick_state(4, &[1e8; 4], None)).unwrap().is_some());
    assert!(matches!(encoder.encode(&tick_state(4, &[0.0; 4], None)), Err(StreamError::TickOrder { .. })));
}

/// The flattened surface draws what the model draws, up to the rounding of its rows.
#[test]
fn a_surface_draws_what_the_model_draws() {
    for (file, modes) in [("pip", 30), ("bud", 8), ("jack", 99)] {
        let model = Arc::new(ModalModel::read(format!("../../assets/{file}.modal")).unwrap());
        let surface = WatchSurface::new(&model, modes);
        let bytes = surface.encode();
        println!("{file}: {} bytes of {} in the file", bytes.len(), model.file_bytes());
        assert_eq!(bytes.len() as u64, WatchSurface::encoded_length(&model, modes));
        let back = WatchSurface::decode(&bytes).unwrap();
        assert_eq!(back, surface);
        assert_eq!(back.modes(), modes.min(model.mode_count()));
        // Each coordinate moves the surface by a twentieth of the size.
        let q: Vec<f64> = back.places.iter().map(|place| 0.05 * model.size() * f64::from(*place)).collect();
        for warps in [false, true] {
            let mut off = 0.0_f64;
            for vertex in 0..back.positions.len() {
                let got = back.vertex_position(vertex, &q, warps).unwrap();
                let want = model.vertex_position(vertex as u32, &q, warps).unwrap();
                off = (0..3).map(|k| (got[k] - want[k]).powi(2)).sum::<f64>().sqrt().max(off);
            }
            println!("{file}, warp {warps}: off by {:.1e} of the size", off / model.size());
            assert!(off < 1e-4 * model.size());
        }
        let whole: Vec<u8> = pieces(&bytes).flatten().copied().collect();
        assert_eq!(whole, bytes);
        let mut assembler = Assembler::new(bytes.len() as u64, MAX_MODEL).unwrap();
        let arrived: Vec<_> = pieces(&bytes).map(|piece| assembler.push(piece).unwrap()).collect();
        assert_eq!(arrived.last().unwrap().as_deref(), Some(&bytes[..]));
        assert!(arrived[..arrived.len() - 1].iter().all(Option::is_none));
    }
}

fn catalog() -> Catalog {
    let model = bar(4, 0.05);
    let body = |id| CatalogBody {
        id: BodyId(id),
        name: "täuschend echt".into(),
        model: model.hash(),
        file_bytes: 1 << 20,
        surface_bytes: 1 << 19,
        modes: 4,
        every: 2,
        warps: true,
        free: false,
        placement: Placement::default(),
        color: [200, 100, 50, 255],
    };
    let camera = CatalogCamera { eye: [1.0, 2.0, 3.0], at: [0.0; 3], field_of_view: 0.8 };
    let (session, step, name) = (0x0123_4567_89ab_cdef, STEP, "a session".into());
    Catalog { session, step, name, bodies: vec![body(3), body(9)], cameras: vec![camera] }
}

fn hands() -> WatchHands {
    let hand = WatchHand {
        body: BodyId(3),
        key: GrabKey { user: UserId(2), grab: 7 },
        target: [0.5, -0.25, 1.0],
        reaction: [0.0, 2.0, -1.0],
    };
    let numbers = WatchNumbers { people: 3, loss: Some(0.5), round_trip: 0.125, dropped: 4 };
    WatchHands { tick: 1 << 40, numbers, hands: vec![hand; 5] }
}

#[test]
fn catalogs_and_hands_come_back() {
    assert_eq!(Catalog::decode(&catalog().encode()).unwrap(), catalog());
    assert_eq!(WatchHands::decode(&hands().encode()).unwrap(), hands());
    let unknown = WatchHands { numbers: WatchNumbers { loss: None, ..hands().numbers }, ..hands() };
    assert_eq!(WatchHands::decode(&unknown.encode()).unwrap(), unknown);
    let long = Catalog { name: "ä".repeat(64), ..catalog() };
    assert_eq!(Catalog::decode(&long.encode()).unwrap().name, "ä".repeat(32));
    let mut twice = catalog();
    twice.bodies[1].id = twice.bodies[0].id;
    assert!(Catalog::decode(&twice.encode()).is_err());
    let mut nowhere = catalog();
    nowhere.bodies[0].placement.scale = 0.0;
    assert!(Catalog::decode(&nowhere.encode()).is_err());
}

/// Truncated and damaged bytes of every kind: an error or another value, no panic, and no more
/// memory than the bytes are worth.
#[test]
fn hostile_bytes_are_refused() {
    let model = bar(12, 0.05);
    let surface = WatchSurface::new(&model, 12).encode();
    for whole in [catalog().encode(), hands().encode(), surface.clone()] {
        for length in 0..whole.len().min(2000) {
            let cut = &whole[..length];
            assert!(Catalog::decode(cut).is_err() && WatchHands::decode(cut).is_err());
            assert!(WatchSurface::decode(cut).is_err());
        }
        let mut seed = 7;
        for _ in 0..3000 {
            let mut damaged = whole.clone();
            for _ in 0..1 + random(&mut seed) % 4 {
                let at = random(&mut seed) as usize % damaged.len().min(300);
                damaged[at] = random(&mut seed) as u8;
            }
            let _ = (Catalog::decode(&damaged), WatchHands::decode(&damaged), WatchSurface::decode(&damaged));
        }
    }
    // Counts that promise more than there is.
    let mut huge = surface;
    huge[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(WatchSurface::decode(&huge).is_err());
    assert!(Assembler::new(u64::MAX, MAX_MODEL).is_err());
    let mut assembler = Assembler::new(10, MAX_MODEL).unwrap();
    assert!(assembler.push(&[0; 11]).is_err() && assembler.push(&[]).is_err());
    assert_eq!(assembler.push(&[0; 9]).unwrap(), None);
    assert!((assembler.progress() - 0.9).abs() < 1e-12);
    assert!(assembler.push(&vec![0; MAX_PIECE]).is_err());
}

/// Frames of a body: a wrong one ends its group, and the next snapshot begins anew.
#[test]
fn a_wrong_frame_ends_its_group() {
    let model = bar(12, 0.05);
    let course = course(&model);
    let config = WatchConfig { rate: 60.0, modes: 12, ..WatchConfig::default() };
    let mut encoder = BodyEncoder::new(&model, config, STEP).unwrap();
    let frames: Vec<_> = course
        .iter()
        .enumerate()
        .filter_map(|(k, q)| encoder.encode(&tick_state(k as u64, q, None)).unwrap())
        .collect();
    let places = coordinate_steps(&model, 12);
    let mut decoder = BodyDecoder::new(places.clone());
    let lost = decoder.decode(&frames[1].bytes).unwrap_err();
    assert!(matches!(lost, StreamError::State { .. }), "{lost}");
    decoder.decode(&frames[0].bytes).unwrap();
    let cut = &frames[1].bytes[..frames[1].bytes.len() - 1];
    assert!(decoder.decode(cut).is_err() && decoder.state().is_none());
    assert!(decoder.decode(&frames[2].bytes).is_err(), "the group goes on after a wrong frame");
    decoder.decode(&frames[60].bytes).unwrap();
    assert_eq!(decoder.state().unwrap().tick, 60);
    // A snapshot with more coordinates than the model has, and one of a NaN unit.
    assert!(BodyDecoder::new(places[..11].to_vec()).decode(&frames[0].bytes).is_err());
    let mut wrong = frames[0].bytes.clone();
    wrong[7..11].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(decoder.decode(&wrong).is_err());
    let mut seed = 3;
    let mut right = 0;
    for _ in 0..20_000 {
        let mut decoder = BodyDecoder::new(places.clone());
        for frame in &frames[..4] {
            let mut bytes = frame.bytes.clone();
            if random(&mut seed).is_multiple_of(2) {
                let at = random(&mut seed) as usize % bytes.len();
                bytes[at] ^= 1 << (random(&mut seed) % 8);
            }
            if let Ok((_, state)) = decoder.decode(&bytes) {
                assert!(state.q.iter().all(|q| q.is_finite()));
                right += 1;
            }
        }
    }
    assert!(right > 1000, "only {right} frames were read");
    // A group that does not end.
    let mut decoder = BodyDecoder::new(places);
    decoder.decode(&frames[0].bytes).unwrap();
    let held = [1 << 2; 1].into_iter().chain([0; 64]).collect::<Vec<u8>>();
    let endless = (0..2 * MAX_GROUP_FRAMES).map(|_| {
        // Zeros go on as before, in as many bytes as they need.
        (1..held.len()).find(|&n| decoder.clone().decode(&held[..n]).is_ok()).map(|n| {
            decoder.decode(&held[..n]).unwrap();
        })
    });
    let read = endless.take_while(Option::is_some).count();
    assert!(read < MAX_GROUP_FRAMES, "{read} frames of an endless group were read");
}
