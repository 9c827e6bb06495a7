//! A step with contacts, beside a step without and a factorization of a dense matrix of as many
//! unknowns, in the same run.
//!
//! `cargo bench -p pliant_bake --bench contacts`
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench may stop")]

use std::{hint::black_box, sync::Arc, time::Instant};

use nalgebra::{DMatrix, UnitQuaternion, Vector3};
use pliant_bake::{BakeConfig, bake};
use pliant_mesh::shapes;
use pliant_modal::{Body, BodyConfig, Frame, ModalModel, Plane, StepSettings};

const GRAVITY: f64 = 9.81;

/// A free block of 60 coordinates, with `cells` hexahedra along each edge of 25 mm.
fn block(cells: [usize; 3]) -> Arc<ModalModel> {
    let mesh = shapes::bar(cells, cells.map(|count| 0.025 * count as f64)).unwrap();
    let config = BakeConfig { modes: 54, young: 1e5, sites: Some(100), ..BakeConfig::linear() };
    Arc::new(bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model)
}

/// The block on the ground, which gravity pulls along it by `pull` of the weight.
fn on_ground(model: &Arc<ModalModel>, pull: f64) -> Body {
    let gravity = [pull * GRAVITY, -GRAVITY, 0.0];
    let settings = StepSettings { gravity, ..StepSettings::default() };
    let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / 60.0, ..settings.into() }).unwrap();
    body.set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
    body
}

/// Half and 99 percent of the durations, us, and the mean number of contacts and of rounds.
struct Measured {
    median: f64,
    p99: f64,
    contacts: f64,
    rounds: f64,
}

/// Measures the steps of a body. `again` may put it back before each.
fn measure(body: &mut Body, steps: usize, again: impl Fn(&mut Body, usize)) -> Measured {
    let mut all = Vec::with_capacity(steps);
    let (mut contacts, mut rounds) = (0, 0);
    for number in 0..steps {
        again(body, number);
        let start = Instant::now();
        body.step().unwrap();
        all.push(start.elapsed().as_secs_f64() * 1e6);
        contacts += body.contacts().report().contacts;
        rounds += body.contacts().report().rounds;
    }
    all.sort_by(f64::total_cmp);
    let mean = |sum: usize| sum as f64 / steps as f64;
    Measured {
        median: all[steps / 2],
        p99: all[steps * 99 / 100],
        contacts: mean(contacts),
        rounds: mean(rounds),
    }
}

fn main() {
    let matrix = DMatrix::from_fn(60, 60, |i, j| if i == j { 2.0 } else { 1.0 / (1.0 + (i + j) as f64) });
    println!(
        "contacts  what             mean contacts  rounds  median us  p99 us  of a free step  of a Cholesky"
    );
    for (count, cells) in [(10, [4, 4, 1]), (50, [9, 4, 4])] {
        let model = block(cells);
        let free = measure(
            &mut Body::new(model.clone(), StepSettings::default().into()).unwrap(),
            20_000,
            |_, _| (),
        );
        let mut factors: Vec<f64> = (0..5_000)
            .map(|_| {
                let copy = black_box(matrix.clone());
                let start = Instant::now();
                black_box(copy.cholesky());
                start.elapsed().as_secs_f64() * 1e6
            })
            .collect();
        factors.sort_by(f64::total_cmp);
        let factor = factors[factors.len() / 2];
        let mut all = Vec::new();
        let mut rests = on_ground(&model, 0.0);
        for _ in 0..300 {
            rests.step().unwrap();
        }
        all.push(("rests", measure(&mut rests, 5_000, |_, _| ())));
        let mut slides = on_ground(&model, 0.8);
        for _ in 0..60 {
            slides.step().unwrap();
        }
        all.push(("slides", measure(&mut slides, 2_000, |_, _| ())));
        // It falls again and again, tilted another way each time.
        let mut falls = on_ground(&model, 0.0);
        let lowest = f64::from(model.surface().bounds()[0][1]);
        let again = |body: &mut Body, number: usize| {
            if !number.is_multiple_of(40) {
                return;
            }
            let turn = UnitQuaternion::from_scaled_axis(Vector3::new(
                0.02 * ((number / 40) % 5) as f64,
                0.0,
                0.02 * ((number / 40) % 7) as f64,
            ));
            let mut state = body.state().clone();
            let mut center = model.center_of_mass();
            center[1] += 0.01 - lowest;
            let turn = [turn.i, turn.j, turn.k, turn.w];
            state.frame = Frame::from_motion(&model, center, turn, [0.0, -0.5, 0.0], [0.0; 3]).unwrap();
            state.q.fill(0.0);
            state.v.fill(0.0);
            body.set_state(&state).unwrap();
        };
        all.push(("falls and lands", measure(&mut falls, 4_000, again)));
        for (what, measured) in all {
            println!(
                "{count:>8}  {what:<15}  {:>13.1}  {:>6.2}  {:>9.2}  {:>6.1}  {:>14.1}  {:>13.2}",
                measured.contacts,
                measured.rounds,
                measured.median,
                measured.p99,
                measured.median / free.median,
                measured.median / factor,
            );
        }
        println!("          free step: {:.2} us, Cholesky factor of 60 x 60: {factor:.2} us", free.median);
    }
}
