//! Figures a to c: elements, modes and steps.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Body, BodyConfig, Element, FlexibilitySite, GrabConfig, Integrator, ModalModel, ModelParts, Patch,
    StepSettings,
};

use super::{
    plot::{Axes, Figure, Series},
    work::{anchor, baked, by_mass, config, farthest, time_us},
};
use crate::LabError;

/// Free cube, nu = 0.3: `omega L sqrt(rho / mu)` of its first eleven elastic modes (Legendre-Ritz,
/// order 12; Demarest 1971; the last three are exact).
const CUBE: [f64; 11] =
    [2.8561, 2.8561, 3.8460, 3.8460, 3.8460, 3.9113, 3.9113, 3.9113, 4.44288, 4.44288, 4.44288];

pub(super) fn elements(quick: bool) -> Result<Vec<Figure>, LabError> {
    // The first bake of a program also starts its threads, so it is not timed.
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
    let words = "The figure shows the largest error of the first eleven frequencies of a free cube against Demarest's values, over the time of the whole bake. Ten-node tetrahedra are the default, because they reach the same error in a small part of the time. The cost at run time is the same."
        .to_owned();
    let cube = figure(
        "a-elements",
        "Elements and mesh size: free cube",
        "bake, s",
        "largest relative error of 11 frequencies",
        series,
        Some(1e-5),
        words,
    );
    let [frequencies, pull] = against_finer(quick)?;
    Ok(vec![cube, frequencies, pull])
}

/// Compares a bar held at one end with a far finer mesh of ten-node tetrahedra: its first six
/// frequencies, and the static displacement of its end under a force.
fn against_finer(quick: bool) -> Result<[Figure; 2], LabError> {
    let measure = |element: Element, n: usize| -> Result<(Vec<f64>, f64, f64), LabError> {
        let mesh = shapes::bar([5 * n, n, n], [1.0, 0.2, 0.2])?;
        let setting = config(element, 20, vec![anchor(0, 1e-9)]);
        let (model, seconds) = baked(&mesh, &setting)?;
        // The middle of the end is a vertex of every one of these meshes.
        let middle = [1.0f32, 0.1, 0.1];
        let away = |v: u32| -> f32 {
            let p = model.surface().positions()[v as usize];
            (0..3).map(|k| (p[k] - middle[k]).powi(2)).sum()
        };
        let count = model.surface().positions().len() as u32;
        let vertex = (0..count).min_by(|a, b| away(*a).total_cmp(&away(*b))).unwrap_or(0);
        let patch = Patch::around(model.surface(), vertex, 0.1)?;
        let mut body = Body::new(model.clone(), BodyConfig::default())?;
        let grab = body.grab(&patch, GrabConfig::default())?;
        let left_out = body.compliance(grab)?;
        let mut whole = Matrix3::from_fn(|i, j| left_out[i][j]);
        for mode in 0..model.mode_count() {
            let phi =
                patch.entries().iter().fold(Vector3::zeros(), |sum: Vector3<f64>, &(vertex, weight)| {
                    sum + weight
                        * Vector3::from_fn(|axis, _| f64::from(model.displacement_row(vertex, axis, mode)))
                });
            whole += phi * phi.transpose() / model.omega()[mode].powi(2);
        }
        Ok((model.omega()[..6].to_vec(), whole[(1, 1)], seconds))
    };
    let off = |got: &(Vec<f64>, f64, f64), want: &(Vec<f64>, f64, f64)| -> [f64; 2] {
        let worst = got.0.iter().zip(&want.0).map(|(g, w)| (g / w - 1.0).abs()).fold(0.0, f64::max);
        [worst, (got.1 / want.1 - 1.0).abs()]
    };
    let finest = if quick { 6 } else { 10 };
    let truth = measure(Element::Tet10, finest)?;
    let own = off(&measure(Element::Tet10, finest - 2)?, &truth);
    let mut series = [Vec::new(), Vec::new()];
    for (element, cells) in
        [(Element::Tet4, &[2usize, 4, 6, 8, 12][..]), (Element::Tet10, &[2usize, 4, 6, 8][..])]
    {
        let mut points = [Vec::new(), Vec::new()];
        for &n in cells.iter().filter(|n| if quick { **n < 6 } else { element == Element::Tet4 || **n < 8 }) {
            let got = measure(element, n)?;
            for (points, error) in points.iter_mut().zip(off(&got, &truth)) {
                points.push((got.2, error));
            }
        }
        for (series, points) in series.iter_mut().zip(points) {
            series.push(Series::new(format!("{element}"), points));
        }
    }
    let [frequencies, pull] = series;
    let mesh = format!("{} x {finest} x {finest} cells of ten-node tetrahedra", 5 * finest);
    let finer = "The error of the reference is estimated by its distance from the next coarser mesh, which is larger than its true error.";
    Ok([
        figure(
            "a-bar-frequencies",
            "Elements and mesh size: frequencies of a held bar",
            "bake, s",
            "largest relative error of 6 frequencies",
            frequencies,
            Some(own[0]),
            format!(
                "The first six frequencies of a bar that is held at one end are compared with those of a far finer mesh ({mesh}). {finer}"
            ),
        ),
        figure(
            "a-bar-pull",
            "Elements and mesh size: how far a held bar gives way",
            "bake, s",
            "relative error of the static displacement",
            pull,
            Some(own[1]),
            format!(
                "The static sideways displacement of a patch in the middle of the end under a force of one newton is compared with that of the same finer mesh. It is the sum of 20 modes and of the residual flexibility, which together are the whole static solution of the mesh. {finer}"
            ),
        ),
    ])
}

