//! Figure d: the warp compared with a geometrically nonlinear solution.

use std::sync::Arc;

use pliant_bake::{BakeConfig, BakeError, DeadLoad, Deflection, Material, StaticLoads, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Body, BodyConfig, Element, GrabConfig, ModalModel, Patch, StepSettings};

use super::{
    physics::figure,
    plot::{Figure, Series},
    work::{anchor, apart, baked, config, farthest, time_us},
};
use crate::LabError;

/// Comparison of a held body with a nonlinear solution. The hands hold the body's patches at the
/// positions of the nonlinear solution.
pub(super) struct HeldBar {
    /// Root mean square and largest error of the surface, m.
    pub(super) shape: [f64; 2],
    /// |reaction - load| / load.
    pub(super) force: f64,
    /// The same for the part of the reaction along the load.
    pub(super) along: f64,
    /// Median and 99th percentile of the time of a step, us.
    pub(super) step_us: [f64; 2],
}

/// Holds a body where a nonlinear solution has its patches. If `own_shapes`, a body with reduced
/// elasticity has the own shapes of these patches.
pub(super) fn held_as(
    model: &Arc<ModalModel>,
    load: &[DeadLoad],
    truth: &Deflection,
    body_config: BodyConfig,
    own_shapes: bool,
) -> Result<HeldBar, LabError> {
    let mut body = Body::new(model.clone(), body_config)?;
    let mut grabs = Vec::new();
    for (dead, moved) in load.iter().zip(&truth.patches) {
        let grab = body.grab(&dead.patch, GrabConfig::default())?;
        let start = body.grab_position(grab)?;
        grabs.push((grab, start, *moved));
    }
    // The targets move slowly, as a hand does.
    for i in 0..3_000 {
        if own_shapes {
            body.make_held_shapes()?;
        }
        let s = crate::smooth(f64::from(i) / 600.0);
        for (grab, start, moved) in &grabs {
            body.set_target(*grab, std::array::from_fn(|k| start[k] + s * moved[k]))?;
        }
        body.step()?;
    }
    let mut positions = vec![[0.0f32; 3]; model.surface().positions().len()];
    body.reconstruct(&mut positions)?;
    let moved: Vec<[f64; 3]> = positions
        .iter()
        .zip(model.surface().positions())
        .map(|(p, r)| std::array::from_fn(|k| f64::from(p[k]) - f64::from(r[k])))
        .collect();
    let (mut off, mut size, mut along) = (0.0, 0.0, 0.0);
    for ((grab, ..), dead) in grabs.iter().zip(load) {
        let f = body.reaction(*grab)?;
        off += (0..3).map(|k| (f[k] + dead.force[k]).powi(2)).sum::<f64>();
        size += dead.force.iter().map(|x| x * x).sum::<f64>();
        along -= (0..3).map(|k| f[k] * dead.force[k]).sum::<f64>();
    }
    let step_us = time_us(2_000, || Ok(body.step().map(|_| ())?))?;
    Ok(HeldBar {
        shape: apart(&moved, &truth.surface),
        force: (off / size).sqrt(),
        along: (along / size - 1.0).abs(),
        step_us,
    })
}

