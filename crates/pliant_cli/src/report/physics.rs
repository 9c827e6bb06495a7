//! Figures a to e and g: elements, modes, steps, warp, precision, and all together.

use std::sync::Arc;

use pliant_bake::{BakeConfig, DeadLoad, Deflection, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Body, BodyConfig, Element, FlexibilitySite, GrabConfig, Integrator, ModalModel, ModelParts, Patch,
};

use super::{
    plot::{Figure, Series},
    work::{anchor, apart, baked, config, farthest, time_us},
};
use crate::CliError;

/// Free cube, nu = 0.3: `omega L sqrt(rho / mu)` of its first eleven elastic modes (Legendre-Ritz, order 12; Demarest 1971; the last three are exact).
const CUBE: [f64; 11] =
    [2.8561, 2.8561, 3.8460, 3.8460, 3.8460, 3.9113, 3.9113, 3.9113, 4.44288, 4.44288, 4.44288];

pub(super) fn elements(quick: bool) -> Result<Figure, CliError> {
    // The first bake of a program pays for its threads.
    baked(&shapes::cube(2, 1.0)?, &config(Element::Tet4, 11, Vec::new()))?;
    let mut series = Vec::new();
    for (element, cells) in [(Element::Tet4, vec![3, 5, 8, 12, 16]), (Element::Tet10, vec![2, 3, 4, 6, 8])] {
        let keep = if quick { 4 } else { cells.len() };
        let mut points = Vec::new();
        for &n in &cells[..keep] {
            let (model, seconds) = baked(&shapes::cube(n, 1.0)?, &config(element, 11, Vec::new()))?;
            let info = model.info();
            let scale = (info.density * 2.0 * (1.0 + info.poisson) / info.young).sqrt();
            let worst = model
                .omega()
                .iter()
                .zip(CUBE)
                .map(|(w, want)| (w * scale / want - 1.0).abs())
                .fold(0.0, f64::max);
            points.push((seconds, worst));
        }
        series.push(Series::new(format!("{element}"), points));
    }
    let words = "Largest error of the first eleven frequencies of a free cube against Demarest's values, over the time of the whole bake. Ten-node tetrahedra are the default: \
        for the same error they take a small part of the time. The run-time cost is the same."
        .to_owned();
    Ok(figure(
        "a-elements",
        "Elements and mesh size: free cube",
        "bake, s",
        "largest relative error of 11 frequencies",
        series,
        Some(1e-5),
        words,
    ))
}

fn figure(
    file: &str,
    title: &str,
    x: &str,
    y: &str,
    series: Vec<Series>,
    reference_error: Option<f64>,
    words: String,
) -> Figure {
    Figure {
        file: file.into(),
        title: title.into(),
        x: x.into(),
        y: y.into(),
        logarithmic: true,
        series,
        reference_error,
        words,
    }
}

fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
}

/// Drags the end of a bar to the side in a second and holds it for one more: reactions (N) and positions (m) every 1/60 s.
fn dragged(model: &Arc<ModalModel>, config: BodyConfig) -> Result<Vec<[f64; 6]>, CliError> {
    let per = (1.0 / 60.0 / config.step).round().max(1.0) as usize;
    let step = config.step;
    let mut body = Body::new(model.clone(), config)?;
    let patch = Patch::around(model.surface(), farthest(model, [1.0, 0.01, 0.02]), 0.12)?;
    let grab = body.grab(&patch, GrabConfig::default())?;
    let start = body.grab_position(grab)?;
    let mut out = Vec::new();
    for i in 1..=120 * per {
        let s = 0.1 * smooth(i as f64 * step);
        body.set_target(grab, [start[0], start[1] + s, start[2] - 0.5 * s])?;
        body.step()?;
        if i % per == 0 {
            let (f, p) = (body.reaction(grab)?, body.grab_position(grab)?);
            out.push([f[0], f[1], f[2], p[0], p[1], p[2]]);
        }
    }
    Ok(out)
}

/// Root mean square of the difference over that of the reference, for three of the columns.
fn relative(got: &[[f64; 6]], want: &[[f64; 6]], from: usize) -> f64 {
    let sum = |f: &dyn Fn(usize, usize) -> f64| -> f64 {
        (0..want.len()).map(|i| (from..from + 3).map(|k| f(i, k).powi(2)).sum::<f64>()).sum()
    };
    let middle = want[0];
    let off = sum(&|i, k| got[i][k] - want[i][k]);
    let size = sum(&|i, k| want[i][k] - if from == 3 { middle[k] } else { 0.0 });
    (off / size.max(f64::MIN_POSITIVE)).sqrt()
}

fn bar() -> Result<TetMesh, CliError> {
    Ok(shapes::bar([8, 2, 2], [1.0, 0.2, 0.2])?)
}

