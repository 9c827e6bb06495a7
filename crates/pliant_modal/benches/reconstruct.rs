//! Reconstruction and step against the limit that memory sets, measured in the same run: a plain sum over a buffer of the same size.
//!
//! `cargo bench -p pliant_modal --bench reconstruct`
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench may stop")]

use std::{hint::black_box, sync::Arc, time::Instant};

use pliant_modal::{
    BakeInfo, Body, BodyConfig, Damping, Element, GrabConfig, ModalModel, ModelParts, Patch, SurfaceMesh,
};

/// A strip of triangles with smooth, meaningless modes: the cost does not depend on the shape.
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
    })
    .unwrap()
}

/// Median and 99th percentile of the time of `work`, us.
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
        // Sixteen independent lanes and eight chains: the sum is bound by the loads, not by the adds.
        let limit = time(|| {
            let mut lanes = [[0.0f32; 16]; 8];
            for chunk in black_box(&buffer).chunks_exact(128) {
                for (lane, part) in lanes.iter_mut().zip(chunk.chunks_exact(16)) {
                    for (a, b) in lane.iter_mut().zip(part) {
                        *a += b;
                    }
                }
            }
            black_box(lanes);
        })[0];
        let [warped, p99] = time(|| model.basis().reconstruct(black_box(&q), true, black_box(&mut out)));
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
}
