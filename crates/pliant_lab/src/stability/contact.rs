//! Bodies that fall, slide, are thrown, are squeezed, and touch obstacles that tell nonsense.

use std::{f64::consts::FRAC_PI_4, sync::Arc};

use nalgebra::Vector3;
use pliant_modal::{
    Body, BodyConfig, Elasticity, Material, ModalModel, ObstacleShape, Plane, StepError, StepSettings,
    SurfacePoint,
};

use super::{
    Bound, Case, CaseOutcome, Expected,
    bodies::{BarBody, gain, largest},
};
use crate::{
    LabError,
    drop::{Drop, DropTick, Onto, drop},
};

const GRAVITY: f64 = 9.81;

const DEPTH: &str = "largest penetration / size";

const SINKS: &str = "|how far the center sinks / that of a column under its own weight - 1|";

const YIELDS: &str = "sites of a face yield one by one, each with what it yields besides the modes for its own, so that a whole face that stands on the ground is too soft (docs/limits.md)";

pub(super) fn cases(out: &mut Vec<Case>) {
    let group = "contact";
    for elasticity in [Elasticity::Linear, Elasticity::Reduced] {
        for young in [1e4, 1e5, 1e7, 1e9] {
            for rate in [40.0, 60.0, 240.0, 1000.0] {
                let name = format!("{elasticity}, E {young:.0e} Pa, falls, {rate} Hz");
                let case = Case::new(group, name, move || falls(elasticity, young, rate));
                // Neither the stiffness nor the step enters, but for what is left of the fall.
                out.push(case.limited(
                    YIELDS,
                    Expected::Measured(match elasticity {
                        Elasticity::Linear => &[(SINKS, 1.35, 1.72)],
                        Elasticity::Reduced => &[(SINKS, 1.55, 1.87)],
                    }),
                ));
            }
        }
        for rate in [60.0, 240.0] {
            let name = format!("{elasticity}, falls onto a ball, {rate} Hz");
            out.push(Case::new(group, name, move || onto_ball(elasticity, rate)));
            let name = format!("{elasticity}, 50 m/s, {rate} Hz");
            out.push(Case::new(group, name, move || thrown(elasticity, rate)));
            let name = format!("{elasticity}, walls half its height apart, {rate} Hz");
            out.push(Case::new(group, name, move || squeezed(elasticity, rate)));
        }
        for (tilt, word) in [(20.0, "stays"), (40.0, "slides")] {
            let name = format!("{elasticity}, {word} on a slope of {tilt} degrees");
            out.push(Case::new(group, name, move || slope(elasticity, tilt)));
        }
    }
    for nonsense in [
        Nonsense::Distance(f64::NAN),
        Nonsense::Distance(f64::NEG_INFINITY),
        Nonsense::Normal,
        Nonsense::Velocity,
    ] {
        out.push(Case::new(group, format!("an obstacle tells {}", nonsense.name()), move || {
            obstacle_of(nonsense)
        }));
    }
}

/// A free block of the matrix' bar.
fn block(young: f64, zeta: f64, elasticity: Elasticity) -> BarBody {
    BarBody {
        cells: [4, 3, 3],
        length: 0.2,
        section: [0.6, 0.6],
        modes: 24,
        young,
        zeta,
        held: None,
        material: (elasticity == Elasticity::Reduced).then_some(Material::NeoHookean),
        ..BarBody::default()
    }
}

fn energy(tick: &DropTick) -> f64 {
    tick.kinetic + tick.elastic + tick.potential
}

/// The energy never exceeds that at the start, and rises from a step to the next by as little as
/// the stored energy of the dents is uncertain where the contacts change.
fn no_gain(ticks: &[DropTick], step: f64) -> Vec<Bound> {
    let start = ticks.first().map_or(f64::NAN, energy);
    let most = largest(ticks.iter().map(energy));
    let rise = largest(ticks.windows(2).map(|w| (energy(&w[1]) - energy(&w[0])) / start));
    vec![
        gain("largest energy / energy at the start - 1", most / start),
        Bound::new("largest rise of the energy in a step / energy at the start", rise, step),
    ]
}

fn outcome(ticks: &[DropTick], mut bounds: Vec<Bound>) -> CaseOutcome {
    bounds.extend(no_gain(ticks, 3e-4));
    CaseOutcome::of(bounds)
}

fn deepest(ticks: &[DropTick]) -> f64 {
    largest(ticks.iter().map(|t| t.penetration))
}

