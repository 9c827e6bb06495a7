//! Reduced elasticity: hands that jerk, fold, press and tear a body, at any stiffness and step.

use nalgebra::Vector3;
use pliant_modal::{
    Body, BodyConfig, Elasticity, GrabConfig, GrabId, Integrator, Material, Patch, StepSettings,
};

use super::{
    Bound, Case, CaseOutcome,
    bodies::{BarBody, RESTED, gain, nearest, ringing, settling, state},
};
use crate::LabError;

/// A hand: its place in shares of the bar's edges, and its way in lengths.
type Jerk = ([f64; 3], [f64; 3]);

/// Most steps of a case. A step takes longer than one of linear elasticity.
const MAX_STEPS: usize = 5_000;

const END: [f64; 3] = [1.0, 0.5, 0.5];

pub(super) fn cases(out: &mut Vec<Case>) {
    for young in [1e3, 1e5, 1e7, 1e9] {
        for step in [1e-3, 1.0 / 240.0, 1.0 / 60.0, 0.025] {
            let name = format!("E {young:.0e}, h {step:.4} s, jerked by half a length");
            out.push(Case::new("reduced", name, move || {
                jerked(Material::NeoHookean, young, step, true, &[(END, [0.1, 0.5, 0.0])])
            }));
        }
    }
    for material in [Material::NeoHookean, Material::StVenantKirchhoff] {
        for (name, free, hands) in [
            ("folded", false, vec![(END, [-0.8, 0.2, 0.0])]),
            ("pressed to half its length", false, vec![(END, [-0.5, 0.0, 0.0])]),
            ("stretched by half", false, vec![(END, [0.5, 0.0, 0.0])]),
            (
                "two hands that shear",
                false,
                vec![(END, [0.0, 0.2, 0.0]), ([0.7, 1.0, 0.5], [0.0, -0.2, 0.0])],
            ),
            ("torn apart by 70 %", true, vec![([0.0, 0.5, 0.5], [-0.35, 0.0, 0.0]), (END, [0.35, 0.0, 0.0])]),
            (
                "turned by a right angle",
                true,
                vec![([0.0, 0.5, 0.5], [0.5, 0.5, 0.0]), (END, [-0.5, -0.5, 0.0])],
            ),
        ] {
            for step in [1.0 / 240.0, 1.0 / 60.0] {
                let hands = hands.clone();
                out.push(Case::new("reduced", format!("{material}, {name}, h {step:.4} s"), move || {
                    jerked(material, 1e5, step, !free, &hands)
                }));
            }
        }
    }
    for (name, shape) in
        [("flattened to nothing", [1.0, 0.0, 1.0]), ("inside out", [1.0, -1.0, 1.0]), ("threefold", [3.0; 3])]
    {
        for step in [1.0 / 240.0, 1.0 / 60.0] {
            out.push(Case::new("reduced", format!("starts {name}, h {step:.4} s"), move || {
                started(shape, step)
            }));
        }
    }
}

fn bar(material: Material, young: f64, held: bool) -> BarBody {
    BarBody {
        cells: [6, 2, 2],
        section: [0.3, 0.3],
        modes: 24,
        young,
        held: held.then_some(1e-9),
        material: Some(material),
        ..BarBody::default()
    }
}

fn body(bar: &BarBody, step: f64) -> Result<Body, LabError> {
    // The integrator is that of linear elasticity and has no effect.
    let settings = StepSettings {
        elasticity: Elasticity::Reduced,
        integrator: Integrator::Newmark,
        ..StepSettings::default()
    };
    Ok(Body::new(bar.bake()?, BodyConfig { step, ..settings.into() })?)
}

/// Lets hands jump, keeps them there until the body has come to rest, and lets go.
fn jerked(
    material: Material,
    young: f64,
    step: f64,
    held: bool,
    hands: &[Jerk],
) -> Result<CaseOutcome, LabError> {
    let bar = bar(material, young, held);
    let mut body = body(&bar, step)?;
    let model = body.model().clone();
    let mut grabs: Vec<GrabId> = Vec::new();
    for (place, way) in hands {
        let patch = Patch::around(model.surface(), bar.vertex(&model, *place), 0.15)?;
        let grab = body.grab(&patch, GrabConfig::default())?;
        let from = body.target(grab)?;
        body.set_target(grab, std::array::from_fn(|k| from[k] + way[k] * bar.length))?;
        grabs.push(grab);
    }
    let steps = settling(&model, step).min(MAX_STEPS);
    let mut forces = Vec::with_capacity(steps);
    for _ in 0..steps {
        body.step()?;
        forces.push(Vector3::from(body.reaction(grabs[0])?));
    }
    let ringing = ringing(&forces[steps * 3 / 4..]);
    let before = body.energy();
    grabs.into_iter().for_each(|grab| body.release(grab));
    let mut most = 0.0f64;
    for _ in 0..steps {
        body.step()?;
        most = most.max(body.energy() / before);
    }
    Ok(CaseOutcome::of(vec![
        // A free body goes on turning between its hands.
        Bound::new("second difference of the force / force", ringing, if held { 5e-3 } else { 0.03 }),
        gain("largest energy / energy at the release - 1", most),
    ])
    .stepped(&body))
}

/// Starts from a scaled shape and lets go.
fn started(shape: [f64; 3], step: f64) -> Result<CaseOutcome, LabError> {
    let bar = bar(Material::NeoHookean, 1e5, true);
    let mut body = body(&bar, step)?;
    let model = body.model().clone();
    let middle = [0.0, 0.15, 0.15];
    let q = nearest(&model, |p| std::array::from_fn(|k| (shape[k] - 1.0) * (p[k] - middle[k])));
    let v = vec![0.0; q.len()];
    body.set_state(&state(&body, q, v))?;
    let start = body.energy();
    let mut most = 0.0f64;
    for _ in 0..settling(&model, step).min(4 * MAX_STEPS) {
        body.step()?;
        most = most.max(body.energy() / start);
    }
    Ok(CaseOutcome::of(vec![
        gain("largest energy / energy at the start - 1", most),
        // A start that turns itself right side out takes longer or shorter by its rounding.
        Bound::new("energy at the end / energy at the start", body.energy() / start, 10.0 * RESTED),
    ])
    .stepped(&body))
}