pub(super) fn warp(quick: bool) -> Result<Vec<Figure>, LabError> {
    let thick = 0.1;
    let cells = [16, 2, 2];
    let mesh = shapes::bar(cells, [1.0, thick, thick])?;
    let setting = config(Element::Tet10, 60, vec![anchor(0, 1e-9)]);
    let (model, _) = baked(&mesh, &setting)?;
    let stiffness = setting.young * thick.powi(4) / 12.0;
    let corner = |y: f32, z: f32| farthest(&model, [10.0, y, z]);
    let patch = |v: u32| Patch::around(model.surface(), v, 0.06);
    let middle = Patch::around(model.surface(), nearest_end(&model, thick), 0.08)?;
    let couple = |f: f64| -> Result<Vec<DeadLoad>, LabError> {
        let at = [
            (1.0f32, 1.0f32, [0.0, -f, f]),
            (-1.0, -1.0, [0.0, f, -f]),
            (-1.0, 1.0, [0.0, -f, -f]),
            (1.0, -1.0, [0.0, f, f]),
        ];
        at.iter().map(|(y, z, force)| Ok(DeadLoad { patch: patch(corner(*y, *z))?, force: *force })).collect()
    };
    let mut bend = [Vec::new(), Vec::new()];
    let mut twist = [Vec::new(), Vec::new()];
    let mut force = [Vec::new(), Vec::new()];
    let mut whole = [Vec::new(), Vec::new()];
    // Errors of the references as solutions on their own mesh, which the model shares: the
    // remaining relative force times the displacement.
    let (mut own, mut own_twist, mut finer) = (0.0f64, 0.0f64, 0.0f64);
    let loads: &[f64] = if quick { &[0.25, 1.0, 2.0] } else { &[0.1, 0.25, 0.5, 1.0, 2.0, 3.0] };
    for &p in loads {
        let load = vec![DeadLoad { patch: middle.clone(), force: [0.0, p * stiffness, 0.0] }];
        let truth = under(&mesh, &setting, &load)?;
        let reach = truth.patches[0].iter().map(|x| x * x).sum::<f64>().sqrt();
        for (which, warp) in [true, false].into_iter().enumerate() {
            let held = held_as(
                &model,
                &load,
                &truth,
                BodyConfig::from(StepSettings { warp, ..Default::default() }),
                false,
            )?;
            bend[which].push((reach, held.shape[1]));
            force[which].push((reach, held.along));
            whole[which].push((reach, held.force));
        }
        own = own.max(truth.residual * reach);
        if p == 1.0 {
            finer = on_finer(&setting, thick, p * stiffness, &truth)?;
        }
        let load = couple(0.6 * p * stiffness)?;
        let truth = under(&mesh, &setting, &load)?;
        let turn = truth.patches[0].iter().map(|x| x * x).sum::<f64>().sqrt();
        for (which, warp) in [true, false].into_iter().enumerate() {
            let held = held_as(
                &model,
                &load,
                &truth,
                BodyConfig::from(StepSettings { warp, ..Default::default() }),
                false,
            )?;
            twist[which].push((turn, held.shape[1]));
        }
        own_twist = own_twist.max(truth.residual * turn);
    }
    let worse = |lines: &[Vec<(f64, f64)>; 2]| -> String {
        let at = lines[0].iter().zip(&lines[1]).filter(|(with, without)| with.1 > without.1);
        let at: Vec<String> = at
            .map(|(with, without)| format!("{:.3} ({:.1e} with, {:.1e} without)", with.0, with.1, without.1))
            .collect();
        if at.is_empty() {
            return "The model with the warp is the better of the two at every pull in the figure."
                .to_owned();
        }
        format!(
            "The model with the warp is the *worse* of the two at {} of the length, and the better of the two at the other pulls.",
            at.join(", ")
        )
    };
    let (worse_shape, worse_force, worse_twist) = (worse(&bend), worse(&force), worse(&twist));
    let name = |which: usize| if which == 0 { "warped (default)" } else { "linear, without warp" }.to_owned();
    let lines = |all: [Vec<(f64, f64)>; 2]| {
        all.into_iter().enumerate().map(|(k, points)| Series::new(name(k), points)).collect::<Vec<_>>()
    };
    let mut forces = lines(force);
    for line in &mut forces {
        line.name += ", along the pull";
    }
    forces.extend(
        lines(whole).into_iter().map(|line| Series { name: format!("{}, all of it", line.name), ..line }),
    );
    Ok(vec![
        figure(
            "d-warp-bend",
            "Warp: a bar pulled aside by its end",
            "how far the end is pulled / length",
            "largest error of the surface / length",
            lines(bend),
            Some(own),
            format!(
                "The bar is ten times as long as thick. The reference is our own St. Venant-Kirchhoff solution on the same mesh, in which a dead load pulls the end aside. A hand holds the modal body where that solution has the patch, and the largest distance between the two surfaces is drawn. Both use ten-node tetrahedra, and the modal body has 60 modes. The error of the reference is the residual of its solver. The model and the reference share their mesh, so the figure does not include the error of the mesh: on a mesh with cells of two thirds by half by half the size, the patch of the reference would lie {finer:.1e} of the length away under the same load. {worse_shape}"
            ),
        ),
        figure(
            "d-warp-force",
            "Warp: the force in the hand",
            "how far the end is pulled / length",
            "reaction error / load",
            forces,
            None,
            format!(
                "The figure shows the error of the force on the hand in the same cases, both of its component along the pull and of the whole force. The hand holds the patch in all three directions where the nonlinear bar has it. A bent bar is shortened along its axis, and warped modes shorten it by a slightly different length. The axis is stiff, so the hand then feels a force of several times the load. A hand that does not fix the patch along the axis, such as a soft spring or a device, does not feel this force. Along the pull: {worse_force}"
            ),
        ),
        figure(
            "d-warp-twist",
            "Warp: a bar twisted at its end",
            "how far a corner moves / length",
            "largest error of the surface / length",
            lines(twist),
            Some(own_twist),
            format!(
                "The same bar is under four forces at the corners of its end. This case has its own nonlinear solution. {worse_twist}"
            ),
        ),
    ])
}

fn nearest_end(model: &ModalModel, thick: f64) -> u32 {
    let middle = [1.0, 0.5 * thick as f32, 0.5 * thick as f32];
    let positions = model.surface().positions();
    let away = |v: u32| (0..3).map(|k| (positions[v as usize][k] - middle[k]).powi(2)).sum::<f32>();
    (0..positions.len() as u32).min_by(|a, b| away(*a).total_cmp(&away(*b))).unwrap_or(0)
}

/// Solves for the shape of a St. Venant-Kirchhoff body under dead loads.
pub(super) fn under(
    mesh: &TetMesh,
    setting: &BakeConfig,
    forces: &[DeadLoad],
) -> Result<Deflection, BakeError> {
    deflect(mesh, setting, Material::StVenantKirchhoff, &StaticLoads { forces, ..Default::default() })
}

/// Applies the same load on a finer mesh. Returns the distance of its patch from the reference's
/// patch.
fn on_finer(setting: &BakeConfig, thick: f64, force: f64, truth: &Deflection) -> Result<f64, LabError> {
    let fine = shapes::bar([24, 4, 4], [1.0, thick, thick])?;
    let (model, _) = baked(&fine, &BakeConfig { modes: 4, ..setting.clone() })?;
    let patch = Patch::around(model.surface(), nearest_end(&model, thick), 0.08)?;
    let again = under(&fine, setting, &[DeadLoad { patch, force: [0.0, force, 0.0] }])?;
    Ok((0..3).map(|k| (again.patches[0][k] - truth.patches[0][k]).powi(2)).sum::<f64>().sqrt())
}
