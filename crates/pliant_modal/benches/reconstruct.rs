//! Reconstruction and step, compared with the limit that memory sets.
//!
//! The limit is a plain sum over a buffer of the same size, measured in the same run.
//!
//! `cargo bench -p pliant_modal --bench reconstruct`
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench may stop")]

use std::{hint::black_box, sync::Arc, time::Instant};

use pliant_modal::{
    BakeInfo, Body, BodyConfig, Damping, Element, GrabConfig, ModalModel, ModelParts, Patch, Relaxation,
    StepSettings, SurfaceMesh, streaming_sum,
};

/// Makes a strip of triangles with smooth but meaningless modes, because the cost does not depend
/// on the shape.
fn model(vertices: usize, modes: usize) -> ModalModel {
    let positions: Vec<[f32; 3]> = (0..vertices)
        .map(|i| [i as f32 * 1e-3, (i % 2) as f32 * 0.01, ((i / 2) % 2) as f32 * 0.01])
        .collect();
    let triangles = (0..vertices as u32 - 2).map(|i| [i, i + 1, i + 2]).collect();
    let omega: Vec<f64> = (1..=modes).map(|k| 20.0 * k as f64).collect();
    let wave = |i: usize| ((i as f32) * 0.37).sin();
    ModalModel::from_parts(ModelParts {
        info: BakeInfo {
            name: "bench".into(),
            tets: 0,
            nodes: 0,
            element: Element::Tet10,
            young: 1e5,
            poisson: 0.3,
            density: 1e3,
            damping: Damping::Ratio(0.02),
            anchors: vec![],
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface: SurfaceMesh::new(positions, triangles, None, vec![]).unwrap(),
        damping: omega.iter().map(|w| 0.04 * w).collect(),
        displacement: (0..vertices * modes * 3).map(wave).collect(),
        rotation: (0..vertices * modes * 3).map(|i| 3.0 * wave(i + 1)).collect(),
        participation: vec![[0.0; 3]; modes],
        omega,
        free: false,
        mass: 1.0,
        center_of_mass: [0.0; 3],
        inertia: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        sites: vec![],
        reduced: None,
    })
    .unwrap()
}

/// Returns the median and the 99th percentile of the duration of `work`, us.
fn time(mut work: impl FnMut()) -> [f64; 2] {
    let mut samples: Vec<f64> = Vec::new();
    let begun = Instant::now();
    while samples.len() < 200 || (begun.elapsed().as_secs_f64() < 1.0 && samples.len() < 20_000) {
        let start = Instant::now();
        work();
        samples.push(start.elapsed().as_secs_f64() * 1e6);
    }
    samples.sort_by(f64::total_cmp);
    [samples[samples.len() / 2], samples[samples.len() * 99 / 100]]
}

/// Measures two functions like [`time`], in alternating turns of eight calls.
///
/// Other load on the machine then slows both alike. The first call of each turn does not count,
/// because the caches still hold the data of the other function.
fn by_turns(mut a: impl FnMut(), mut b: impl FnMut()) -> [[f64; 2]; 2] {
    let once = |work: &mut dyn FnMut()| {
        let start = Instant::now();
        work();
        start.elapsed().as_secs_f64() * 1e6
    };
    let mut samples = [Vec::new(), Vec::new()];
    let begun = Instant::now();
    while samples[0].len() < 200 || (begun.elapsed().as_secs_f64() < 2.0 && samples[0].len() < 20_000) {
        a();
        samples[0].extend((0..7).map(|_| once(&mut a)));
        b();
        samples[1].extend((0..7).map(|_| once(&mut b)));
    }
    samples.map(|mut samples| {
        samples.sort_by(f64::total_cmp);
        [samples[samples.len() / 2], samples[samples.len() * 99 / 100]]
    })
}

fn main() {
    println!(
        "{:>9} {:>6} {:>12} {:>12} {:>10} {:>8} {:>8} {:>8} {:>10} {:>10}",
        "vertices",
        "modes",
        "limit us",
        "warped us",
        "p99 us",
        "of limit",
        "half us",
        "of 8 us",
        "linear us",
        "step us"
    );
    for (vertices, modes) in [(1_036, 20), (3_500, 60), (12_000, 120), (25_000, 100), (50_000, 120)] {
        let model = Arc::new(model(vertices, modes));
        let mut out = vec![[0.0f32; 3]; vertices];
        let q: Vec<f32> = (0..modes).map(|i| 1e-4 * (i % 7) as f32).collect();
        let buffer = vec![1.0f32; model.basis().traffic_bytes(modes) / 4];
        let [limit, [warped, p99]] = by_turns(
            || {
                black_box(streaming_sum(black_box(&buffer)));
            },
            || model.basis().reconstruct(black_box(&q), true, black_box(&mut out)),
        );
        let limit = limit[0];
        let half = model.basis().to_half();
        let half = time(|| half.reconstruct(black_box(&q), true, black_box(&mut out)))[0];
        let mut others = vec![vec![[0.0f32; 3]; vertices]; 8];
        let eight = time(|| {
            let mut bodies: Vec<_> = others.iter_mut().map(|out| (&q[..], &mut out[..])).collect();
            model.basis().reconstruct_all(true, black_box(&mut bodies));
        })[0]
            / 8.0;
        let linear = time(|| model.basis().reconstruct(black_box(&q), false, black_box(&mut out)))[0];
        let mut body = Body::new(model.clone(), BodyConfig::default()).unwrap();
        let patch = Patch::around(model.surface(), vertices as u32 / 2, 0.01).unwrap();
        let grab = body.grab(&patch, GrabConfig::default()).unwrap();
        let start = body.grab_position(grab).unwrap();
        body.set_target(grab, [start[0], start[1] + 0.01, start[2]]).unwrap();
        let step = time(|| {
            body.step().unwrap();
        })[0];
        println!(
            "{vertices:>9} {modes:>6} {limit:>12.1} {warped:>12.1} {p99:>10.1} {:>8.2} {half:>8.1} {eight:>8.1} {linear:>10.1} {step:>10.2}",
            limit / warped
        );
    }
    whole_step();
    many_bodies();
}

/// Measures the work of one PyBullet call: step, warp and reconstruction of a held body with 1,036
/// vertices and 20 modes.
fn whole_step() {
    let model = Arc::new(model(1_036, 20));
    let mut body = Body::new(model.clone(), BodyConfig::default()).unwrap();
    let patch = Patch::around(model.surface(), 500, 0.01).unwrap();
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    let start = body.grab_position(grab).unwrap();
    let mut out = vec![[0.0f32; 3]; 1_036];
    let mut tick = 0;
    let [median, p99] = time(|| {
        tick += 1;
        body.set_target(grab, [start[0], start[1] + 0.01 * (0.05 * f64::from(tick)).sin(), start[2]])
            .unwrap();
        body.step().unwrap();
        body.reconstruct(black_box(&mut out)).unwrap();
    });
    println!(
        "1,036 vertices, 20 modes: step with a grab, warp, reconstruction: {median:.2} us (99 %: {p99:.2})"
    );
}

/// Measures a step of a thousand moving bodies with twenty modes on one core.
fn many_bodies() {
    let model = Arc::new(model(300, 20));
    let bodies: Vec<Body> = (0..1_000)
        .map(|k| {
            let mut body = Body::new(model.clone(), BodyConfig::default()).unwrap();
            body.apply_impulse(k % 300, [0.1, 0.2, 0.0]).unwrap();
            body
        })
        .collect();
    let material = Some(Relaxation { ratio: 0.5, time: 0.1 });
    for (name, relaxation) in [("elastic", None), ("viscoelastic", material)] {
        let mut bodies = bodies.clone();
        for body in &mut bodies {
            body.reconfigure(BodyConfig::from(StepSettings { relaxation, ..Default::default() })).unwrap();
        }
        let [median, p99] = time(|| {
            for body in &mut bodies {
                body.step().unwrap();
            }
        });
        println!("1,000 {name} bodies of 20 modes, a step of all: {median:.1} us (99 %: {p99:.1})");
    }
}