pub(super) fn modes(quick: bool) -> Result<Figure, CliError> {
    // Every mode that the mesh has: nothing is left out.
    let (full, _) = baked(&bar()?, &config(Element::Tet4, 216, vec![anchor(0, 1e-9)]))?;
    let elastic = BodyConfig { warp: false, ..BodyConfig::default() };
    let want = dragged(&full, elastic.clone())?;
    let again = dragged(&full, BodyConfig { step: 1.0 / 120.0, ..elastic.clone() })?;
    let (mut with, mut without) = (Vec::new(), Vec::new());
    for kept in [2, 4, 8, 16, 32, 64, 128] {
        let config = BodyConfig { modes: Some(kept), ..elastic.clone() };
        let mut body = Body::new(full.clone(), config.clone())?;
        let patch = Patch::around(full.surface(), farthest(&full, [1.0, 0.01, 0.02]), 0.12)?;
        body.grab(&patch, GrabConfig::default())?;
        let us = time_us(if quick { 2_000 } else { 20_000 }, || Ok(body.step().map(|_| ())?))?;
        with.push((us, relative(&dragged(&full, config)?, &want, 0)));
        without.push((us, relative(&dragged(&Arc::new(bare(&full, kept)?), elastic.clone())?, &want, 0)));
    }
    let series =
        vec![Series::timed("with residual flexibility (default)", with), Series::timed("without", without)];
    let words = "Error of the reaction of a dragged bar against all 216 modes of its mesh, over the time of a step, for 2 to 128 modes kept. What the kept modes leave out at the hand \
        is added as a compliance; without it a hand on few modes feels a body that is much too stiff."
        .to_owned();
    let own = relative(&again, &want, 0);
    Ok(figure(
        "b-modes",
        "Modes kept: reaction of a dragged bar",
        "step, us (median)",
        "reaction error, rms / rms",
        series,
        Some(own),
        words,
    ))
}

/// The first modes alone, with nothing for those left out.
fn bare(model: &ModalModel, kept: usize) -> Result<ModalModel, CliError> {
    let mut parts: ModelParts = model.parts().clone();
    let per = 3 * parts.surface.positions().len();
    parts.omega.truncate(kept);
    parts.damping.truncate(kept);
    parts.participation.truncate(kept);
    parts.displacement.truncate(per * kept);
    parts.rotation.truncate(per * kept);
    parts.sites = parts.sites.iter().map(|s| FlexibilitySite { flexibility: [[0.0; 3]; 3], ..*s }).collect();
    Ok(ModalModel::from_parts(parts)?)
}

pub(super) fn steps(quick: bool) -> Result<[Figure; 2], CliError> {
    let (model, _) = baked(&bar()?, &config(Element::Tet10, 20, vec![anchor(0, 1e-9)]))?;
    let all = [
        ("exact (default)", Integrator::Exact),
        ("Newmark (the paper's)", Integrator::Newmark),
        ("generalized-alpha 0.5", Integrator::GeneralizedAlpha { rho_inf: 0.5 }),
    ];
    let rates: &[f64] =
        if quick { &[60.0, 240.0, 960.0] } else { &[60.0, 120.0, 240.0, 480.0, 960.0, 1920.0] };
    let at = |rate: f64, integrator| BodyConfig { step: 1.0 / rate, integrator, ..BodyConfig::default() };
    let (mut free, mut held) = (Vec::new(), Vec::new());
    // Free: a closed form exists, `exact` at any step; the finest one is the reference.
    let ring = |config: BodyConfig| -> Result<Vec<[f64; 6]>, CliError> {
        let per = (1.0 / 60.0 / config.step).round() as usize;
        let mut body = Body::new(model.clone(), config)?;
        let vertex = farthest(&model, [1.0, 0.01, 0.02]);
        body.strike(vertex, [0.2, 1.0, -0.5])?;
        let mut out = Vec::new();
        for i in 1..=60 * per {
            body.step()?;
            if i % per == 0 {
                let mut row = [0.0; 6];
                for (mode, q) in body.q().iter().enumerate() {
                    (0..3).for_each(|k| row[k] += f64::from(model.displacement_row(vertex, k, mode)) * q);
                }
                out.push(row);
            }
        }
        Ok(out)
    };
    let finest = 7680.0;
    let (free_truth, held_truth) =
        (ring(at(finest, Integrator::Exact))?, dragged(&model, at(finest, Integrator::Exact))?);
    let held_own = relative(&dragged(&model, at(finest / 2.0, Integrator::Exact))?, &held_truth, 0);
    for (name, integrator) in all {
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for &rate in rates {
            let mut body = Body::new(model.clone(), at(rate, integrator))?;
            let us = time_us(2_000, || Ok(body.step().map(|_| ())?))?;
            let patch = Patch::around(model.surface(), farthest(&model, [1.0, 0.01, 0.02]), 0.12)?;
            body.grab(&patch, GrabConfig::default())?;
            let with_hand = time_us(2_000, || Ok(body.step().map(|_| ())?))?;
            a.push((
                us.map(|us| us * rate),
                relative(&ring(at(rate, integrator))?, &free_truth, 0).max(1e-16),
            ));
            b.push((
                with_hand.map(|us| us * rate),
                relative(&dragged(&model, at(rate, integrator))?, &held_truth, 0),
            ));
        }
        free.push(Series::timed(name, a));
        held.push(Series::timed(name, b));
    }
    Ok([
        figure("c-steps-free", "Integrator and step: a struck bar", "us of one core for a second of motion", "tip error after 1 s, rms / rms", free, None, "A struck bar for a second, against the closed form. The exact step has no error at any step size (rounding is drawn at 1e-16 at least); Newmark shifts every frequency.".into()),
        figure("c-steps-held", "Integrator and step: a dragged bar", "us of one core for a second of motion", "reaction error, rms / rms", held, Some(held_own), "The same bar dragged and held: the hand's force is constant over a step, which is what the exact step is off by.".into()),
    ])
}