/// The block falls by half its length and comes to rest. The ground then carries its weight.
fn falls(elasticity: Elasticity, young: f64, rate: f64) -> Result<CaseOutcome, LabError> {
    let model = block(young, 0.3, elasticity).bake()?;
    // The softest swings on its ground, twice a second.
    let seconds = if young < 1e5 { 16.0 } else { 4.0 };
    let fall = Drop { height: 0.1, rate, seconds, elasticity: Some(elasticity), ..Drop::default() };
    let fallen = drop(&model, &fall)?;
    let last = &fallen.ticks[fallen.ticks.len() - fallen.ticks.len() / 8..];
    let force = last.iter().map(|t| t.contact_force[1]).sum::<f64>() / last.len() as f64;
    let center = |t: Option<&DropTick>| t.map_or(f64::NAN, |t| t.center[1]);
    let height = 0.6 * 0.2;
    let sunk = 0.5 * height - center(fallen.ticks.last());
    // What is at height y of a column that stands on its face comes down by
    // `rho g (H y - y^2 / 2) / E`, and the center by the mean of it.
    let column = 1000.0 * GRAVITY * height * height / (3.0 * young);
    Ok(outcome(
        &fallen.ticks,
        vec![
            Bound::new("|force at rest / weight - 1|", force / (fallen.mass * GRAVITY) - 1.0, 1e-4),
            // The block is as broad as high, its face rubs on the ground, and the softest is
            // pressed by a tenth: a full solution is not quite that of a column.
            Bound::new(SINKS, sunk / column - 1.0, 0.2),
            Bound::new(DEPTH, deepest(last) / fallen.size, 1e-5),
        ],
    ))
}

/// The block falls onto a ball of its own size and off it.
fn onto_ball(elasticity: Elasticity, rate: f64) -> Result<CaseOutcome, LabError> {
    let model = block(1e5, 0.1, elasticity).bake()?;
    let radius = 0.1;
    let onto = Onto::Sphere(radius);
    let fall =
        Drop { height: 0.2, rate, seconds: 1.0, onto, elasticity: Some(elasticity), ..Drop::default() };
    let fallen = drop(&model, &fall)?;
    let [x, _, z] = model.center_of_mass();
    let away = |t: &DropTick| (Vector3::from(t.center) - Vector3::new(x, -radius, z)).norm();
    let nearest = fallen.ticks.iter().map(away).fold(f64::INFINITY, f64::min);
    Ok(outcome(
        &fallen.ticks,
        vec![
            Bound::new(
                "how far the center comes into the ball / radius",
                (1.0 - nearest / radius).max(0.0),
                1e-6,
            ),
            Bound::new(DEPTH, deepest(&fallen.ticks) / fallen.size, 1e-5),
        ],
    ))
}

/// The block falls from so high that it comes with 50 m/s, half the speed of sound in it.
fn thrown(elasticity: Elasticity, rate: f64) -> Result<CaseOutcome, LabError> {
    let model = block(1e7, 0.1, elasticity).bake()?;
    let fall = Drop {
        height: 50.0 * 50.0 / (2.0 * GRAVITY),
        rate,
        seconds: 6.0,
        elasticity: Some(elasticity),
        ..Drop::default()
    };
    let fallen = drop(&model, &fall)?;
    let lowest = fallen.ticks.iter().map(|t| t.center[1]).fold(f64::INFINITY, f64::min);
    Ok(outcome(
        &fallen.ticks,
        vec![
            Bound::new(
                "how far the center goes below the ground / size",
                (-lowest / fallen.size).max(0.0),
                1e-6,
            ),
            Bound::new(DEPTH, deepest(&fallen.ticks) / fallen.size, 4e-4),
        ],
    ))
}

/// A slope below and one above the angle of friction (a coefficient of one half: 26.6 degrees).
fn slope(elasticity: Elasticity, tilt: f64) -> Result<CaseOutcome, LabError> {
    let model = block(1e6, 0.3, elasticity).bake()?;
    let friction = 0.5;
    let fall = Drop {
        height: 0.0,
        tilt,
        friction,
        seconds: 2.0,
        rate: 240.0,
        elasticity: Some(elasticity),
        ..Drop::default()
    };
    let fallen = drop(&model, &fall)?;
    let at = |share: f64| {
        let index = ((fallen.ticks.len() - 1) as f64 * share) as usize;
        fallen.ticks.get(index).copied().unwrap_or_default()
    };
    let (first, last) = (at(0.5), at(1.0));
    let angle = tilt.to_radians();
    let moved = (Vector3::from(last.center) - Vector3::from(first.center)).norm();
    let faster = (Vector3::from(last.velocity) - Vector3::from(first.velocity)).norm();
    let slides = angle.tan() > friction;
    let measured = if slides {
        let want = GRAVITY * (angle.sin() - friction * angle.cos());
        Bound::new(
            "|acceleration / that of Coulomb's law - 1|",
            faster / (last.time - first.time) / want - 1.0,
            1e-9,
        )
    } else {
        Bound::new("way of the second second / size", moved / fallen.size, 1e-10)
    };
    // A block that stays changes no contact.
    let mut bounds = vec![measured];
    bounds.extend(no_gain(&fallen.ticks, if slides { 3e-4 } else { 1e-8 }));
    Ok(CaseOutcome::of(bounds))
}

