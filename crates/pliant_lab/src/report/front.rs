//! Figure g: all settings together on one dragged, moving body, with the cost and error of each.

use std::{fmt::Write, sync::Arc, time::Instant};

use pliant_mesh::shapes;
use pliant_modal::{
    Body, BodyConfig, Element, GrabConfig, Integrator, ModalModel, Patch, Precision, StepSettings,
};
use pliant_stream::{
    Playout, RecoveryConfig,
    emulator::{LinkConfig, Preset},
};

use super::{
    networks::EQUAL,
    physics::figure,
    plot::{Figure, Series},
    work::{anchor, baked, config},
};
use crate::{LabError, experiment::Experiment, machine::Pinned, progress::Progress};

/// Surfaces a second.
const PICTURES: f64 = 60.0;
/// Duration of the motion, s.
const SECONDS: f64 = 2.0;
const ALPHA: Integrator = Integrator::GeneralizedAlpha { rho_inf: 0.5 };

/// Forces on the hand and positions on the surface every 1/60 s, and the times of the run.
struct FrontRun {
    force: Vec<[f64; 3]>,
    /// Displacements of the vertices that every mesh shares, m.
    places: Vec<Vec<[f64; 3]>>,
    /// Times of all steps and of all surfaces, us.
    step_us: Vec<f64>,
    surface_us: Vec<f64>,
}

/// The vertices at `places`, which are the vertices of the coarsest mesh. `None` if one is missing.
fn shared(model: &ModalModel, places: &[[f32; 3]]) -> Option<Vec<usize>> {
    let positions = model.surface().positions();
    let apart = |a: &[f32; 3], b: &[f32; 3]| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-5);
    places.iter().map(|place| positions.iter().position(|p| apart(p, place))).collect()
}

/// Runs two seconds under a hand that circles. The radius grows during the first second.
fn moving(model: &Arc<ModalModel>, places: &[usize], config: BodyConfig) -> Result<FrontRun, LabError> {
    let _pinned = Pinned::new();
    let (step, per) = (config.step, (1.0 / PICTURES / config.step).round().max(1.0) as usize);
    let mut body = Body::new(model.clone(), config)?;
    // The hand holds the middle of the end, which is a vertex of every mesh. The compliance of a
    // corner would depend on the mesh.
    let middle = [1.0f32, 0.1, 0.1];
    let away = |p: &[f32; 3]| (0..3).map(|k| (p[k] - middle[k]).powi(2)).sum::<f32>();
    let positions = model.surface().positions();
    let vertex = (0..positions.len() as u32)
        .min_by(|a, b| away(&positions[*a as usize]).total_cmp(&away(&positions[*b as usize])))
        .unwrap_or(0);
    let patch = Patch::around(model.surface(), vertex, 0.1)?;
    let grab = body.grab(&patch, GrabConfig::default())?;
    let start = body.grab_position(grab)?;
    let rest = model.surface().positions();
    let mut surface = rest.to_vec();
    let mut run =
        FrontRun { force: Vec::new(), places: Vec::new(), step_us: Vec::new(), surface_us: Vec::new() };
    for i in 1..=(SECONDS * PICTURES) as usize * per {
        let t = i as f64 * step;
        let (sin, cos) = (std::f64::consts::TAU * 0.8 * t).sin_cos();
        let s = 0.1 * crate::smooth(t);
        body.set_target(grab, [start[0], start[1] + s * cos, start[2] + 0.6 * s * sin])?;
        let began = Instant::now();
        body.step()?;
        run.step_us.push(began.elapsed().as_secs_f64() * 1e6);
        if i % per == 0 {
            let began = Instant::now();
            body.reconstruct(&mut surface)?;
            run.surface_us.push(began.elapsed().as_secs_f64() * 1e6);
            run.force.push(body.reaction(grab)?);
            let moved =
                |&v: &usize| std::array::from_fn(|k| f64::from(surface[v][k]) - f64::from(rest[v][k]));
            run.places.push(places.iter().map(moved).collect());
        }
    }
    Ok(run)
}

