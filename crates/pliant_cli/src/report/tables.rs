//! Figures e and f, the paper's tables and figures, and the bunny's default setting in words.

use std::{fmt::Write, path::Path, sync::Arc, time::Duration};

use pliant_bake::{BakeConfig, DeadLoad, deflect};
use pliant_mesh::shapes;
use pliant_modal::{BodyConfig, Element, Integrator, ModalModel, Patch, Precision};
use pliant_stream::{
    Newmark, Policy, Predict, RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
    experiment::{Experiment, Figures},
    wire::AccelerationCoding,
};

use super::{
    physics::held_as,
    plot::{Figure, Series},
    work::{anchor, baked, config, farthest, time_us},
};
use crate::{CliError, bench, mesh, progress::Bar, stream};

fn body() -> Result<Arc<ModalModel>, CliError> {
    Ok(baked(&shapes::bar([8, 2, 2], [1.0, 0.2, 0.2])?, &config(Element::Tet10, 60, vec![anchor(0, 1e-9)]))?
        .0)
}

/// Single against half precision of the basis, on a pose of every mode.
pub(super) fn precision() -> Result<(Figure, String), CliError> {
    let (model, _) = baked(
        &shapes::bar([60, 12, 12], [1.0, 0.2, 0.2])?,
        &config(Element::Tet4, 60, vec![anchor(0, 1e-9)]),
    )?;
    let single = model.basis().clone();
    let half = single.to_half();
    // A pull of a fifth of the length, spread over the modes as a static load is: by 1 / omega^2.
    let tip = farthest(&model, [1.0, 0.01, 0.02]);
    let mut q: Vec<f32> = (0..60)
        .map(|k| (f64::from(model.displacement_row(tip, 1, k)) / model.omega()[k].powi(2)) as f32)
        .collect();
    let reach: f32 = (0..60).map(|k| model.displacement_row(tip, 1, k) * q[k]).sum();
    q.iter_mut().for_each(|q| *q *= 0.2 / reach);
    let mut a = vec![[0.0f32; 3]; model.surface().positions().len()];
    let mut b = a.clone();
    let slow = time_us(1_000, || {
        single.reconstruct(&q, true, &mut a);
        Ok(())
    })?;
    let fast = time_us(1_000, || {
        half.reconstruct(&q, true, &mut b);
        Ok(())
    })?;
    let most = a
        .iter()
        .zip(&b)
        .map(|(a, b)| (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>())
        .fold(0.0, f64::max)
        .sqrt();
    let words = format!(
        "{} vertices, 60 modes, pulled by a fifth of the length: a half-precision basis is off by {most:.1e} of the length at most, {:.0} us instead of {:.0} us for the surface ({} and {} bytes read and written). It is `BodyConfig::precision` and `ModalBody::half_basis`.",
        a.len(),
        fast[0],
        slow[0],
        half.traffic_bytes(60),
        single.traffic_bytes(60)
    );
    let points = vec![
        Series::timed("f16 basis", vec![(fast, most)]),
        Series::timed("f32 basis (drawn at its rounding)", vec![(slow, 6e-8)]),
    ];
    let figure = Figure {
        file: "e-precision".into(),
        title: "Half precision of the basis".into(),
        x: "whole surface, us (median)".into(),
        y: "largest error / length".into(),
        logarithmic: true,
        series: points,
        reference_error: Some(6e-8),
        words: words.clone(),
    };
    Ok((figure, words))
}

/// Every way of repair on the four networks of the paper.
pub(super) fn networks(quick: bool, bar: &mut Bar) -> Result<(Figure, String), CliError> {
    let model = body()?;
    let mut series = Vec::new();
    let mut table = "| network | repair | rms % | largest % | kbit/s | us a tick |\n| --- | --- | --- | --- | --- | --- |\n".to_owned();
    for (done, name) in RecoveryConfig::NAMES.into_iter().enumerate() {
        let mut points = Vec::new();
        for preset in [Preset::Paper1, Preset::Paper2, Preset::Paper3, Preset::Paper4] {
            bar.report("network", done as f64 / RecoveryConfig::NAMES.len() as f64);
            let recovery = RecoveryConfig::by_name(name).unwrap_or_default();
            let mut experiment = Experiment::new(model.clone(), LinkConfig::preset(preset), recovery);
            if !matches!(recovery.policy, Policy::ForceDriven { .. }) {
                experiment.integrator = Integrator::GeneralizedAlpha { rho_inf: 0.5 };
            }
            experiment.seconds = if quick { 20.0 } else { 60.0 };
            experiment.cpu_clock = Some(stream::clock);
            let f = experiment.run()?;
            points.push((f.kbit_s, f.rms_percent.max(1e-5)));
            let _ = writeln!(
                table,
                "| {} | {name} | {:.4} | {:.2} | {:.1} | {:.1} |",
                preset.name(),
                f.rms_percent,
                f.max_percent,
                f.kbit_s,
                f.cpu_us_per_tick
            );
        }
        series.push(Series::new(name, points));
    }
    let words = "Each line is a way of repair, its points the paper's four networks (9, 6, 3, 0 % loss); lower and further left is better. `none` and the paper's ways stream accelerations, the other two reactions.".to_owned();
    let figure = Figure {
        file: "f-network".into(),
        title: "Ways of repair on the paper's four networks".into(),
        x: "down, kbit/s".into(),
        y: "shown error, rms, % of the largest displacement".into(),
        logarithmic: true,
        series,
        reference_error: None,
        words,
    };
    Ok((figure, table))
}

/// The paper's figures 7 to 9: losses that its compensation takes out again, and what the default way shows with the same losses.
pub(super) fn courses() -> Result<Vec<Figure>, CliError> {
    let model = body()?;
    let mut random: Vec<u64> = (0..22u64).map(|k| 135 + (k * 7919 + 31) % 311).collect();
    random.sort_unstable();
    let cases = [
        ("7", "22 lost at random from tick 135", random),
        ("8", "12 lost in a row from tick 140", (140..152).collect()),
        ("9", "one in 50 lost from tick 135, 11 in all", (0..11).map(|k| 135 + 50 * k).collect()),
    ];
    let mut out = Vec::new();
    for (number, title, lost) in cases {
        let run = |mut recovery: RecoveryConfig, paper: bool| -> Result<Figures, CliError> {
            recovery.coding = AccelerationCoding::F64;
            let link = LinkConfig {
                delay: Duration::from_millis(10),
                loss: Loss::Listed(lost.clone()),
                ..LinkConfig::default()
            };
            let mut e = Experiment::new(model.clone(), link, recovery);
            if paper {
                e.integrator = Integrator::Newmark;
                e.newmark = Newmark::average(0.025);
                e.resend_after = Duration::from_secs_f64(50.0 * 0.025);
            }
            (e.seconds, e.keep_track) = (18.5, true);
            e.hands.iter_mut().for_each(|h| h.tremor = 0.0);
            Ok(e.run()?)
        };
        let lines = [
            ("the paper's, over 50 ticks", run(RecoveryConfig::paper_with(Predict::Linear, 50), true)?),
            ("the paper's, at once", run(RecoveryConfig::paper_with(Predict::Linear, 1), true)?),
            ("default", run(RecoveryConfig::default(), false)?),
        ];
        let mut series = Vec::new();
        let mut words = format!(
            "As the paper's figure {number}: {title}, found 50 ticks later. Largest error, % of the largest displacement:"
        );
        for (name, f) in &lines {
            let points = f
                .track
                .iter()
                .map(|t| (t.0 as f64 - f.track[0].0 as f64, 100.0 * (t.2 - t.1) / f.scale.max(1e-12)));
            series.push(Series::new(*name, points.collect()));
            let _ = write!(words, " {name} {:.2} (at the end {:.1e});", f.max_percent, f.end_percent);
        }
        words.pop();
        words.push('.');
        out.push(Figure {
            file: format!("paper-{number}"),
            title: format!("Paper's figure {number}: {title}"),
            x: "tick".into(),
            y: "shown - true at the hand, % of the largest".into(),
            logarithmic: false,
            series,
            reference_error: None,
            words,
        });
    }
    Ok(out)
}

/// A row of the paper's table 2: name, tetrahedra, modes, its bake (s) and steps a second.
const PAPER: [(&str, usize, usize, f64, f64); 4] = [
    ("bar", 1_080, 20, 0.11, 1124.2),
    ("bunny", 50_000, 60, 14.7, 264.2),
    ("armadillo", 49_729, 120, 21.3, 134.8),
    ("dragon", 100_000, 100, 33.6, 56.8),
];

const BOUND: &str = "\nWhat bounds it: a step takes a few microseconds; the rest is the surface, and the surface is one pass over the basis, 24 bytes a vertex and mode (displacement and \
    rotation, single precision), read once a frame. Its speed is beside that of a plain sum over a buffer of as many bytes in the same run: where that is near 100 %, nothing is left to gain \
    but fewer bytes. Half precision is that (12 bytes; `ModalBody::half_basis`), so is leaving out modes that move nothing by a tenth of a pixel (`SurfaceDetail`, on by default in the picture, off here). The limit itself \
    moves with what else the machine's memory serves. What differs from the paper: its processor (one core of a 2.93 GHz Core 2 Duo of 2008), its meshes of the same sizes, and the warp, which is in our surface.\n";

/// Table 2 beside the paper's numbers. Surfaces that may not be shipped are taken from `models` when they are there.
pub(super) fn table_2(models: &Path, own: &Path, seconds: f64, bar: &mut Bar) -> Result<String, CliError> {
    let mut out = "| body | tetrahedra | modes | surface | bake s (paper) | step us, 50 % / 99 % | surface us, 50 % / 99 % | steps/s with surface and hand (paper) | ratio | of the memory's limit | half-precision basis: surface us, 50 % / 99 % | ratio | of the memory's limit |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n".to_owned();
    for (name, tets, modes, paper_bake, paper_rate) in PAPER {
        let (source, label) = match name {
            "bar" => (None, "bar"),
            // The dragon may not be changed by others: the project's own body stands in for it.
            "dragon" => (Some(own.to_path_buf()), "own body, for the dragon"),
            _ => (Some(models.join(format!("{name}.obj"))), name),
        };
        if source.as_ref().is_some_and(|path| !path.is_file()) {
            let _ = writeln!(out, "| {label} | not there |  |  |  |  |  |  |  |  |  |  |  |");
            continue;
        }
        let mesh = match &source {
            None => shapes::bar([20, 3, 3], [1.0, 0.15, 0.15])?,
            Some(path) => mesh::fill(path, Some(tets), bar)?.0,
        };
        let low = mesh.bounds()[0];
        let high = mesh.bounds()[1];
        let held =
            if source.is_none() { anchor(0, 1e-9) } else { anchor(1, low[1] + 0.06 * (high[1] - low[1])) };
        bar.report("bake", 0.5);
        let (model, bake) =
            baked(&mesh, &BakeConfig { sites: None, ..config(Element::Tet4, modes, vec![held]) })?;
        let told = bench::measure(model.clone(), seconds, Precision::Single)?;
        let rate = 1e6 / (told.step_us.p50 + told.reconstruct_us.p50);
        let half = bench::measure(model, seconds, Precision::Half)?;
        let halved = 1e6 / (half.step_us.p50 + half.reconstruct_us.p50) / paper_rate;
        let _ = writeln!(
            out,
            "| {label} | {} | {modes} | {} vertices | {bake:.2} ({paper_bake}) | {:.2} / {:.2} | {:.1} / {:.1} | {rate:.0} ({paper_rate}) | {:.1} | {:.0} % | {:.1} / {:.1} | {halved:.1} | {:.0} % |",
            mesh.tets.len(),
            told.surface_vertices,
            told.step_us.p50,
            told.step_us.p99,
            told.reconstruct_us.p50,
            told.reconstruct_us.p99,
            rate / paper_rate,
            100.0 * told.bandwidth_gb_s / told.bandwidth_limit_gb_s,
            half.reconstruct_us.p50,
            half.reconstruct_us.p99,
            100.0 * half.bandwidth_gb_s / half.bandwidth_limit_gb_s
        );
    }
    out.push_str(BOUND);
    Ok(out)
}

/// The default setting against the full nonlinear solution: the bunny by its ear, or the project's own body where the bunny is not there.
pub(super) fn default_setting(
    models: &Path,
    own: &Path,
    tets: usize,
    bar: &mut Bar,
) -> Result<String, CliError> {
    let bunny = models.join("bunny.obj");
    let (path, name) = if bunny.is_file() { (bunny, "bunny") } else { (own.to_path_buf(), "own body") };
    let (mesh, _) = mesh::fill(&path, Some(tets), bar)?;
    let [low, high] = mesh.bounds();
    let setting = BakeConfig {
        sites: None,
        ..config(Element::Tet4, 60, vec![anchor(1, low[1] + 0.06 * (high[1] - low[1]))])
    };
    bar.report("bake", 0.2);
    let (model, _) = baked(&mesh, &setting)?;
    let size = model.size();
    // Where the first mode moves most: a body is pulled where it gives.
    let moves = |v: u32| (0..3).map(|axis| model.displacement_row(v, axis, 0).powi(2)).sum::<f32>();
    let vertex = (0..model.surface().positions().len() as u32)
        .max_by(|a, b| moves(*a).total_cmp(&moves(*b)))
        .unwrap_or(0);
    let patch = Patch::around(model.surface(), vertex, 0.06 * size)?;
    let way: [f64; 3] = std::array::from_fn(|axis| f64::from(model.displacement_row(vertex, axis, 0)));
    let length = way.iter().map(|x| x * x).sum::<f64>().sqrt();
    let unit = deflect(
        &mesh,
        &setting,
        &[DeadLoad { patch: patch.clone(), force: way.map(|x| 1e-9 * x / length) }],
    )?;
    let give = unit.patches[0].iter().map(|x| x * x).sum::<f64>().sqrt() / 1e-9;
    let mut out = format!(
        "The {name}, {} tetrahedra, 60 modes, default setting (exact step of 1/60 s, warp, residual flexibility), held at its foot and pulled where it gives most, against a St. Venant-Kirchhoff solution on the same mesh:\n\n| pulled by, % of the size | surface off by, rms / largest, % of the size | without warp, largest | force along the pull off by, % (all of it) | without warp | step us |\n| --- | --- | --- | --- | --- | --- |\n",
        mesh.tets.len()
    );
    let mut words = String::new();
    for share in [0.02, 0.05, 0.1, 0.2] {
        bar.report("nonlinear", share / 0.2);
        let load =
            vec![DeadLoad { patch: patch.clone(), force: way.map(|x| share * size / give * x / length) }];
        let truth = match deflect(&mesh, &setting, &load) {
            Ok(truth) => truth,
            Err(error) => {
                let _ = writeln!(
                    out,
                    "| {:.0} (by the linear theory) | no nonlinear solution: {error} |  |  |  |  |",
                    100.0 * share
                );
                continue;
            }
        };
        let reach = truth.patches[0].iter().map(|x| x * x).sum::<f64>().sqrt() / size;
        let held = held_as(&model, &load, &truth, BodyConfig::default())?;
        let flat = held_as(&model, &load, &truth, BodyConfig { warp: false, ..BodyConfig::default() })?;
        let _ = writeln!(
            out,
            "| {:.1} | {:.3} / {:.2} | {:.2} | {:.1} ({:.0}) | {:.1} ({:.0}) | {:.1} |",
            100.0 * reach,
            100.0 * held.shape[0] / size,
            100.0 * held.shape[1] / size,
            100.0 * flat.shape[1] / size,
            100.0 * held.along,
            100.0 * held.force,
            100.0 * flat.along,
            100.0 * flat.force,
            held.step_us[0]
        );
        if share == 0.1 {
            words = format!(
                "\nIn words: pull the {name} by {:.0} % of its size, and no point that you see is further than {:.2} % of its size from where the full nonlinear solution has it ({:.1} mm on a {name} 20 cm \
                 large); without the warp it would be {:.1} times as far. A step takes {:.1} us (the bound is a millisecond). The pull that you feel along the way is off by {:.0} %; a hand \
                 that also fixes the patch sideways, exactly where the nonlinear body has it, feels more than that (in brackets), as it presses against directions that are stiff.\n",
                100.0 * reach,
                100.0 * held.shape[1] / size,
                200.0 * held.shape[1] / size,
                flat.shape[1] / held.shape[1].max(1e-12),
                held.step_us[0],
                100.0 * held.along,
            );
        }
    }
    out.push_str(&words);
    Ok(out)
}