fn body(model: &Arc<ModalModel>, elasticity: Elasticity, rate: f64) -> Result<Body, LabError> {
    let settings = StepSettings { elasticity, gravity: [0.0, -GRAVITY, 0.0], ..StepSettings::default() };
    Ok(Body::new(model.clone(), BodyConfig { step: 1.0 / rate, ..settings.into() })?)
}

/// Two walls appear within the body, half its height apart. It must come out or stay between them
/// without being shot away.
fn squeezed(elasticity: Elasticity, rate: f64) -> Result<CaseOutcome, LabError> {
    let young = 1e5;
    let model = block(young, 0.1, elasticity).bake()?;
    let mut body = body(&model, elasticity, rate)?;
    let (middle, half) = (model.center_of_mass()[1], 0.25 * 0.6 * 0.2);
    let wall = |side: f64| -> Arc<dyn ObstacleShape> {
        Arc::new(Plane { point: [0.0, middle + side * half, 0.0], normal: [0.0, -side, 0.0] })
    };
    body.set_obstacles(vec![wall(-1.0), wall(1.0)])?;
    let sound = (young / 1000.0).sqrt();
    let mut fastest = 0.0f64;
    for _ in 0..(2.0 * rate) as usize {
        body.step()?;
        fastest = fastest.max((2.0 * body.kinetic_energy() / model.mass()).sqrt());
    }
    let away = (Vector3::from(body.frame().center()) - Vector3::from(model.center_of_mass())).norm();
    // A penetration is taken back at half the size a second, which is 0.01 here; the mean over the
    // body is less. A reduced body that steps as seldom as this snaps once.
    let most = if elasticity == Elasticity::Reduced && rate < 100.0 { 0.03 } else { 0.008 };
    Ok(CaseOutcome::of(vec![
        Bound::new("fastest rms speed / speed of sound", fastest / sound, most),
        Bound::new("how far the center goes / size", away / model.size(), 0.006),
    ]))
}

/// Results of an obstacle that no real obstacle can give.
#[derive(Debug, Clone, Copy)]
enum Nonsense {
    Distance(f64),
    Normal,
    Velocity,
}

impl Nonsense {
    fn name(self) -> String {
        match self {
            Self::Distance(distance) => format!("a distance of {distance}"),
            Self::Normal => "a normal that is not a number".to_owned(),
            Self::Velocity => "an endless velocity".to_owned(),
        }
    }
}

impl ObstacleShape for Nonsense {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let ground = SurfacePoint { distance: point.y, normal: Vector3::y() };
        match *self {
            Self::Distance(distance) => SurfacePoint { distance, ..ground },
            Self::Normal => SurfacePoint { normal: Vector3::repeat(f64::NAN), ..ground },
            Self::Velocity => ground,
        }
    }

    fn velocity(&self, _: &Vector3<f64>) -> Vector3<f64> {
        match self {
            Self::Velocity => Vector3::repeat(f64::INFINITY),
            _ => Vector3::zeros(),
        }
    }
}

/// Each step in which the obstacle is asked is refused by name, and nothing moves in it.
fn obstacle_of(nonsense: Nonsense) -> Result<CaseOutcome, LabError> {
    let model = block(1e5, 0.1, Elasticity::Linear).bake()?;
    let mut body = body(&model, Elasticity::Linear, 60.0)?;
    let (sin, cos) = (0.5 * FRAC_PI_4).sin_cos();
    body.set_pose([0.0, 0.02, 0.0], [0.0, 0.0, sin, cos])?;
    body.set_obstacles(vec![Arc::new(nonsense)])?;
    let asked_late = matches!(nonsense, Nonsense::Velocity);
    let (mut odd, mut moved, mut refused) = (0.0, 0.0, 0);
    for _ in 0..120 {
        let before = body.state().clone();
        match body.step() {
            Err(StepError::Input { .. }) => {
                refused += 1;
                moved += f64::from(u8::from(*body.state() != before));
            }
            // An obstacle is asked how fast it is where it touches.
            Ok(_) if asked_late && body.contacts().contacts().is_empty() => {}
            _ => odd += 1.0,
        }
    }
    Ok(CaseOutcome::of(vec![
        Bound::new("steps with it that were not refused by name", odd, 0.5),
        Bound::new("runs in which nothing was refused", f64::from(u8::from(refused == 0)), 0.5),
        Bound::new("refused steps in which something moved", moved, 0.5),
    ]))
}
