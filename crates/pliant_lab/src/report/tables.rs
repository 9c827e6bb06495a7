//! Figure e1, the paper's table 2, and the bunny in words.

use std::{
    fmt::Write,
    path::{Path, PathBuf},
    sync::Arc,
};

use pliant_bake::{BakeConfig, BakeError, DeadLoad, Material, StaticLoads, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{BodyConfig, Element, ModalModel, Patch, Precision, StepSettings};
use pliant_stream::{
    RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
};

use super::{
    plot::{Axes, Figure, Series},
    warp::{held_as, under},
    work::{anchor, baked, config, farthest, time_us},
};
use crate::{
    LabError, bench,
    experiment::{Experiment, Metrics},
    fill::fill,
    machine,
    progress::Progress,
};

pub(super) fn body() -> Result<Arc<ModalModel>, LabError> {
    Ok(baked(&shapes::bar([8, 2, 2], [1.0, 0.2, 0.2])?, &config(Element::Tet10, 60, vec![anchor(0, 1e-9)]))?
        .0)
}

/// Compares single and half precision of the basis, on a pose of every mode.
pub(super) fn precision() -> Result<Figure, LabError> {
    let (model, _) = baked(
        &shapes::bar([60, 12, 12], [1.0, 0.2, 0.2])?,
        &config(Element::Tet4, 60, vec![anchor(0, 1e-9)]),
    )?;
    let single = model.basis().clone();
    let half = single.to_half();
    // The pose displaces the tip by a fifth of the length. It is spread over the modes as a static
    // load is, by 1 / omega^2.
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
        "{} vertices, 60 modes, pulled by a fifth of the length: a half-precision basis has an error of {most:.1e} of the length at most and takes {:.0} us instead of {:.0} us for the surface ({} and {} bytes read and written). The settings are `BodyConfig::precision` and `ModalBody::half_basis`.",
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
    Ok(Figure {
        file: "e-precision".into(),
        title: "Half precision of the basis".into(),
        x: "whole surface, us (median)".into(),
        y: "largest error / length".into(),
        axes: Axes::Logarithmic,
        series: points,
        reference_error: Some(6e-8),
        words,
        below: None,
    })
}

/// A row of the paper's table 2: name, tetrahedra, modes, bake time (s) and steps a second. The
/// paper has these with its compensation and without. Which of the two this column is was not noted
/// when it was copied, and the other one was not copied.
const PAPER: [(&str, usize, usize, f64, f64); 4] = [
    ("bar", 1_080, 20, 0.11, 1124.2),
    ("bunny", 50_000, 60, 14.7, 264.2),
    ("armadillo", 49_729, 120, 21.3, 134.8),
    ("dragon", 100_000, 100, 33.6, 56.8),
];

/// Goal of each row as a multiple of the paper's steps a second.
const BAR: f64 = 20.0;

const BOUND: &str = "\nAll bodies have linear elasticity (`BakeConfig::linear`); a step of reduced elasticity, which a bake has by default, takes longer (figure h). A frame is a step under a moving hand, followed by the reconstruction of the whole surface. The steps a second are those of the median frame. The memory bandwidth bounds the frame: a step takes a few microseconds, and the rest is the surface. The surface is one pass over the basis, which has 24 bytes for each vertex and mode (displacement and rotation, single precision) and is read once a frame. The column \"of the memory's limit\" compares the speed of this pass with the fastest of some thousand passes in the same run, which include plain sums over a buffer of the same size as well as surfaces. Near 100 %, only fewer bytes can make the frame faster. Half precision needs 12 bytes (`ModalBody::half_basis`) and is off by default, so a row that reaches the goal only in half precision does not reach it by default. Another way is to leave out modes that move no vertex by a tenth of a pixel (`SurfaceDetail`, which is on by default for the picture and off here). The limit itself depends on what else uses the memory of the machine. Of the steps a second the paper has two columns, with its compensation and without. One of them is quoted here and the other is not, and which of them it is was not noted, so that the ratio may be too high or too low by what compensation took there (the next part has what it takes here). The paper differs in its processor (one core of a 2.93 GHz Core 2 Duo of 2008) and in its meshes, which have the same sizes. Our surface also includes the warp.\n";

/// Where the surfaces are from that table 2 and the last part measure.
const SURFACES: &str = "\nWhere the surfaces are from: the bunny and the armadillo are reconstructions of the [Stanford 3D Scanning Repository](https://graphics.stanford.edu/data/3Dscanrep/), which has them as PLY files. The files behind the figures of this repository are decimated and rescaled copies of them as closed OBJ files: bunny.obj with 3,301 vertices, y from -0.77 to 0.77 (SHA-256 d97f4aa37c2f3bfb14eceb3d06ac1f466062dc45f08e019bfbae9704c28654b6), and armadillo.obj with 14,587 vertices, y from -0.57 to 0.43 (SHA-256 17200138dad1ad0f86ef9a98dd38f9932098b2c9e94d8694bd3f6143601e8c54). By which program they were decimated is not known, so that a copy of your own has other vertices and somewhat other figures. Any closed surface of that name will do in the folder of `--models`. The repository's terms allow copies with an acknowledgement and no commercial use, so that a project under MIT or Apache-2.0 does not ship them. For a surface that is not there, and for the dragon, which may not be deformed, the project's own body stands in.\n";

/// Says whether a row reaches the goal.
fn verdict(single: f64, half: f64) -> String {
    match (single >= BAR, half >= BAR) {
        (true, _) => format!("reaches {BAR:.0}"),
        (false, true) => format!("**short of {BAR:.0}** by default; reaches it in half precision, an option"),
        (false, false) => format!("**short of {BAR:.0}**, in half precision too"),
    }
}

const REPAIR: &str = "The paper's table 2 is with its compensation and without. This is the processor time of a tick at a guest that repairs as the paper does (linear elasticity, average acceleration, linear prediction, compensation over 50 ticks; two hands, 40 Hz; decoding, correcting and stepping, without the surface), without loss and with 9 % lost and compensated. Each is the median of 15 sessions, which take turns, so that what else the machine does meets both; the ratios are those of two neighbors, median, least and largest. The last column is what each session with loss lost and compensated. A tick does not depend on the number of tetrahedra, so that the bodies here, but for the bar, are those of table 2 with fewer of them.\n\n| body | modes | without compensation, us | with, us | times | least to most | frames lost / ticks compensated |\n| --- | --- | --- | --- | --- | --- | --- |\n";

/// Rounds of a session without loss and one with.
const ROUNDS: usize = 15;

/// Processor time of a guest's tick with the paper's repair, us, in each round: without loss, and
/// with 9 % lost and compensated. Also returns a session with loss: all of them are alike.
fn guest_ticks_us(model: &Arc<ModalModel>, seconds: f64) -> Result<(Vec<[f64; 2]>, Metrics), LabError> {
    let _pinned = machine::Pinned::new();
    let session = |loss| -> Result<Metrics, LabError> {
        let link = LinkConfig { loss, ..LinkConfig::preset(Preset::Paper1) };
        let mut made = Experiment::new(model.clone(), link, RecoveryConfig::paper());
        made.use_the_papers_integrator();
        made.seconds = seconds;
        made.cpu_clock = Some(machine::thread_time);
        Ok(made.run()?)
    };
    // The first sessions fill the caches.
    session(Loss::None)?;
    let lossy = session(Loss::Random(0.09))?;
    let mut rounds = Vec::with_capacity(ROUNDS);
    for _ in 0..ROUNDS {
        let [without, with] = [session(Loss::None)?, session(Loss::Random(0.09))?];
        rounds.push([without.cpu_us_per_tick, with.cpu_us_per_tick]);
    }
    Ok((rounds, lossy))
}

/// The surface of a row of the paper's table 2, none for its bar, and what the row is called. Our
/// own body stands in for a surface that is not there, and for the dragon, which others may not
/// change.
fn surface_of(name: &str, models: &Path, own: &Path) -> (Option<PathBuf>, String) {
    let surface = models.join(format!("{name}.obj"));
    match name {
        "bar" => (None, name.into()),
        _ if name != "dragon" && surface.is_file() => (Some(surface), name.into()),
        _ => (Some(own.to_path_buf()), format!("own body, for the {name}")),
    }
}

/// Table 2 beside the paper's numbers. Surfaces that may not be shipped are read from `models`, see
/// [`surface_of`].
///
/// Each timing takes `seconds`, and a body has one in `fewer` of the paper's tetrahedra.
pub(super) fn table_2(
    models: &Path,
    own: &Path,
    (seconds, fewer): (f64, usize),
    progress: &mut dyn Progress,
) -> Result<String, LabError> {
    let mut out = "| body | tetrahedra | modes | surface | bake s (in brackets the paper's) | step us, 50 % / 99 % | step and surface us, 50 % / 99 % | steps/s with surface and hand (in brackets the one column of the paper's that is quoted, see below) | ratio | the surface, of the memory's limit | half-precision basis: step and surface us, 50 % / 99 % | ratio | of the memory's limit | the bar |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n".to_owned();
    for (name, tets, modes, paper_bake, paper_rate) in PAPER {
        let (source, label) = surface_of(name, models, own);
        let (tets, model, bake) = body_of(source.as_deref(), tets / fewer, modes, progress)?;
        let measured = bench::measure(model.clone(), seconds, Precision::Single)?;
        let rate = 1e6 / measured.frame_us.p50;
        let half = bench::measure(model.clone(), seconds, Precision::Half)?;
        let halved = 1e6 / half.frame_us.p50 / paper_rate;
        let _ = writeln!(
            out,
            "| {label} | {} | {modes} | {} vertices | {bake:.2} ({paper_bake}) | {:.2} / {:.2} | {:.1} / {:.1} | {rate:.0} ({paper_rate}) | {:.1} | {:.0} % | {:.1} / {:.1} | {halved:.1} | {:.0} % | {} |",
            tets,
            measured.surface_vertices,
            measured.step_us.p50,
            measured.step_us.p99,
            measured.frame_us.p50,
            measured.frame_us.p99,
            rate / paper_rate,
            100.0 * measured.bandwidth_gb_s / measured.bandwidth_limit_gb_s,
            half.frame_us.p50,
            half.frame_us.p99,
            100.0 * half.bandwidth_gb_s / half.bandwidth_limit_gb_s,
            verdict(rate / paper_rate, halved)
        );
    }
    out.push_str(BOUND);
    out.push_str(SURFACES);
    Ok(out)
}

/// The body of a row: the number of its tetrahedra, its model, and the time of the bake, s.
fn body_of(
    source: Option<&Path>,
    tets: usize,
    modes: usize,
    progress: &mut dyn Progress,
) -> Result<(usize, Arc<ModalModel>, f64), LabError> {
    let mesh = match source {
        None => shapes::bar([20, 3, 3], [1.0, 0.15, 0.15])?,
        Some(path) => fill(path, Some(tets), progress)?.mesh,
    };
    let [low, high] = mesh.bounds();
    let held = if source.is_none() { anchor(0, 1e-9) } else { anchor(1, low[1] + 0.06 * (high[1] - low[1])) };
    progress.report("bake", 0.5);
    let (model, bake) =
        baked(&mesh, &BakeConfig { sites: None, ..config(Element::Tet4, modes, vec![held]) })?;
    Ok((mesh.tets.len(), model, bake))
}

/// Table 2 at a guest with the paper's repair: what compensation adds to a tick.
///
/// Each session has as many `seconds`, and a body has one in `fewer` of the paper's tetrahedra.
pub(super) fn table_2_repair(
    models: &Path,
    own: &Path,
    (seconds, fewer): (f64, usize),
    progress: &mut dyn Progress,
) -> Result<String, LabError> {
    let mut out = REPAIR.to_owned();
    for (name, tets, modes, ..) in PAPER {
        let (source, label) = surface_of(name, models, own);
        // The cost of a tick at a guest depends on the modes and not on the tetrahedra.
        let (_, model, _) = body_of(source.as_deref(), tets / fewer, modes, progress)?;
        let (mut rounds, lossy) = guest_ticks_us(&model, seconds)?;
        let mut ratios: Vec<f64> = rounds.iter().map(|[without, with]| with / without).collect();
        ratios.sort_by(f64::total_cmp);
        let mut median = |which: usize| {
            rounds.sort_by(|a, b| a[which].total_cmp(&b[which]));
            rounds[rounds.len() / 2][which]
        };
        let [without, with] = [median(0), median(1)];
        let _ = writeln!(
            out,
            "| {label} | {modes} | {without:.2} | {with:.2} | {:.2} | {:.2} to {:.2} | {} / {} |",
            ratios[ratios.len() / 2],
            ratios[0],
            ratios[ratios.len() - 1],
            lossy.lost,
            lossy.recovered,
        );
    }
    Ok(out)
}

/// Compares bodies at run time with the full nonlinear solution, for the bunny pulled by its ear,
/// or for the project's own body if the bunny does not exist: linear elasticity, and what a bake
/// has by default, reduced elasticity.
///
/// The linear body has four-node tetrahedra at the paper's size, then ten-node tetrahedra (the
/// default of the bake) in a smaller number, because a nonlinear solution with as many of those
/// takes too long. The reduced body has these, too.
pub(super) fn default_setting(
    models: &Path,
    own: &Path,
    [four, ten]: [usize; 2],
    progress: &mut dyn Progress,
) -> Result<String, LabError> {
    let all: &[f64] = &[0.02, 0.05, 0.1, 0.2];
    let mut out = format!(
        "Two defaults are measured here. The first two bodies have linear elasticity (`BakeConfig::linear`) and its default at run time: that is what all parts but h are about. The third is what a bake makes by default: reduced elasticity with the {} law and {} coordinates.\n\n",
        Material::default(),
        BakeConfig::COORDINATES
    );
    out.push_str(&linear(&PulledBody::new(models, own, Element::Tet4, four, progress)?, all, progress)?);
    out.push('\n');
    let pulled = PulledBody::new(models, own, Element::Tet10, ten, progress)?;
    out.push_str(&linear(&pulled, &all[1..3], progress)?);
    out.push('\n');
    out.push_str(&reduced(&pulled, &all[1..3], progress)?);
    Ok(out)
}

/// A body that is held at its foot and pulled where it gives way most.
struct PulledBody {
    name: &'static str,
    mesh: TetMesh,
    /// How it is baked with linear elasticity.
    setting: BakeConfig,
    model: Arc<ModalModel>,
    /// Where the hand pulls.
    patch: Patch,
    /// The direction of the pull, and the way of the patch under a small force there, m/N.
    direction: [f64; 3],
    give: f64,
}

impl PulledBody {
    fn new(
        models: &Path,
        own: &Path,
        element: Element,
        tets: usize,
        progress: &mut dyn Progress,
    ) -> Result<Self, LabError> {
        let bunny = models.join("bunny.obj");
        let (path, name) = if bunny.is_file() { (bunny, "bunny") } else { (own.to_path_buf(), "own body") };
        let mesh = fill(&path, Some(tets), progress)?.mesh;
        let [low, high] = mesh.bounds();
        let setting = BakeConfig {
            sites: None,
            ..config(element, 60, vec![anchor(1, low[1] + 0.06 * (high[1] - low[1]))])
        };
        progress.report("bake", 0.2);
        let (model, _) = baked(&mesh, &setting)?;
        // The hand pulls where the first mode moves most, so that the body gives way.
        let vertex = Experiment::default_hands(&model)[0].vertex;
        let patch = Patch::around(model.surface(), vertex, 0.06 * model.size())?;
        let way: [f64; 3] = std::array::from_fn(|axis| f64::from(model.displacement_row(vertex, axis, 0)));
        let length = norm(way);
        let direction = way.map(|x| x / length);
        let small = DeadLoad { patch: patch.clone(), force: direction.map(|x| 1e-9 * x) };
        let give = norm(under(&mesh, &setting, &[small])?.patches[0]) / 1e-9;
        Ok(Self { name, mesh, setting, model, patch, direction, give })
    }

    /// The load that pulls the patch by a share of the body's size, were the linear theory right.
    fn load(&self, share: f64) -> Vec<DeadLoad> {
        let force = share * self.model.size() / self.give;
        vec![DeadLoad { patch: self.patch.clone(), force: self.direction.map(|x| force * x) }]
    }
}

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Compares a body of linear elasticity with the full solution.
fn linear(pulled: &PulledBody, shares: &[f64], progress: &mut dyn Progress) -> Result<String, LabError> {
    let PulledBody { name, mesh, setting, model, .. } = pulled;
    let size = model.size();
    let mut out = format!(
        "The {name}, {} {}, 60 modes, linear elasticity with its default at run time (exact step of 1/60 s, warp, residual flexibility), is held at its foot and pulled where it is most compliant. It is compared with a St. Venant-Kirchhoff solution with the same elements, so the error of the elements is not included (figure a shows it):\n\n| pulled by, % of the size | surface error, rms / largest, % of the size | without warp, largest | force error along the pull, % (whole force) | without warp | step us |\n| --- | --- | --- | --- | --- | --- |\n",
        mesh.tets.len(),
        match setting.element {
            Element::Tet4 =>
                "four-node tetrahedra (the paper's; a choice at the bake, where ten-node ones are the default)",
            _ => "ten-node tetrahedra (the default of the bake)",
        }
    );
    let mut words = String::new();
    for &share in shares {
        progress.report("nonlinear", share / 0.2);
        let load = pulled.load(share);
        let truth = match under(mesh, setting, &load) {
            Ok(truth) => truth,
            Err(error) => {
                out.push_str(&unsolved(share, &error));
                continue;
            }
        };
        let reach = norm(truth.patches[0]) / size;
        let held = held_as(model, &load, &truth, BodyConfig::default(), false)?;
        let flat = held_as(
            model,
            &load,
            &truth,
            BodyConfig::from(StepSettings { warp: false, ..Default::default() }),
            false,
        )?;
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
                "\nIn other words: if the {name} is pulled by {:.0} % of its size, no visible point is further than {:.2} % of its size from its position in the full nonlinear solution ({:.1} mm on a {name} 20 cm \
                 large). Without the warp, this distance would be {:.1} times as large. A step takes {:.1} us (the limit is a millisecond). The force along the pull has an error of {:.0} %. A hand \
                 that also fixes the patch sideways, exactly at its position in the nonlinear solution, has a larger error (in brackets), because it presses against stiff directions.\n",
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

/// The row of a pull that has no nonlinear solution.
fn unsolved(share: f64, error: &BakeError) -> String {
    format!("| {:.0} (by the linear theory) | no nonlinear solution: {error} |  |  |  |  |\n", 100.0 * share)
}

/// Compares a body with what a bake has by default, reduced elasticity, with the full solution of
/// the same material.
fn reduced(pulled: &PulledBody, shares: &[f64], progress: &mut dyn Progress) -> Result<String, LabError> {
    let PulledBody { name, mesh, .. } = pulled;
    let material = Material::default();
    let modes = BakeConfig::COORDINATES;
    // With the flexibility of every patch, as the bake has it.
    let sites = BakeConfig::default().sites;
    let setting = BakeConfig { modes, material: Some(material), sites, ..pulled.setting.clone() };
    progress.report("bake", 0.8);
    let (model, _) = baked(mesh, &setting)?;
    let size = model.size();
    let mut out = format!(
        "The same {name} of ten-node tetrahedra as it is baked by default: reduced elasticity, {material}, {modes} coordinates, steps of 1/60 s. It has the own shapes of the patch that is held (`HeldShapes`, which `ModalBody` makes beside the frames), and stands beside without. It is compared with the full solution of the same material with the same elements:\n\n| pulled by, % of the size | surface error, rms / largest, % of the size | without own shapes, largest | force error along the pull, % (whole force) | without own shapes | step us |\n| --- | --- | --- | --- | --- | --- |\n"
    );
    let mut words = String::new();
    for &share in shares {
        progress.report("nonlinear", share / 0.2);
        let load = pulled.load(share);
        let loads = StaticLoads { forces: &load, ..StaticLoads::default() };
        let truth = match deflect(mesh, &setting, material, &loads) {
            Ok(truth) => truth,
            Err(error) => {
                out.push_str(&unsolved(share, &error));
                continue;
            }
        };
        let reach = norm(truth.patches[0]) / size;
        let held = held_as(&model, &load, &truth, BodyConfig::default(), true)?;
        let bare = held_as(&model, &load, &truth, BodyConfig::default(), false)?;
        let _ = writeln!(
            out,
            "| {:.1} | {:.3} / {:.2} | {:.2} | {:.1} ({:.1}) | {:.1} ({:.1}) | {:.1} |",
            100.0 * reach,
            100.0 * held.shape[0] / size,
            100.0 * held.shape[1] / size,
            100.0 * bare.shape[1] / size,
            100.0 * held.along,
            100.0 * held.force,
            100.0 * bare.along,
            100.0 * bare.force,
            held.step_us[0]
        );
        if share == 0.1 {
            words = format!(
                "\nIn other words: with what a bake has by default, the force along a pull by {:.0} % of the size has an error of {:.1} %, the whole force one of {:.1} %, and no visible point is further than {:.2} % of the size from its position in the full solution. Without own shapes these are {:.1}, {:.1} and {:.2} %. A step at rest takes {:.1} us.\n",
                100.0 * reach,
                100.0 * held.along,
                100.0 * held.force,
                100.0 * held.shape[1] / size,
                100.0 * bare.along,
                100.0 * bare.force,
                100.0 * bare.shape[1] / size,
                held.step_us[0],
            );
        }
    }
    out.push_str(&words);
    Ok(out)
}

#[cfg(test)]
mod tests {
    #![expect(clippy::unwrap_used, reason = "a failed test should panic")]
    use super::*;

    #[test]
    fn our_own_body_stands_in_for_a_surface_that_is_not_there() {
        let folder = std::env::temp_dir().join(format!("pliant-table-2-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        for name in ["bunny", "dragon"] {
            std::fs::write(folder.join(format!("{name}.obj")), "").unwrap();
        }
        let own = Path::new("own.ron");
        let of = |name| surface_of(name, &folder, own);
        let all = ["bar", "bunny", "armadillo", "dragon"].map(of);
        std::fs::remove_dir_all(&folder).unwrap();
        let for_own = |what: &str| (Some(own.to_path_buf()), format!("own body, for the {what}"));
        assert_eq!(all[0], (None, "bar".into()));
        assert_eq!(all[1], (Some(folder.join("bunny.obj")), "bunny".into()));
        assert_eq!(all[2..], [for_own("armadillo"), for_own("dragon")]);
    }
}
