//! What a hand feels that takes hold of a body and leads it slowly to another place.

use std::{sync::Arc, time::Instant};

use nalgebra::{Matrix3, Vector3};
use pliant_modal::{
    Body, BodyConfig, Elasticity, GrabConfig, Material, ModalModel, ModelError, Patch, StepSettings,
};
use serde::Serialize;

use crate::{
    LabError,
    bench::{Percentiles, percentiles},
    machine::Pinned,
};

/// Time in which the hand goes its whole way, s.
const LEAD: f64 = 4.0;

/// Longest time for the body to come to rest, s.
const REST: f64 = 200.0;

/// Least number of timed steps, enough for the 99.9th percentile.
const TIMED: usize = 4_000;

/// A pull to measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pull {
    /// Point near the surface, m, in the model's axes. The patch lies around the closest vertex.
    pub at: [f64; 3],
    /// Radius of the patch, m.
    pub radius: f64,
    /// Way of the hand, m.
    pub by: [f64; 3],
    /// Elasticity of the body. `None`: reduced if the model has a material, linear otherwise.
    pub elasticity: Option<Elasticity>,
    /// Gravity, m/s^2, in the model's axes. The hand takes hold of the straight body.
    pub gravity: [f64; 3],
}

/// What the hand feels at the end of its way, when the body is at rest.
#[derive(Serialize, Debug, Clone)]
pub struct Pulled {
    /// Mean rest position of the patch by its weights, m.
    pub patch: [f64; 3],
    /// Rest positions of the patch's vertices, m.
    pub vertices: Vec<[f64; 3]>,
    /// Weights of these vertices. Their sum is 1.
    pub weights: Vec<f64>,
    /// Way of the patch, m. It is shorter than that of the hand where the hand is farther away than
    /// the body's size, because it then pulls no harder.
    pub moved: [f64; 3],
    /// Force on the hand, N, in the model's axes.
    pub reaction: [f64; 3],
    /// Elastic energy, J.
    pub energy: f64,
    /// Time of one step on one core.
    pub step_us: Percentiles,
    /// Elasticity of the body: `linear`, which is modes with modal warping, or `reduced`.
    pub elasticity: Elasticity,
    /// Material of the reduced elasticity. `None` with linear elasticity.
    pub material: Option<Material>,
    /// Longest time in which the own shapes of the held patch were made, ms. They are made anew as
    /// the hand goes on. `None` without such shapes: with linear elasticity, and for a model
    /// without its simulation mesh.
    pub shapes_ms: Option<f64>,
    /// Whether the body came to rest: whether its speeds and the change of the force fell below a
    /// millionth of what they were.
    pub at_rest: bool,
    /// Surface at rest in the model's axes, m.
    #[serde(skip)]
    pub surface: Vec<[f32; 3]>,
}