pub(super) fn figure(
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
        axes: Axes::Logarithmic,
        series,
        reference_error,
        words,
        below: None,
    }
}

/// The motion of a bar under a hand, sampled every 1/60 s.
struct Track {
    /// Reactions, N.
    force: Vec<[f64; 3]>,
    /// Modal coordinates.
    q: Vec<Vec<f64>>,
}

/// Drags the end of a bar to the side within a second and holds it there for another second.
fn dragged(model: &Arc<ModalModel>, config: BodyConfig) -> Result<Track, LabError> {
    let per = (1.0 / 60.0 / config.step).round().max(1.0) as usize;
    let step = config.step;
    let mut body = Body::new(model.clone(), config)?;
    let patch = Patch::around(model.surface(), farthest(model, [1.0, 0.01, 0.02]), 0.12)?;
    let grab = body.grab(&patch, GrabConfig::default())?;
    let start = body.grab_position(grab)?;
    let mut out = Track { force: Vec::new(), q: Vec::new() };
    for i in 1..=120 * per {
        let s = 0.1 * crate::smooth(i as f64 * step);
        body.set_target(grab, [start[0], start[1] + s, start[2] - 0.5 * s])?;
        body.step()?;
        if i % per == 0 {
            out.force.push(body.reaction(grab)?);
            out.q.push(body.q().to_vec());
        }
    }
    Ok(out)
}

/// Root mean square of the difference, relative to that of the reference.
fn relative(got: &[[f64; 3]], want: &[[f64; 3]]) -> f64 {
    let sum = |f: &dyn Fn(usize, usize) -> f64| -> f64 {
        (0..want.len()).map(|i| (0..3).map(|k| f(i, k).powi(2)).sum::<f64>()).sum()
    };
    let (off, size) = (sum(&|i, k| got[i][k] - want[i][k]), sum(&|i, k| want[i][k]));
    (off / size.max(f64::MIN_POSITIVE)).sqrt()
}

fn bar() -> Result<TetMesh, LabError> {
    Ok(shapes::bar([8, 2, 2], [1.0, 0.2, 0.2])?)
}