/// A body held where a nonlinear solution has its patches, against that solution.
pub(super) struct Held {
    /// rms and largest error of the surface, m.
    pub(super) shape: [f64; 2],
    /// |reaction - load| / load.
    pub(super) force: f64,
    /// The same of the part along the load.
    pub(super) along: f64,
    /// Median and 99th percentile of a step, us.
    pub(super) step_us: [f64; 2],
}

pub(super) fn held_as(
    model: &Arc<ModalModel>,
    load: &[DeadLoad],
    truth: &Deflection,
    body_config: BodyConfig,
) -> Result<Held, CliError> {
    let mut body = Body::new(model.clone(), body_config)?;
    let mut grabs = Vec::new();
    for (dead, moved) in load.iter().zip(&truth.patches) {
        let grab = body.grab(&dead.patch, GrabConfig::default())?;
        let start = body.grab_position(grab)?;
        grabs.push((grab, start, *moved));
    }
    // Slowly, as a hand does.
    for i in 0..3_000 {
        let s = smooth(f64::from(i) / 600.0);
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
    Ok(Held {
        shape: apart(&moved, &truth.surface),
        force: (off / size).sqrt(),
        along: (along / size - 1.0).abs(),
        step_us,
    })
}

pub(super) fn warp(quick: bool) -> Result<Vec<Figure>, CliError> {
    let thick = 0.1;
    let cells = [16, 2, 2];
    let mesh = shapes::bar(cells, [1.0, thick, thick])?;
    let setting = config(Element::Tet10, 60, vec![anchor(0, 1e-9)]);
    let (model, _) = baked(&mesh, &setting)?;
    let stiffness = setting.young * thick.powi(4) / 12.0;
    let corner = |y: f32, z: f32| farthest(&model, [10.0, y, z]);
    let patch = |v: u32| Patch::around(model.surface(), v, 0.06);
    let middle = Patch::around(model.surface(), nearest_end(&model, thick), 0.08)?;
    let couple = |f: f64| -> Result<Vec<DeadLoad>, CliError> {
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
    let (mut own, mut own_twist) = (0.0f64, 0.0f64);
    let loads: &[f64] = if quick { &[0.25, 1.0, 2.0] } else { &[0.1, 0.25, 0.5, 1.0, 2.0, 3.0] };
    for &p in loads {
        let load = vec![DeadLoad { patch: middle.clone(), force: [0.0, p * stiffness, 0.0] }];
        let truth = deflect(&mesh, &setting, &load)?;
        let reach = truth.patches[0].iter().map(|x| x * x).sum::<f64>().sqrt();
        for (which, warp) in [true, false].into_iter().enumerate() {
            let held = held_as(&model, &load, &truth, BodyConfig { warp, ..BodyConfig::default() })?;
            bend[which].push((reach, held.shape[1]));
            force[which].push((reach, held.along));
            whole[which].push((reach, held.force));
        }
        if p == 1.0 {
            own = own_error(&setting, thick, p * stiffness, &truth)?;
        }
        let load = couple(0.6 * p * stiffness)?;
        let truth = deflect(&mesh, &setting, &load)?;
        let turn = truth.patches[0].iter().map(|x| x * x).sum::<f64>().sqrt();
        for (which, warp) in [true, false].into_iter().enumerate() {
            let held = held_as(&model, &load, &truth, BodyConfig { warp, ..BodyConfig::default() })?;
            twist[which].push((turn, held.shape[1]));
        }
        own_twist = own;
    }
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
        figure("d-warp-bend", "Warp: a bar pulled aside by its end", "how far the end is pulled / length", "largest error of the surface / length", lines(bend), Some(own), "A bar ten times as long as thick, its end pulled aside by a dead load in a St. Venant-Kirchhoff solution of our own on the same mesh; the modal body is held by a hand where that solution has the patch, and the largest distance of the two surfaces is drawn. 60 modes.".into()),
                figure(
            "d-warp-force",
            "Warp: the force in the hand",
            "how far the end is pulled / length",
            "reaction error / load",
            forces,
            None,
            "The force that the hand feels in the same cases: its part along the pull, and all of it. The hand holds the patch in all three directions where the nonlinear bar has it, drawn \
             in along its axis as a bent bar is; where warped modes would lie a little elsewhere along the axis, the stiff direction answers with a force of several times the load. A hand \
             that pulls where the body lets it (a soft spring, a device) does not feel it."
                .into(),
        ),
        figure("d-warp-twist", "Warp: a bar twisted at its end", "how far a corner moves / length", "largest error of the surface / length", lines(twist), Some(own_twist), "The same bar under four forces at the corners of its end.".into()),
    ])
}

