//! Figure h: linear and reduced elasticity, by error and run time.

use std::{fmt::Write, sync::Arc};

use pliant_bake::{BakeConfig, Deflection, Material, PrescribedPatch, StaticLoads, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Body, BodyConfig, Elasticity, Element, GrabConfig, ModalModel, Patch, StepSettings};

use super::{
    physics::figure,
    plot::{Figure, Series},
    work::{anchor, apart, baked, config, farthest, time_us},
};
use crate::LabError;

/// Steps and surfaces a second.
const RATE: f64 = 60.0;

/// A setting with its errors at each displacement and its times.
struct Setting {
    words: String,
    /// Line of the figures: linear, reduced, reduced with the shapes of the patch.
    line: usize,
    /// Errors of the force, as a share of it, and of the surface, m, at each displacement.
    errors: Vec<[f64; 2]>,
    /// Time for a second at rest after the pull, all steps and surfaces: median and 99th
    /// percentile, us.
    cost: [f64; 2],
    /// Size of the model's file, bytes.
    bytes: usize,
    /// Time of the bake, s.
    bake: f64,
}

const LINES: [&str; 3] = ["linear", "reduced", "reduced, with the patch's own shapes"];

/// Leads a hand slowly along `displacement`, and returns the body at rest with the error of the
/// force and the largest error of the surface.
fn lead_hand(
    model: &Arc<ModalModel>,
    elasticity: Elasticity,
    has_shapes: bool,
    patch: &Patch,
    displacement: [f64; 3],
    truth: &Deflection,
) -> Result<(Body, [f64; 2]), LabError> {
    let settings = StepSettings { elasticity, damping_scale: 10.0, ..StepSettings::default() };
    let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / RATE, ..settings.into() })?;
    let grab = body.grab(patch, GrabConfig::default())?;
    let start = body.grab_position(grab)?;
    for i in 0..1_800 {
        if has_shapes {
            body.make_held_shapes()?;
        }
        let s = crate::smooth(f64::from(i) / 600.0);
        body.set_target(grab, std::array::from_fn(|k| start[k] + s * displacement[k]))?;
        body.step()?;
    }
    let rest = model.surface().positions();
    let mut positions = rest.to_vec();
    body.reconstruct(&mut positions)?;
    let moved: Vec<[f64; 3]> = positions
        .iter()
        .zip(rest)
        .map(|(p, r)| std::array::from_fn(|k| f64::from(p[k]) - f64::from(r[k])))
        .collect();
    let want = truth.reactions.first().copied().unwrap_or_default();
    let got = body.reaction(grab)?;
    let off = apart(&[got], &[want])[1] / apart(&[want], &[[0.0; 3]])[1].max(f64::MIN_POSITIVE);
    Ok((body, [off, apart(&moved, &truth.surface)[1]]))
}

/// Measures one setting.
fn setting(
    line: usize,
    mesh: &TetMesh,
    baking: &BakeConfig,
    hands: &[(Patch, [f64; 3], Deflection)],
) -> Result<Setting, LabError> {
    let (model, bake) = baked(mesh, baking)?;
    let elasticity = if line == 0 { Elasticity::Linear } else { Elasticity::Reduced };
    let (mut errors, mut cost) = (Vec::new(), [0.0f64; 2]);
    for (patch, displacement, truth) in hands {
        let (mut body, error) = lead_hand(&model, elasticity, line == 2, patch, *displacement, truth)?;
        errors.push(error);
        let step = time_us(1_000, || Ok(body.step().map(|_| ())?))?;
        let mut positions = model.surface().positions().to_vec();
        let surface = time_us(1_000, || Ok(body.reconstruct(&mut positions)?))?;
        for ((cost, step), surface) in cost.iter_mut().zip(step).zip(surface) {
            *cost = cost.max(RATE * (step + surface));
        }
    }
    let what = if line == 0 { "modes" } else { "coordinates" };
    let words = format!("{}, {} {what}", LINES[line], baking.modes);
    Ok(Setting { words, line, errors, cost, bytes: model.to_bytes().len(), bake })
}