pub(super) fn modes(quick: bool) -> Result<Vec<Figure>, LabError> {
    // The reference keeps all modes of the mesh.
    let (full, _) = baked(&bar()?, &config(Element::Tet4, 216, vec![anchor(0, 1e-9)]))?;
    let elastic = BodyConfig::from(StepSettings { warp: false, ..Default::default() });
    let want = dragged(&full, elastic.clone())?;
    let step =
        relative(&dragged(&full, BodyConfig { step: 1.0 / 120.0, ..elastic.clone() })?.force, &want.force);
    let (mut force, mut shape) = ([Vec::new(), Vec::new()], [Vec::new(), Vec::new()]);
    let mut courses = Vec::new();
    let repeats = if quick { 2_000 } else { 20_000 };
    for kept in [2, 4, 8, 16, 32, 64, 128] {
        let fewer = BodyConfig { modes: Some(kept), ..elastic.clone() };
        let alone = Arc::new(bare(&full, kept)?);
        for (line, (model, config)) in [(&full, fewer), (&alone, elastic.clone())].into_iter().enumerate() {
            let mut body = Body::new(model.clone(), config.clone())?;
            let patch = Patch::around(model.surface(), farthest(model, [1.0, 0.01, 0.02]), 0.12)?;
            body.grab(&patch, GrabConfig::default())?;
            let us = time_us(repeats, || Ok(body.step().map(|_| ())?))?;
            let got = dragged(model, config)?;
            let (over_time, all) = by_mass(&got.q, &want.q);
            force[line].push((us, relative(&got.force, &want.force)));
            shape[line].push((us, all));
            if line == 0 && [2, 8, 32].contains(&kept) {
                let points = over_time.iter().enumerate().map(|(i, e)| ((i + 1) as f64 / 60.0, 100.0 * e));
                courses.push(Series::new(format!("{kept} modes"), points.collect()));
            }
        }
    }
    let lines = |[with, without]: [Vec<([f64; 2], f64)>; 2]| {
        vec![Series::timed("with residual flexibility (default)", with), Series::timed("without", without)]
    };
    let same = format!(
        "The model and the reference take the same steps of 1/60 s, so the error of the step (for the reaction {step:.1e}, against steps half as long) cancels and does not appear in the figure. Apart from rounding, the reference has no error of its own here."
    );
    let mut over_time = figure(
        "b-modes-time",
        "Modes kept: error of the shape over time",
        "s",
        "mass-weighted error, % of the motion",
        courses,
        None,
        "The figure shows the same error over time, with residual flexibility. The bar is dragged for one second and held for another.".into(),
    );
    over_time.axes = Axes::Linear;
    Ok(vec![
        figure(
            "b-modes",
            "Modes kept: reaction of a dragged bar",
            "step, us (median)",
            "reaction error, rms / rms",
            lines(force),
            None,
            format!(
                "The figure shows the error of the reaction of a dragged bar against all 216 modes of its mesh, over the time of a step, for 2 to 128 kept modes. What the kept modes leave out at the hand is added as a compliance. Without it, a hand on a body with few modes feels a body that is much too stiff. {same}"
            ),
        ),
        figure(
            "b-modes-shape",
            "Modes kept: shape of a dragged bar",
            "step, us (median)",
            "mass-weighted error, rms / rms",
            lines(shape),
            None,
            "The figure shows the mass-weighted error of the displacement of the whole body over the two seconds, as a share of the motion. The modes are mass-orthonormal, so this error is the norm of the difference of the modal coordinates. It includes what the missing modes would add near the hand: the compliance corrects the force on the hand but not the picture."
                .into(),
        ),
        over_time,
    ])
}