/// Times a setting over some runs, of which the one before them fills the caches. The errors are
/// the same in all runs. Returns the median cost of a second, its 99th percentile, and a run.
fn timed(
    model: &Arc<ModalModel>,
    places: &[usize],
    setting: &BodyConfig,
    runs: usize,
) -> Result<([f64; 2], FrontRun), LabError> {
    moving(model, places, setting.clone())?;
    let (mut steps, mut surfaces) = (Vec::new(), Vec::new());
    let mut run = moving(model, places, setting.clone())?;
    for _ in 0..runs {
        steps.append(&mut run.step_us);
        surfaces.append(&mut run.surface_us);
        run = moving(model, places, setting.clone())?;
    }
    let at = |times: &mut Vec<f64>, part: f64| {
        times.sort_by(f64::total_cmp);
        times[((times.len() - 1) as f64 * part) as usize]
    };
    let cost =
        [0.5, 0.99].map(|part| at(&mut steps, part) / setting.step + PICTURES * at(&mut surfaces, part));
    Ok((cost, run))
}

/// Root mean square of the difference, relative to that of the reference.
fn relative<'a>(got: impl Iterator<Item = &'a [f64; 3]>, want: impl Iterator<Item = &'a [f64; 3]>) -> f64 {
    let (mut off, mut size) = (0.0, 0.0);
    for (got, want) in got.zip(want) {
        off += (0..3).map(|k| (got[k] - want[k]).powi(2)).sum::<f64>();
        size += want.iter().map(|x| x * x).sum::<f64>();
    }
    (off / size.max(f64::MIN_POSITIVE)).sqrt()
}

/// A setting with its cost (us of one core for a second of motion, median and 99th percentile) and
/// its errors.
#[derive(Debug, Clone)]
struct Choice {
    words: String,
    line: usize,
    cost: [f64; 2],
    shape: f64,
    force: f64,
    bake: f64,
    default: bool,
}

/// The settings that have a smaller error than every cheaper setting, cheapest first.
fn pareto(choices: &[Choice], error: impl Fn(&Choice) -> f64) -> Vec<&Choice> {
    let mut sorted: Vec<&Choice> = choices.iter().collect();
    sorted.sort_by(|a, b| a.cost[0].total_cmp(&b.cost[0]));
    let mut best = f64::INFINITY;
    sorted.retain(|choice| {
        let better = error(choice) < best;
        best = best.min(error(choice));
        better
    });
    sorted
}

/// A sentence with the cheapest settings whose errors stay within given bounds.
fn advice(front: &[&Choice], error: impl Fn(&Choice) -> f64, what: &str) -> String {
    let mut out = format!("*{what}*:");
    let mut last = "";
    for bound in [0.2, 0.1, 0.05, 0.02, 0.01] {
        match front.iter().find(|choice| error(choice) <= bound) {
            Some(choice) if choice.words != last => {
                let _ = write!(
                    out,
                    " within {:.0} % {} ({:.0} us);",
                    100.0 * bound,
                    choice.words,
                    choice.cost[0]
                );
                last = &choice.words;
            }
            Some(_) => {}
            None => {
                let best = front.last().map_or(f64::NAN, |choice| 100.0 * error(choice));
                let _ = write!(out, " {:.0} % is not reached (the best is {best:.1} %);", 100.0 * bound);
                break;
            }
        }
    }
    out.pop();
    out + ". "
}

pub(super) fn all_together(
    quick: bool,
    progress: &mut dyn Progress,
) -> Result<(Vec<Figure>, String), LabError> {
    let (mut figures, mut words) = local(quick, progress)?;
    let (figure, more) = over_network(quick, progress)?;
    figures.push(figure);
    words += &more;
    Ok((figures, words))
}