pub(super) fn elasticity(quick: bool) -> Result<(Vec<Figure>, String), LabError> {
    let mesh = shapes::bar([20, 2, 2], [1.0, 0.1, 0.1])?;
    let held = |modes: usize, material: Option<Material>| BakeConfig {
        material,
        ..config(Element::Tet10, modes, vec![anchor(0, 1e-9)])
    };
    let reference = held(12, Some(Material::NeoHookean));
    let (model, _) = baked(&mesh, &held(4, None))?;
    let corner = farthest(&model, [1.0, 0.1, 0.1]);
    let patch = Patch::around(model.surface(), corner, 0.05)?;
    let mut hands = Vec::new();
    let shares: &[f64] = &[0.02, 0.08, 0.28];
    for share in shares {
        let displacement = [0.0, share * 0.5f64.sqrt(), share * 0.5f64.sqrt()];
        let prescribed = [PrescribedPatch { patch: patch.clone(), displacement }];
        let loads = StaticLoads { prescribed: &prescribed, ..StaticLoads::default() };
        hands.push((patch.clone(), displacement, deflect(&mesh, &reference, Material::NeoHookean, &loads)?));
    }
    let counts: [&[usize]; 2] = if quick { [&[20], &[20]] } else { [&[6, 20, 60], &[12, 20, 36]] };
    let mut settings = Vec::new();
    for line in 0..LINES.len() {
        for &count in counts[line.min(1)] {
            let material = if line == 0 { None } else { Some(Material::NeoHookean) };
            settings.push(setting(line, &mesh, &held(count, material), &hands)?);
        }
    }
    let figures = ["eye", "hand"].into_iter().zip([1, 0]).map(|(who, which)| {
        let mut series = Vec::new();
        for (line, name) in LINES.iter().enumerate() {
            for (index, share) in shares.iter().enumerate() {
                let own = settings.iter().filter(|setting| setting.line == line);
                let points = own.map(|setting| (setting.cost[0], setting.errors[index][which])).collect();
                let name = format!("{name}, led by {:.0} % of the length", 100.0 * share);
                series.push(Series::new(&name, points));
            }
        }
        let (title, y) = match who {
            "eye" => ("Elasticity: what is seen", "largest error of the surface / length"),
            _ => ("Elasticity: what is felt", "reaction error / reaction"),
        };
        figure(
            &format!("h-elasticity-{who}"),
            title,
            "us of one core for a second at rest after the pull, 60 steps and 60 surfaces",
            y,
            series,
            None,
            "A bar ten times as long as thick is clamped at one end, and a hand leads a corner of the other end sideways, in all three directions held where the full nonlinear solution of the same neo-Hookean material on the same ten-node tetrahedra has it. Each point is a number of modes or coordinates. The times are taken at rest after the pull, 20 s after the hand has come there; while a hand moves, a step of reduced elasticity may need more rounds of Newton's method, and takes longer.".into(),
        )
    });
    let figures: Vec<Figure> = figures.collect();
    let mut text = String::from(
        "| setting | us for a second at rest after the pull, 50 % / 99 % | reaction error % at 2 / 8 / 28 % | surface error % of the length | file kB | bake s |\n| --- | --- | --- | --- | --- | --- |\n",
    );
    for setting in &settings {
        let list = |which: usize| {
            let all: Vec<String> =
                setting.errors.iter().map(|error| format!("{:.2}", 100.0 * error[which])).collect();
            all.join(" / ")
        };
        let _ = writeln!(
            text,
            "| {} | {:.0} / {:.0} | {} | {} | {} | {:.2} |",
            setting.words,
            setting.cost[0],
            setting.cost[1],
            list(0),
            list(1),
            setting.bytes / 1_000,
            setting.bake
        );
    }
    let best = |line: usize, which: usize, index: usize| {
        let errors = settings.iter().filter(|setting| setting.line == line);
        100.0 * errors.map(|setting| setting.errors[index][which]).fold(f64::INFINITY, f64::min)
    };
    let most = |line: usize, which: usize, index: usize| {
        let errors = settings.iter().filter(|setting| setting.line == line);
        100.0 * errors.map(|setting| setting.errors[index][which]).fold(0.0, f64::max)
    };
    let cheapest = |line: usize| {
        let costs = settings.iter().filter(|setting| setting.line == line).map(|setting| setting.cost[0]);
        costs.fold(f64::INFINITY, f64::min)
    };
    let dear = settings.iter().map(|setting| setting.cost[0]).fold(0.0, f64::max);
    let _ = write!(
        text,
        "\nWhat is *felt* decides: with linear elasticity the reaction is off by {:.0} % at best where the hand goes 8 % of the length (and by {:.0} % at worst{}), and by {:.0} % at best at 28 %. With reduced elasticity and the patch's own shapes it is off by {:.1} and {:.1} % at best. What is *seen* at 28 % is off by {:.2} % of the length at best with linear elasticity, {:.2} % with reduced elasticity, and {:.2} % with the patch's own shapes. Linear elasticity begins at {:.0} us for a second at rest after the pull, and reduced elasticity with a hand takes up to {:.0} us, {:.1} % of one core. A model that was baked with a material therefore has reduced elasticity by default. Linear elasticity needs no material in the file, and serves crowds and bodies that are only looked at.\n",
        best(0, 0, 1),
        most(0, 0, 1),
        if most(0, 0, 1) > best(0, 0, 1) { ": more modes do not help" } else { "" },
        best(0, 0, 2),
        best(2, 0, 1),
        best(2, 0, 2),
        best(0, 1, 2),
        best(1, 1, 2),
        best(2, 1, 2),
        cheapest(0),
        dear,
        dear / 1e4,
    );
    Ok((figures, text))
}