/// A model with the first `kept` modes and no residual flexibility for the others.
fn bare(model: &ModalModel, kept: usize) -> Result<ModalModel, LabError> {
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

pub(super) fn steps(quick: bool) -> Result<Vec<Figure>, LabError> {
    let (model, _) = baked(&bar()?, &config(Element::Tet10, 20, vec![anchor(0, 1e-9)]))?;
    let alpha = Integrator::GeneralizedAlpha { rho_inf: 0.5 };
    let all = [
        ("exact (default)", Integrator::Exact),
        ("Newmark (the paper's)", Integrator::Newmark),
        ("generalized-alpha 0.5", alpha),
    ];
    let rates: &[f64] =
        if quick { &[60.0, 120.0, 240.0, 960.0] } else { &[60.0, 120.0, 240.0, 480.0, 960.0, 1920.0] };
    let at = |rate: f64, integrator| BodyConfig {
        step: 1.0 / rate,
        settings: StepSettings { integrator, ..Default::default() },
        ..BodyConfig::default()
    };
    // The free motion has a closed form, which the `exact` integrator matches at any step.
    let ring = |config: BodyConfig| -> Result<(Vec<[f64; 3]>, Vec<Vec<f64>>), LabError> {
        let per = (1.0 / 60.0 / config.step).round() as usize;
        let mut body = Body::new(model.clone(), config)?;
        let vertex = farthest(&model, [1.0, 0.01, 0.02]);
        body.apply_impulse(vertex, [0.2, 1.0, -0.5])?;
        let (mut tip, mut q) = (Vec::new(), Vec::new());
        for i in 1..=60 * per {
            body.step()?;
            if i % per == 0 {
                let row = |k| -> f64 {
                    let each = body.q().iter().enumerate();
                    each.map(|(mode, q)| f64::from(model.displacement_row(vertex, k, mode)) * q).sum()
                };
                tip.push([row(0), row(1), row(2)]);
                q.push(body.q().to_vec());
            }
        }
        Ok((tip, q))
    };
    let finest = 7680.0;
    let (free_truth, free_shape) = ring(at(finest, Integrator::Exact))?;
    // The held motion is of second order in the step. By Richardson, the error of the finest step
    // is a third of its difference to twice the step.
    let held_truth = dragged(&model, at(finest, alpha))?;
    let coarser = dragged(&model, at(finest / 2.0, alpha))?;
    let held_own = relative(&coarser.force, &held_truth.force) / 3.0;
    let shape_own = by_mass(&coarser.q, &held_truth.q).1 / 3.0;
    let (mut free, mut held, mut shapes, mut courses) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (name, integrator) in all {
        let (mut a, mut b, mut c) = (Vec::new(), Vec::new(), Vec::new());
        for &rate in rates {
            let mut body = Body::new(model.clone(), at(rate, integrator))?;
            let us = time_us(2_000, || Ok(body.step().map(|_| ())?))?;
            let patch = Patch::around(model.surface(), farthest(&model, [1.0, 0.01, 0.02]), 0.12)?;
            body.grab(&patch, GrabConfig::default())?;
            let with_hand = time_us(2_000, || Ok(body.step().map(|_| ())?))?;
            let (tip, q) = ring(at(rate, integrator))?;
            let hand = dragged(&model, at(rate, integrator))?;
            a.push((us.map(|us| us * rate), relative(&tip, &free_truth).max(1e-16)));
            let with_hand = with_hand.map(|us| us * rate);
            b.push((with_hand, relative(&hand.force, &held_truth.force)));
            c.push((with_hand, by_mass(&hand.q, &held_truth.q).1));
            if rate == rates[0] {
                let over_time = by_mass(&q, &free_shape).0;
                let points = over_time.iter().enumerate().map(|(i, e)| ((i + 1) as f64 / 60.0, 100.0 * e));
                courses.push(Series::new(name, points.collect()));
            }
        }
        free.push(Series::timed(name, a));
        held.push(Series::timed(name, b));
        shapes.push(Series::timed(name, c));
    }
    let mut over_time = figure(
        "c-steps-time",
        "Integrator and step: error of a struck bar over time",
        "s",
        "mass-weighted error, % of the motion",
        courses,
        None,
        "The figure shows the mass-weighted error of the displacement of the whole struck bar over time, at 60 steps a second. If a frequency is shifted, the error grows with every oscillation until the damping has ended the motion.".into(),
    );
    over_time.axes = Axes::Linear;
    let x = "us of one core for a second of motion";
    let order = "The reference is generalized-alpha at 7,680 steps a second. Its error is estimated as a third of its difference from 3,840 steps a second, because the method is of second order.";
    Ok(vec![
        figure("c-steps-free", "Integrator and step: a struck bar", x, "tip error over 1 s, rms / rms", free, None, "A struck bar is compared with the closed form for one second. The exact step has no error at any step size except rounding, which is drawn as at least 1e-16. Newmark shifts every frequency.".into()),
        over_time,
        figure(
            "c-steps-held",
            "Integrator and step: a dragged bar, its reaction",
            x,
            "reaction error, rms / rms",
            held,
            Some(held_own),
            format!("The same bar is dragged and held. {order} The exact step extrapolates the force at the end of a step from the forces in the middle of this step and of the previous one. Without the warp it is of second order, as a test shows. With the warp it is of second order up to 240 steps a second. At higher rates the remaining error is of first order, so the two other integrators are more accurate there."),
        ),
        figure(
            "c-steps-held-shape",
            "Integrator and step: a dragged bar, its shape",
            x,
            "mass-weighted error, rms / rms",
            shapes,
            Some(shape_own),
            format!("The figure shows the mass-weighted error of the displacement of the whole body in the same runs. {order}"),
        ),
    ])
}
