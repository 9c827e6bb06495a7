//! A step of reduced elasticity without hands, with one and with two, beside the linear step of the
//! same model and a product of two matrices, in turns in the same run.
//!
//! `cargo bench -p pliant_bake --bench reduced`
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench may stop")]

use std::{hint::black_box, sync::Arc, time::Instant};

use nalgebra::DMatrix;
use pliant_bake::{BakeConfig, bake};
use pliant_mesh::shapes;
use pliant_modal::{
    Body, BodyConfig, Elasticity, GrabConfig, GrabId, ModalModel, Patch, Precision, StepSettings,
};

/// Steps in a turn, and turns.
const TURN: usize = 64;
const TURNS: usize = 320;

/// A bar of 1 m by .3 m by .3 m, clamped at x = 0, of 40 coordinates.
fn bar() -> Arc<ModalModel> {
    let mesh = shapes::bar([16, 5, 5], [1.0, 0.3, 0.3]).unwrap();
    let anchors = vec!["x<1e-9".parse().unwrap()];
    let config = BakeConfig { modes: 40, anchors, sites: Some(100), ..BakeConfig::default() };
    Arc::new(bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model)
}

/// A body whose hands lead it to and fro by up to 8 % of its length.
struct Led {
    name: String,
    body: Body,
    hands: Vec<(GrabId, [f64; 3])>,
    tick: u32,
    times: Vec<f64>,
}

impl Led {
    fn new(model: &Arc<ModalModel>, elasticity: Elasticity, hands: usize, has_shapes: bool) -> Self {
        let settings = StepSettings { elasticity, ..StepSettings::default() };
        let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / 60.0, ..settings.into() }).unwrap();
        let positions = model.surface().positions();
        let nearest = |at: [f64; 3]| {
            let away =
                |v: &u32| (0..3).map(|k| (f64::from(positions[*v as usize][k]) - at[k]).powi(2)).sum::<f64>();
            (0..positions.len() as u32).min_by(|a, b| away(a).total_cmp(&away(b))).unwrap()
        };
        let places = [[1.0, 0.3, 0.15], [0.6, 0.3, 0.15]];
        let hands: Vec<(GrabId, [f64; 3])> = places[..hands]
            .iter()
            .map(|&at| {
                let patch = Patch::around(model.surface(), nearest(at), 0.08).unwrap();
                let grab = body.grab(&patch, GrabConfig::default()).unwrap();
                (grab, body.target(grab).unwrap())
            })
            .collect();
        if hands.is_empty() {
            body.apply_impulse(nearest([1.0, 0.3, 0.3]), [0.0, 5.0, 2.0]).unwrap();
        }
        let mut out = Self { name: String::new(), body, hands, tick: 0, times: Vec::new() };
        if has_shapes {
            // The columns are those of hands that have gone half of their way.
            for _ in 0..60 {
                out.step();
            }
            out.body.make_held_shapes().unwrap();
            out.times.clear();
        }
        let columns = out.body.held_shapes().map_or(0, |shapes| shapes.columns());
        let own = if has_shapes { format!(", {columns} columns") } else { String::new() };
        out.name = format!("{elasticity:?}, hands: {}{own}", out.hands.len());
        out
    }

    fn step(&mut self) {
        self.tick += 1;
        let turn = 0.04 * f64::from(self.tick);
        for (sign, &(grab, start)) in [1.0, -1.0].iter().zip(&self.hands) {
            let by = [0.02 * (0.7 * turn).sin(), sign * 0.08 * turn.sin(), 0.03 * (1.3 * turn).sin()];
            self.body.set_target(grab, std::array::from_fn(|k| start[k] + by[k])).unwrap();
        }
        let begun = Instant::now();
        self.body.step().unwrap();
        self.times.push(begun.elapsed().as_secs_f64() * 1e6);
    }
}

/// The times at a share of them, us.
fn at(times: &mut [f64], share: f64) -> f64 {
    times.sort_by(f64::total_cmp);
    times[((times.len() - 1) as f64 * share) as usize]
}

fn main() {
    let model = bar();
    let mut bodies: Vec<Led> = [0, 1, 2]
        .into_iter()
        .flat_map(|hands| {
            let reduced = [false, true].into_iter().filter(move |own| !own || hands > 0);
            let all = std::iter::once((Elasticity::Linear, false));
            all.chain(reduced.map(|own| (Elasticity::Reduced, own)))
                .map(move |(kind, own)| (kind, hands, own))
        })
        .map(|(kind, hands, own)| Led::new(&model, kind, hands, own))
        .collect();
    let matrix = DMatrix::from_fn(128, 128, |i, j| ((i * 31 + j * 17) % 97) as f64);
    let mut products = Vec::new();
    // The surface of both kinds, of the same vertices.
    let mut surfaces = [Vec::new(), Vec::new()];
    let mut positions = model.surface().positions().to_vec();
    let mut shown = [bodies[0].body.clone(), bodies[1].body.clone()];
    for _ in 0..TURNS {
        for led in &mut bodies {
            (0..TURN).for_each(|_| led.step());
        }
        for (body, times) in shown.iter_mut().zip(&mut surfaces) {
            for _ in 0..8 {
                let begun = Instant::now();
                body.reconstruct(black_box(&mut positions)).unwrap();
                times.push(begun.elapsed().as_secs_f64() * 1e6);
            }
        }
        let begun = Instant::now();
        black_box(black_box(&matrix) * black_box(&matrix));
        products.push(begun.elapsed().as_secs_f64() * 1e6);
    }
    let product = at(&mut products, 0.5);
    println!("{} coordinates, {} surface vertices", model.mode_count(), positions.len());
    println!("a product of two matrices of 128 rows: {product:.1} us");
    println!(
        "{:<36} {:>8} {:>8} {:>8} {:>8} {:>9}",
        "a step, us", "p50", "p99", "p99.9", "/ linear", "/ product"
    );
    let mut linear = f64::NAN;
    for led in &mut bodies {
        let [p50, p99, p999] = [0.5, 0.99, 0.999].map(|share| at(&mut led.times, share));
        if led.name.starts_with("Linear") {
            linear = p50;
        }
        println!(
            "{:<36} {p50:>8.1} {p99:>8.1} {p999:>8.1} {:>8.1} {:>9.3}",
            led.name,
            p50 / linear,
            p50 / product
        );
    }
    let [warped, reduced] = surfaces.each_mut().map(|times| at(times, 0.5));
    println!("surface: {warped:.1} us warped, {reduced:.1} us reduced, both {:?}", Precision::default());
}
