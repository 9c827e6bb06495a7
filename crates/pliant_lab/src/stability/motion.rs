//! Motion without hands, and free bodies: energy and momentum.

use nalgebra::Vector3;
use pliant_modal::{Body, BodyConfig, Frame, GrabConfig, Integrator, Relaxation, StepSettings};

use super::{
    Bound, Case, CaseOutcome, Expected,
    bodies::{
        BarBody, Dice, HeldCase, RESTED, energy_growth, gain, nearest, no_growth, settling, state,
        static_pull,
    },
    material::word,
};
use crate::LabError;

/// What rounding may add in 100,000 steps, as a share, if it always adds: a spacing of numbers near
/// 1 in each.
const DRIFT: f64 = 1e5 * f64::EPSILON;

const FAR_AND_FAST: &str = "the held patch is lengths away from its rest: a pull there turns the warp's rows within a step of 1/60 s, and its work over the step is not what it was taken to be; at 1/240 s, or without the warp, the same start is quiet";

pub(super) fn cases(out: &mut Vec<Case>) {
    for seed in 1..=3 {
        for integrator in [Integrator::Exact, Integrator::Newmark] {
            let name = format!("seed {seed}, {}", word(integrator));
            out.push(Case::new("random velocities", name, move || random(seed, integrator)));
        }
    }
    for (name, shape) in [
        ("flattened to a fiftieth", [1.0, 0.02, 1.0]),
        ("flattened to nothing", [1.0, 0.0, 1.0]),
        ("inverted in height", [1.0, -1.0, 1.0]),
        ("inverted in length", [-1.0, 1.0, 1.0]),
        ("inverted thrice", [-1.0, -1.0, -1.0]),
        ("blown up tenfold", [10.0, 10.0, 10.0]),
    ] {
        out.push(Case::new("start", format!("{name}, let go"), move || {
            started(shape, false, true, 1.0 / 60.0)
        }));
        out.push(Case::new("start", format!("{name}, held where it is, no warp"), move || {
            started(shape, true, false, 1.0 / 60.0)
        }));
        for step in [1.0 / 60.0, 1.0 / 240.0] {
            let name = format!("{name}, held where it is, h {step:.4} s");
            let case = Case::new("start", name, move || started(shape, true, true, step));
            let limit = if step > 0.01 { far_and_fast(shape) } else { None };
            out.push(match limit {
                Some(expected) => case.limited(FAR_AND_FAST, expected),
                None => case,
            });
        }
    }
    for step in [1e-4, 1e-3, 1.0 / 60.0, 0.1] {
        out.push(Case::new("free flight", format!("h {step:.4} s, struck twice"), move || flight(step)));
    }
    for turns in [1.0, 10.0, 100.0] {
        for step in [1e-3, 1.0 / 60.0] {
            let name = format!("{turns} turns a second, h {step:.4} s");
            out.push(Case::new("free flight", name, move || spinning(turns, step)));
        }
    }
    for step in [1e-3, 1.0 / 60.0, 0.1] {
        out.push(Case::new(
            "free flight",
            format!("h {step:.4} s, two hands, every newton counted"),
            move || counted(step),
        ));
    }
    for ratio in [0.5, 0.9, 0.99] {
        for time in [1e-3, 0.1, 10.0] {
            let relaxation = Relaxation { ratio, time };
            out.push(Case::new("viscoelastic", format!("{ratio} relaxes in {time} s, struck"), move || {
                relaxing_energy(relaxation)
            }));
        }
        let relaxation = Relaxation { ratio, time: 0.1 };
        out.push(Case::new("viscoelastic", format!("{ratio} relaxes in 0.1 s, reaction held"), move || {
            relaxed_reaction(relaxation)
        }));
    }
    for (name, damped) in [("undamped", false), ("damped", true)] {
        out.push(Case::new("a million steps", format!("{name}, unforced"), move || {
            let bar = BarBody { modes: 6, zeta: if damped { 0.03 } else { 0.0 }, ..BarBody::default() };
            let mut body = Body::new(bar.bake()?, BodyConfig::default())?;
            let q = vec![1e-2; body.mode_count()];
            let v = vec![0.0; body.mode_count()];
            body.set_state(&state(&body, q, v))?;
            let [growth, left] = energy_growth(&mut body, 1_000_000)?;
            let drift = if damped { left } else { left - 1.0 };
            Ok(CaseOutcome::of(vec![
                no_growth(growth),
                Bound::new("energy gained in all / energy", drift.max(0.0), 1e6 * f64::EPSILON),
            ]))
        }));
    }
}