fn local(quick: bool, progress: &mut dyn Progress) -> Result<(Vec<Figure>, String), LabError> {
    let size = [1.0, 0.2, 0.2];
    let held = |element, modes| config(element, modes, vec![anchor(0, 1e-9)]);
    progress.report("front", 0.0);
    let meshes: &[[usize; 3]] =
        if quick { &[[4, 2, 2], [8, 4, 4]] } else { &[[8, 2, 2], [16, 4, 4], [24, 6, 6]] };
    // The coarser mesh first, and ten-node elements before four-node ones.
    let mut models = Vec::new();
    for &cells in meshes {
        let mesh = shapes::bar(cells, size)?;
        for element in [Element::Tet10, Element::Tet4] {
            let (model, seconds) = baked(&mesh, &held(element, 60))?;
            models.push((cells, element, model, seconds));
        }
    }
    let places = models[0].2.surface().positions().to_vec();
    let every = |model: &ModalModel| {
        shared(model, &places).ok_or(LabError::Bake(pliant_bake::BakeError::Parameter {
            name: "places",
            expected: "vertices that all meshes share",
            got: places.len() as f64,
        }))
    };
    // The reference has a far finer mesh, twice the modes and far shorter steps of second order. A
    // mesh in between estimates the error of the reference.
    let fine = |cells: [usize; 3], rate: f64| -> Result<FrontRun, LabError> {
        let (model, _) = baked(&shapes::bar(cells, size)?, &held(Element::Tet10, 120))?;
        let places = every(&model)?;
        moving(
            &model,
            &places,
            BodyConfig {
                step: 1.0 / rate,
                settings: StepSettings { integrator: ALPHA, ..Default::default() },
                ..BodyConfig::default()
            },
        )
    };
    let truth = fine(if quick { [16, 8, 8] } else { [48, 12, 12] }, 3840.0)?;
    let between = fine(if quick { [12, 6, 6] } else { [32, 8, 8] }, 1920.0)?;
    let shape_of = |run: &FrontRun| relative(run.places.iter().flatten(), truth.places.iter().flatten());
    let force_of = |run: &FrontRun| relative(run.force.iter(), truth.force.iter());
    let own = [shape_of(&between), force_of(&between)];
    let rates: &[f64] = if quick { &[60.0, 240.0] } else { &[60.0, 120.0, 240.0, 480.0] };
    let mut choices = Vec::new();
    let mut names = Vec::new();
    let settings = models.len() * 2 * rates.len() * 5 * 2;
    for (cells, element, model, bake) in &models {
        let nodes = if *element == Element::Tet10 { "ten-node" } else { "four-node" };
        let mesh = cells.map(|cells| cells.to_string()).join(" x ");
        let places = every(model)?;
        names.push(format!("{nodes}, {mesh} cells"));
        for (integrator, name) in [(Integrator::Exact, "exact"), (ALPHA, "generalized-alpha")] {
            for &rate in rates {
                for modes in [3, 6, 12, 24, 60] {
                    for (precision, half) in [(Precision::Single, ""), (Precision::Half, ", half precision")]
                    {
                        progress.report("front", choices.len() as f64 / settings as f64);
                        let setting = BodyConfig {
                            step: 1.0 / rate,
                            modes: Some(modes),
                            precision,
                            settings: StepSettings { integrator, ..Default::default() },
                        };
                        let (cost, run) = timed(model, &places, &setting, if quick { 1 } else { 4 })?;
                        choices.push(Choice {
                            words: format!("{modes} modes, {nodes}, {mesh}, {name} at {rate:.0} Hz{half}"),
                            line: names.len() - 1,
                            cost,
                            shape: shape_of(&run),
                            force: force_of(&run),
                            bake: *bake,
                            default: *cells == meshes[0]
                                && *element == Element::Tet10
                                && integrator == Integrator::Exact
                                && rate == 60.0
                                && modes == 60
                                && precision == Precision::Single,
                        });
                    }
                }
            }
        }
    }
    let series = |error: &dyn Fn(&Choice) -> f64, front: &[&Choice]| {
        let mut out: Vec<Series> = names
            .iter()
            .enumerate()
            .map(|(line, name)| {
                let points = choices.iter().filter(|c| c.line == line).map(|c| (c.cost[0], error(c)));
                Series::new(name, points.collect()).scattered()
            })
            .collect();
        out.push(Series::new(
            "the front: no cheaper one is as good",
            front.iter().map(|c| (c.cost[0], error(c))).collect(),
        ));
        out
    };
    let (shape, force) = (|c: &Choice| c.shape, |c: &Choice| c.force);
    let (eye, hand) = (pareto(&choices, shape), pareto(&choices, force));
    let x = "us of one core for a second of motion, all steps and 60 surfaces";
    let what = format!(
        "A bar is held at one end, and a hand leads the other end in circles of a tenth of the length for {SECONDS:.0} s. Each point is a setting with 3 to 60 modes, four-node or ten-node tetrahedra on {} meshes, \
         exact or generalized-alpha steps of {} a second, and single or half precision. The reference is a far finer mesh of ten-node tetrahedra with 120 modes and 3,840 steps a second, with the warp, which all settings have (figure d shows the error of the warp). The error of the reference is estimated by its distance from the next coarser one.",
        if quick { "two" } else { "three" },
        rates.iter().map(|rate| format!("{rate:.0}")).collect::<Vec<_>>().join(", ")
    );
    let figures = vec![
        figure(
            "g-front-eye",
            "All together: what is seen",
            x,
            "error of the surface, rms / rms",
            series(&shape, &eye),
            Some(own[0]),
            what.clone(),
        ),
        figure(
            "g-front-hand",
            "All together: what is felt",
            x,
            "error of the reaction, rms / rms",
            series(&force, &hand),
            Some(own[1]),
            format!("The figure shows the same settings by the error of the reaction. {what}"),
        ),
    ];
    let mut text = String::from(
        "The settings on either front are, cheapest first:\n\n| setting | us for a second of motion, 50 % / 99 % | surface error % | reaction error % | bake s | on the front for |\n| --- | --- | --- | --- | --- | --- |\n",
    );
    let mut rows: Vec<&Choice> = choices.iter().collect();
    rows.sort_by(|a, b| a.cost[0].total_cmp(&b.cost[0]));
    for choice in rows {
        let on = |front: &[&Choice]| front.iter().any(|other| other.words == choice.words);
        let which = match (on(&eye), on(&hand)) {
            (true, true) => "both",
            (true, false) => "the eye",
            (false, true) => "the hand",
            (false, false) if choice.default => "neither: the default of linear elasticity",
            (false, false) => continue,
        };
        let _ = writeln!(
            text,
            "| {}{} | {:.0} / {:.0} | {:.2} | {:.2} | {:.3} | {which} |",
            choice.words,
            if choice.default { " (default)" } else { "" },
            choice.cost[0],
            choice.cost[1],
            100.0 * choice.shape,
            100.0 * choice.force,
            choice.bake,
        );
    }
    let best = |line: usize, error: &dyn Fn(&Choice) -> f64| {
        choices.iter().filter(|c| c.line == line).map(error).fold(f64::INFINITY, f64::min)
    };
    let _ = write!(
        text,
        "\nWhich setting for which need, by these points: {}{}",
        advice(&eye, shape, "a body that is looked at"),
        advice(&hand, force, "a body that is felt"),
    );
    text += "The mesh decides the least error: at best, what is seen and what is felt are off by ";
    for (line, name) in names.iter().enumerate() {
        let [seen, felt] = [best(line, &shape), best(line, &force)].map(|error| 100.0 * error);
        let before = if line == 0 { "" } else { "; by " };
        let _ = write!(text, "{before}{seen:.2} and {felt:.2} % with {name}");
    }
    text += ". The element and the mesh affect the time of the bake, and a finer mesh has more vertices to write.";
    if let Some(default) = choices.iter().find(|choice| choice.default) {
        let cheaper = |error: &dyn Fn(&Choice) -> f64| {
            let better = choices.iter().filter(|c| c.cost[0] < default.cost[0] && error(c) < error(default));
            better.min_by(|a, b| error(a).total_cmp(&error(b))).map_or_else(
                || "nothing cheaper is better".to_owned(),
                |c| {
                    format!(
                        "{} is better and cheaper ({:.1} %, {:.0} us)",
                        c.words,
                        100.0 * error(c),
                        c.cost[0]
                    )
                },
            )
        };
        let _ = writeln!(
            text,
            " The default of linear elasticity takes {:.0} us and has an error of {:.1} % for the eye ({}) and {:.1} % for the hand ({}).",
            default.cost[0],
            100.0 * default.shape,
            cheaper(&shape),
            100.0 * default.force,
            cheaper(&force),
        );
    }
    Ok((figures, text))
}