fn nearest_end(model: &ModalModel, thick: f64) -> u32 {
    let middle = [1.0, 0.5 * thick as f32, 0.5 * thick as f32];
    let positions = model.surface().positions();
    let away = |v: u32| (0..3).map(|k| (positions[v as usize][k] - middle[k]).powi(2)).sum::<f32>();
    (0..positions.len() as u32).min_by(|a, b| away(*a).total_cmp(&away(*b))).unwrap_or(0)
}

/// The same load on a mesh of half the cell: how far the end of the reference moves by it.
fn own_error(setting: &BakeConfig, thick: f64, force: f64, truth: &Deflection) -> Result<f64, CliError> {
    let fine = shapes::bar([24, 4, 4], [1.0, thick, thick])?;
    let (model, _) = baked(&fine, &BakeConfig { modes: 4, ..setting.clone() })?;
    let patch = Patch::around(model.surface(), nearest_end(&model, thick), 0.08)?;
    let again = deflect(&fine, setting, &[DeadLoad { patch, force: [0.0, force, 0.0] }])?;
    Ok((0..3).map(|k| (again.patches[0][k] - truth.patches[0][k]).powi(2)).sum::<f64>().sqrt())
}

/// Everything together: modes, warp and element against the nonlinear solution, over what a frame costs.
pub(super) fn front(quick: bool) -> Result<Figure, CliError> {
    let thick = 0.1;
    let mesh = shapes::bar([24, 3, 3], [1.0, thick, thick])?;
    let reference = config(Element::Tet10, 60, vec![anchor(0, 1e-9)]);
    let stiffness = reference.young * thick.powi(4) / 12.0;
    let mut series = Vec::new();
    let mut truth: Option<(Vec<DeadLoad>, Deflection)> = None;
    for (element, warp) in [(Element::Tet10, true), (Element::Tet10, false), (Element::Tet4, true)] {
        let (model, _) = baked(&mesh, &BakeConfig { element, ..reference.clone() })?;
        let patch = Patch::around(model.surface(), nearest_end(&model, thick), 0.08)?;
        if truth.is_none() {
            let load = vec![DeadLoad { patch, force: [0.0, 0.5 * stiffness, 0.0] }];
            let solved = deflect(&mesh, &reference, &load)?;
            truth = Some((load, solved));
        }
        let Some((load, solved)) = &truth else { continue };
        let mut points = Vec::new();
        for modes in [3, 6, 12, 24, 60] {
            let config = BodyConfig { warp, modes: Some(modes), ..BodyConfig::default() };
            let held = held_as(&model, load, solved, config.clone())?;
            let mut body = Body::new(model.clone(), config)?;
            let mut positions = vec![[0.0f32; 3]; model.surface().positions().len()];
            let frame =
                time_us(if quick { 1_000 } else { 10_000 }, || Ok(body.reconstruct(&mut positions)?))?;
            points.push(([held.step_us[0] + frame[0], held.step_us[1] + frame[1]], held.shape[1]));
        }
        series.push(Series::timed(format!("{element}, {}", if warp { "warped" } else { "linear" }), points));
    }
    Ok(figure("g-front", "All together: what a frame costs and what it is off by", "step and whole surface, us (median)", "largest error of the surface / length", series, None, "The bar pulled aside by a sixth of its length: modes 3, 6, 12, 24, 60 along each line. Error is the largest distance of the surfaces as a share of the length.".into()))
}