/// The known result at 1/60 s of a held start whose patch is lengths away from its rest: the body
/// is not at rest at the end.
fn far_and_fast(shape: [f64; 3]) -> Option<Expected> {
    let unrest = Expected::Measured(&[("kinetic energy at the end / energy at the start", 0.02, 0.2)]);
    (shape[0] > 1.0).then_some(unrest)
}

fn random(seed: u64, integrator: Integrator) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { zeta: 0.01, ..BarBody::default() };
    let mut body =
        Body::new(bar.bake()?, BodyConfig::from(StepSettings { integrator, ..Default::default() }))?;
    let mut dice = Dice(seed);
    let modes = body.mode_count();
    let speed = body.model().mass().sqrt() * body.model().size();
    let q = (0..modes).map(|_| dice.roll() * speed).collect();
    let v = (0..modes).map(|i| dice.roll() * speed * body.model().omega()[i]).collect();
    body.set_state(&state(&body, q, v))?;
    let [growth, _] = energy_growth(&mut body, 10_000)?;
    Ok(CaseOutcome::of(vec![no_growth(growth)]).stepped(&body))
}

/// Starts with the surface's points multiplied by `scale` about the middle of the held end, as
/// closely as the modes can represent that.
fn started(scale: [f64; 3], held: bool, warp: bool, step: f64) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { zeta: 0.05, ..BarBody::default() };
    let model = bar.bake()?;
    let middle = [0.0, 0.1, 0.1];
    let q = nearest(&model, |p| std::array::from_fn(|k| (scale[k] - 1.0) * (p[k] - middle[k])));
    let mut body = Body::new(
        model.clone(),
        BodyConfig { step, settings: StepSettings { warp, ..Default::default() }, ..BodyConfig::default() },
    )?;
    let v = vec![0.0; q.len()];
    body.set_state(&state(&body, q, v))?;
    let start = body.energy();
    if held {
        body.grab(&bar.tip(&model)?, GrabConfig::default())?;
    }
    let mut most = 0.0f64;
    for _ in 0..settling(&model, step) {
        body.step()?;
        most = most.max(body.energy() / start);
    }
    let mut last = [f64::INFINITY, 0.0];
    for _ in 0..60 {
        body.step()?;
        let kinetic = body.v().iter().map(|v| 0.5 * v * v).sum::<f64>();
        last = [last[0].min(kinetic), last[1].max(kinetic)];
    }
    Ok(CaseOutcome::of(vec![
        gain("largest energy / energy at the start - 1", most),
        Bound::new("kinetic energy at the end / energy at the start", last[1] / start, RESTED),
    ])
    .stepped(&body))
}

fn free(young: f64) -> BarBody {
    BarBody { held: None, young, modes: 12, zeta: 0.01, ..BarBody::default() }
}

fn flight(step: f64) -> Result<CaseOutcome, LabError> {
    let bar = free(1e6);
    let model = bar.bake()?;
    let mut body = Body::new(model.clone(), BodyConfig { step, ..BodyConfig::default() })?;
    body.apply_impulse(bar.vertex(&model, [1.0, 0.5, 0.5]), [3.0, 20.0, -7.0])?;
    body.apply_impulse(bar.vertex(&model, [0.0, 1.0, 0.0]), [-1.0, 4.0, 9.0])?;
    let momentum = |body: &Body| {
        let (p, l) = body.momentum();
        (Vector3::from(p), Vector3::from(l))
    };
    let (p0, l0) = momentum(&body);
    for _ in 0..100_000 {
        body.step()?;
    }
    let (p1, l1) = momentum(&body);
    let arm = Vector3::from(body.frame().center()).norm() * p1.norm();
    Ok(CaseOutcome::of(vec![
        Bound::new("linear momentum lost / momentum", (p1 - p0).norm() / p0.norm(), DRIFT),
        // Angular momentum is taken about the world's origin, from which the body is thousands of
        // lengths away by then.
        Bound::new("angular momentum lost / that of the flight", (l1 - l0).norm() / (l0.norm() + arm), DRIFT),
    ])
    .stepped(&body))
}