/// Takes hold of a patch, leads it slowly along `by`, and waits until the body is at rest.
///
/// Inertia does not matter for the result: whenever the kinetic energy of the body falls, its
/// velocities are set to zero (dynamic relaxation with kinetic damping: Cundall 1976, Barnes 1999).
///
/// # Errors
/// Returns [`LabError::Free`] for a body without anchors, [`LabError::Far`] for a point that is
/// farther from the surface than the body is large, and [`LabError::NoMaterial`] for reduced
/// elasticity of a model that has no material. Returns [`LabError::Model`] or
/// [`LabError::Step`] when the body cannot be grabbed or stepped, or when a number is out of its
/// range.
pub fn pull(model: &Arc<ModalModel>, pull: &Pull) -> Result<Pulled, LabError> {
    if model.is_free() {
        return Err(LabError::Free);
    }
    if let Some(&got) = pull.at.iter().find(|x| !x.is_finite()) {
        let expected = "finite meters";
        return Err(ModelError::Value { what: "point of the pull", index: 0, expected, got }.into());
    }
    let _pinned = Pinned::new();
    let elasticity = crate::elasticity_of(model, pull.elasticity)?;
    let config =
        BodyConfig::from(StepSettings { elasticity, gravity: pull.gravity, ..StepSettings::default() });
    let step = config.step;
    let mut body = Body::new(model.clone(), config)?;
    let positions = model.surface().positions();
    let away = |v: u32| (0..3).map(|k| (f64::from(positions[v as usize][k]) - pull.at[k]).powi(2)).sum();
    let distance: Vec<f64> = (0..positions.len() as u32).map(away).collect();
    let closest = (0..distance.len()).min_by(|&a, &b| distance[a].total_cmp(&distance[b])).unwrap_or(0);
    // Such a point was most likely given in another unit.
    let far = distance.get(closest).map_or(f64::INFINITY, |d2: &f64| d2.sqrt());
    if far > model.size() {
        return Err(LabError::Far { away: far, size: model.size() });
    }
    let patch = Patch::around(model.surface(), closest as u32, pull.radius)?;
    let grab = body.grab(&patch, GrabConfig::default())?;
    let mut shapes_ms: Option<f64> = None;
    let mut shape = |body: &mut Body| {
        let begun = Instant::now();
        let changed = body.make_held_shapes()?;
        if changed {
            let took = begun.elapsed().as_secs_f64() * 1e3;
            shapes_ms = Some(shapes_ms.map_or(took, |most| most.max(took)));
        }
        Ok::<_, LabError>(changed)
    };
    let start = Vector3::from(body.grab_position(grab)?);
    let by = Vector3::from(pull.by);

    let mut times = Vec::new();
    let mut timed = |body: &mut Body, part: f64| {
        // Steps with other shapes take another time.
        if shape(body)? {
            times.clear();
        }
        body.set_target(grab, (start + part * by).into())?;
        let begun = Instant::now();
        body.step()?;
        times.push(begun.elapsed().as_secs_f64() * 1e6);
        Ok::<_, LabError>(())
    };
    let lead = (LEAD / step) as usize;
    for i in 1..=lead {
        timed(&mut body, i as f64 / lead as f64)?;
    }
    let kinetic = |body: &Body| 0.5 * body.v().iter().map(|v| v * v).sum::<f64>();
    let (mut before, mut fastest, mut at_rest) = (0.0, kinetic(&body), false);
    let mut calm = 0;
    let mut last = Vector3::from(body.reaction(grab)?);
    for _ in 0..(REST / step) as usize {
        timed(&mut body, 1.0)?;
        let now = kinetic(&body);
        let force = Vector3::from(body.reaction(grab)?);
        fastest = f64::max(fastest, now);
        // Speeds are the roots of energies.
        let slow = now <= 1e-12 * fastest.max(1e-12 * body.energy());
        let steady = (force - last).norm() <= 1e-6 * force.norm() * step;
        calm = if slow && steady { calm + 1 } else { 0 };
        if calm >= 10 {
            at_rest = true;
            break;
        }
        if now < before {
            let mut state = body.state().clone();
            state.v.fill(0.0);
            body.set_state(&state)?;
            before = 0.0;
        } else {
            before = now;
        }
        last = force;
    }
    while times.len() < TIMED {
        let begun = Instant::now();
        body.step()?;
        times.push(begun.elapsed().as_secs_f64() * 1e6);
    }

    let reaction = Vector3::from(body.reaction(grab)?);
    let soft = body.compliance(grab)?;
    let soft = Matrix3::from_fn(|i, j| soft[i][j]);
    // The patch gives way further than the modes say, by its residual flexibility.
    let local = soft * -reaction;
    let moved = Vector3::from(body.grab_position(grab)?) + local - start;
    let mut surface = positions.to_vec();
    body.reconstruct(&mut surface)?;
    let (vertices, weights) =
        patch.entries().iter().map(|&(v, weight)| (positions[v as usize].map(f64::from), weight)).unzip();
    Ok(Pulled {
        patch: start.into(),
        vertices,
        weights,
        moved: moved.into(),
        reaction: reaction.into(),
        energy: body.energy() - 0.5 * local.dot(&reaction),
        step_us: percentiles(times),
        elasticity,
        material: if elasticity == Elasticity::Reduced { model.material() } else { None },
        shapes_ms,
        at_rest,
        surface,
    })
}