/// The second front: the guest's recovery settings over the paper's worst network. All have the
/// playout delay and the repeats that part f gives to all.
fn over_network(quick: bool, progress: &mut dyn Progress) -> Result<(Figure, String), LabError> {
    let (model, _) =
        baked(&shapes::bar([8, 2, 2], [1.0, 0.2, 0.2])?, &config(Element::Tet10, 60, vec![anchor(0, 1e-9)]))?;
    let powers: &[i32] = if quick { &[6, 14] } else { &[4, 6, 8, 10, 14, 18] };
    let mut choices: Vec<Choice> = Vec::new();
    let mut names = Vec::new();
    let (delay, repeats) = EQUAL;
    // With these, `paper-repeats` is `paper`.
    let drawn = RecoveryConfig::NAMES.into_iter().filter(|name| !["none", "paper-repeats"].contains(name));
    for (line, name) in drawn.enumerate() {
        progress.report("network", line as f64 / RecoveryConfig::NAMES.len() as f64);
        names.push(name);
        let named = RecoveryConfig::by_name(name).unwrap_or_default();
        let recovery = RecoveryConfig { repeats, playout: Playout::Fixed(delay), ..named };
        for &power in powers {
            let mut made = Experiment::new(model.clone(), LinkConfig::preset(Preset::Paper1), recovery);
            made.use_the_papers_integrator();
            made.seconds = if quick { 20.0 } else { 60.0 };
            made.quantum = 2.0f64.powi(-power);
            let f = made.run()?;
            choices.push(Choice {
                words: format!("`{name}` with quanta of 2^-{power}"),
                line,
                cost: [f.kbit_s; 2],
                shape: f.rms_percent / 100.0,
                force: f.force_rms_percent / 100.0,
                bake: 0.0,
                default: name == "default" && power == 14,
            });
        }
    }
    let error = |c: &Choice| c.shape;
    let front = pareto(&choices, error);
    let mut series: Vec<Series> = names
        .iter()
        .enumerate()
        .map(|(line, name)| {
            let points = choices.iter().filter(|c| c.line == line).map(|c| (c.cost[0], 100.0 * c.shape));
            Series::new(*name, points.collect()).scattered()
        })
        .collect();
    series.push(Series::new(
        "the front: no smaller one is as good",
        front.iter().map(|c| (c.cost[0], 100.0 * c.shape)).collect(),
    ));
    let mut text = String::from(
        "\nOver the paper's worst network (9 % lost, 196 ms), the settings on the front are, smallest first:",
    );
    for choice in &front {
        let default = if choice.default { ", the default" } else { "" };
        let _ = write!(
            text,
            " {} {:.0} kbit/s, {:.3} %{default};",
            choice.words,
            choice.cost[0],
            100.0 * choice.shape
        );
    }
    text.pop();
    text.push('.');
    if let Some(default) = choices.iter().find(|c| c.default && !front.iter().any(|f| f.words == c.words)) {
        let _ = write!(
            text,
            " The default ({:.0} kbit/s, {:.3} %) is not on it.",
            default.cost[0],
            100.0 * default.shape
        );
    }
    text.push('\n');
    let made = figure(
        "g-front-network",
        "All together: over the paper's worst network",
        "down, kbit/s",
        "shown error, rms, % of the largest displacement",
        series,
        None,
        format!(
            "A bar of 8 x 2 x 2 cells has 60 modes and two hands at the host, at 40 Hz. The figure shows every recovery policy with coarser and finer frames (quanta of 2^-4 to 2^-18 of the deformation, default 2^-14). As in part f, all have a playout delay of {delay} tick and {repeats} repeats. Streams of accelerations have the paper's integrator at both ends. `none` is not drawn, because its errors never decay, and `paper-repeats` is not drawn, because with these repeats it is `paper`."
        ),
    );
    Ok((made, text))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn choice(cost: f64, shape: f64) -> Choice {
        let words = format!("{cost} {shape}");
        Choice { words, line: 0, cost: [cost; 2], shape, force: 0.0, bake: 0.0, default: false }
    }

    #[test]
    fn the_front_holds_what_nothing_cheaper_beats_and_the_advice_is_of_it() {
        let all =
            [choice(3.0, 0.02), choice(1.0, 0.3), choice(2.0, 0.08), choice(2.5, 0.09), choice(4.0, 0.02)];
        let front = pareto(&all, |c| c.shape);
        assert_eq!(front.iter().map(|c| c.cost[0]).collect::<Vec<_>>(), [1.0, 2.0, 3.0]);
        let words = advice(&front, |c| c.shape, "seen");
        assert_eq!(
            words,
            "*seen*: within 20 % 2 0.08 (2 us); within 5 % 3 0.02 (3 us); 1 % is not reached (the best is 2.0 %). "
        );
    }
}