/// A tumble about an axis that is no principal axis, for 100,000 steps, must keep energy and
/// angular momentum.
fn spinning(turns: f64, step: f64) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { section: [0.2, 0.3], ..free(1e6) };
    let model = bar.bake()?;
    let mut body = Body::new(model.clone(), BodyConfig { step, ..BodyConfig::default() })?;
    let axis = Vector3::new(0.3, 1.0, 0.2).normalize() * turns * std::f64::consts::TAU;
    let inertia = model.inertia();
    let spin: [f64; 3] = std::array::from_fn(|i| (0..3).map(|k| inertia[i][k] * axis[k]).sum());
    let mut state = body.state().clone();
    state.frame = Frame::from_motion(&model, model.center_of_mass(), [0.0, 0.0, 0.0, 1.0], [0.0; 3], spin)?;
    body.set_state(&state)?;
    let start = body.energy();
    let spin = Vector3::from(spin);
    let (mut gained, mut lost) = (0.0f64, 0.0f64);
    for _ in 0..100_000 {
        body.step()?;
        gained = gained.max(body.energy() / start - 1.0);
        lost = lost.max((Vector3::from(body.frame().spin()) - spin).norm() / spin.norm());
    }
    Ok(CaseOutcome::of(vec![
        Bound::new("largest gain of the spin's energy / energy", gained, DRIFT),
        Bound::new("angular momentum lost / momentum", lost, DRIFT),
    ])
    .stepped(&body))
}

/// The change of momentum must equal the impulse of the two hands.
fn counted(step: f64) -> Result<CaseOutcome, LabError> {
    let bar = free(1e6);
    let model = bar.bake()?;
    let mut body = Body::new(model.clone(), BodyConfig { step, ..BodyConfig::default() })?;
    let a = body.grab(&bar.tip(&model)?, GrabConfig::default())?;
    let other = pliant_modal::Patch::around(model.surface(), bar.vertex(&model, [0.0, 0.5, 0.5]), 0.12)?;
    let b = body.grab(&other, GrabConfig::default())?;
    let (mut worst, mut largest, mut farthest) = (0.0f64, 0.0f64, 0.0f64);
    for i in 0..2_000 {
        let t = f64::from(i) * step;
        let targets = [[1.0 + 0.5 * t.sin(), 0.3, 0.1 * t.sin()], [-0.5, 0.2 * t.cos(), 0.0]];
        for (grab, target) in [a, b].into_iter().zip(targets) {
            body.set_target(grab, target)?;
            farthest = farthest.max(Vector3::from(target).norm());
        }
        let before = Vector3::from(body.momentum().0);
        body.step()?;
        let change = (Vector3::from(body.momentum().0) - before) / step;
        let pulls = [a, b].map(|g| body.reaction(g).map(Vector3::from));
        let [ra, rb] = pulls;
        let (ra, rb) = (ra?, rb?);
        let scale = ra.norm() + rb.norm();
        if scale > 1e-9 {
            worst = worst.max((change + ra + rb).norm() / scale);
        }
        largest = largest.max(Vector3::from(body.frame().center()).norm());
    }
    Ok(CaseOutcome::of(vec![
        Bound::new("|momentum's change - hands' pulls| / pulls", worst, 1e-12),
        // Twice as far as a hand ever is: overshoot is physical.
        Bound::new("farthest from the origin / the hands' farthest", largest / farthest, 2.0),
    ])
    .stepped(&body))
}

fn relaxing_energy(relaxation: Relaxation) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { zeta: 0.0, ..BarBody::default() };
    let model = bar.bake()?;
    let mut body = Body::new(
        model.clone(),
        BodyConfig::from(StepSettings { relaxation: Some(relaxation), ..Default::default() }),
    )?;
    let impulse = 0.05 * model.omega()[0] * model.mass();
    body.apply_impulse(bar.vertex(&model, [1.0, 0.5, 0.5]), [0.3 * impulse, impulse, -0.7 * impulse])?;
    let [growth, _] = energy_growth(&mut body, 5_000)?;
    Ok(CaseOutcome::of(vec![no_growth(growth)]).stepped(&body))
}

/// After a long hold, `1 - ratio` of the reaction must be left.
fn relaxed_reaction(relaxation: Relaxation) -> Result<CaseOutcome, LabError> {
    let bar = BarBody { zeta: 0.3, ..BarBody::default() };
    let elastic = HeldCase::new(&bar, BodyConfig::default(), GrabConfig::default())?;
    let away = [0.0, 1e-6, 0.5e-6];
    let want = (1.0 - relaxation.ratio) * static_pull(&elastic, away)?;
    let config = BodyConfig::from(StepSettings { relaxation: Some(relaxation), ..Default::default() });
    let mut held = HeldCase::new(&bar, config, GrabConfig::default())?;
    held.pull(away)?;
    let slow = 12.0 * relaxation.time / (1.0 - relaxation.ratio) * 60.0;
    for _ in 0..settling(&held.model, 1.0 / 60.0) + slow as usize {
        held.body.step()?;
    }
    let got = -held.reaction()?;
    Ok(CaseOutcome::of(vec![Bound::new(
        "|reaction - relaxed| / relaxed",
        (got - want).norm() / want.norm(),
        2e-4,
    )])
    .stepped(&held.body))
}
