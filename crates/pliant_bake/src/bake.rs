//! The complete bake, from tetrahedra to a model.

use pliant_mesh::{Surface, TetMesh};
use pliant_modal::tetrahedron::Affine;
use pliant_modal::{BakeInfo, ModalModel, ModelParts, ReducedElasticity, SimulationMesh};
use web_time::Instant;

use crate::blocks::{self, Tall};
use crate::continuum::Continuum;
use crate::cubature::{self, Training};
use crate::fem::{ANCHORED, FeMesh, LOCKING_POISSON, Law, Lists};
use crate::lanczos::{self, Eigenpairs, Failure};
use crate::ordering;
use crate::rigid::MassProperties;
use crate::solver::Solver;
use crate::sparse::BlockCsr;
use crate::surface::Skin;
use crate::symbolic::{self, Symbolic};
use crate::{
    Bake, BakeConfig, BakeError, BakeTimes, Stage, canonical, derivatives, flexibility, matrix_market,
    region, support,
};

/// Largest `|K phi - lambda M phi| / |K phi|` that a bake accepts.
const RESIDUAL_LIMIT: f64 = 1e-7;

/// Largest entry of `|Phi^T M Phi - I|` that a bake accepts.
const ORTHONORMALITY_LIMIT: f64 = 1e-9;

/// Number of patches that are pulled to train the cubature of a material.
const TRAINING_PATCHES: usize = 8;

/// Bakes a mesh into a modal model.
///
/// The model contains the lowest elastic modes of `K phi = omega^2 M phi` and the data that a body
/// needs at its surface.
///
/// The visible surface is `skin` if there is one. It is embedded in the tetrahedra, and the modes
/// are interpolated to its vertices. Otherwise the visible surface is the boundary of the
/// tetrahedra. A body without anchors is free: its six rigid modes are known and left out.
/// `progress` receives the stage and its completed fraction, 0 to 1.
///
/// The same input gives the same model to the bit, for any number of threads. Every bake checks
/// `|K phi - lambda M phi| / |K phi|` and `|Phi^T M Phi - I|` and stores the largest value of each.
///
/// # Errors
/// Returns [`BakeError`] for a number out of its range, for an invalid mesh or skin, for anchors
/// that contain nothing, everything or too few nodes, for more modes than degrees of freedom, and
/// for files that cannot be written.
pub fn bake(
    mesh: &TetMesh,
    skin: Option<&Surface>,
    config: &BakeConfig,
    progress: &mut dyn FnMut(Stage, f64),
) -> Result<Bake, BakeError> {
    config.check()?;
    if let Some(folder) = &config.export_matrices {
        matrix_market::check_folder(folder)?;
    }
    mesh.check().map_err(BakeError::Mesh)?;
    let mut mesh = mesh.clone();
    mesh.drop_unused_nodes();
    let mut clock = StageClock::start();
    let mut times = BakeTimes::default();

    progress(Stage::Assemble, 0.0);
    let mut fe = FeMesh::new(&mesh, config.element);
    region::vary(&mut fe, config)?;
    let held = support::anchored_nodes(&fe, config)?;
    let free_body = config.is_free();
    check_mode_count(config.modes, &held, free_body)?;
    let law = law(config);
    let graph = fe.graph(law.average_pressure);
    support::check_connected(&fe, &graph, &held, config)?;
    let (number, ordered) = elimination_order(&fe, &graph, &held);
    progress(Stage::Assemble, 0.3);
    let matrix = fe.assemble(&law, &number, &ordered);
    let properties = MassProperties::new(&fe, config.density);
    times.assemble = clock.lap();

    progress(Stage::Factor, 0.0);
    let position = by_row(&fe, &number);
    let rigid = free_body.then(|| properties.rigid_modes(position.iter().copied()));
    let symbolic = Symbolic::new(&ordered);
    drop(ordered);
    let solver = Solver::new(&matrix, symbolic, rigid)
        .map_err(|failed| BakeError::NotPositive { at: position[failed.node] })?;
    times.factor = clock.lap();

    progress(Stage::Modes, 0.0);
    let pure = if config.material.is_some() { derivatives::pure_modes(config.modes) } else { config.modes };
    let mut modes =
        lanczos::lowest(&solver, pure, &mut |share| progress(Stage::Modes, share)).map_err(no_modes)?;
    canonical::canonicalize(&mut modes, &matrix, &number);
    let (residual_max, mut orthonormality_max) = accuracy(&matrix, &modes);
    check_accuracy("|K phi - lambda M phi| / |K phi|", residual_max, RESIDUAL_LIMIT)?;
    check_accuracy("|Phi^T M Phi - I|", orthonormality_max, ORTHONORMALITY_LIMIT)?;
    times.modes = clock.lap();

    let skin = Skin::new(&mesh, &fe, skin, &number)?;
    let size = skin.mesh.size();
    let mut reduced = None;
    if let Some(material) = config.material {
        progress(Stage::Material, 0.0);
        let law = material.with(law.lambda, law.mu);
        let continuum = Continuum { fe: &fe, law, number: &number };
        modes =
            derivatives::extend(&continuum, &solver, &modes, config.modes).ok_or(BakeError::NoConvergence)?;
        // Only the pure modes solve the eigenproblem, but all coordinates are orthonormal.
        orthonormality_max = accuracy(&matrix, &modes).1;
        check_accuracy("|Phi^T M Phi - I|", orthonormality_max, ORTHONORMALITY_LIMIT)?;
        progress(Stage::Material, 0.3);
        let patches = flexibility::spread_patches(&skin, &number, &modes, TRAINING_PATCHES, 0.1 * size)?;
        let (coordinates, young) = (&modes, config.young);
        let training = Training { continuum, coordinates, material, young, patches: &patches, size };
        let mut report = |share| progress(Stage::Material, 0.3 + 0.7 * share);
        let mesh = simulation_mesh(&mesh, &fe, &modes, &number, &skin);
        reduced = Some(ReducedElasticity { mesh, ..cubature::train(&training, &mut report)? });
        times.material = clock.lap();
    }
    progress(Stage::Surface, 0.0);
    let radii: Vec<f64> = config.site_radii.iter().map(|share| share * size).collect();
    let sites = flexibility::sites(&solver, &modes, &skin, &number, config.sites, &radii, &mut |share| {
        progress(Stage::Surface, 0.8 * share);
    })?;
    let count = modes.lambda.len();
    let omega: Vec<f64> = modes.lambda.iter().map(|lambda| lambda.sqrt()).collect();
    let parts = ModelParts {
        info: BakeInfo {
            name: config.name.clone(),
            tets: mesh.tets.len(),
            nodes: fe.nodes.len(),
            element: config.element,
            young: config.young,
            poisson: config.poisson,
            density: config.density,
            damping: config.damping,
            anchors: support::names(config),
            residual_max,
            orthonormality_max,
        },
        displacement: skin.displacements(&modes.phi, count, &number),
        rotation: skin.rotations(&fe, &modes.phi, count, &number),
        damping: omega.iter().map(|&omega| config.damping.coefficient(omega)).collect(),
        omega,
        participation: participation(&fe, &modes, &number, config.density, free_body),
        free: free_body,
        mass: properties.mass,
        center_of_mass: properties.center,
        inertia: properties.inertia,
        sites,
        reduced,
        surface: skin.mesh,
    };
    let model = ModalModel::from_parts(parts)?;
    // The matrices are written last, so that a failed bake leaves no files.
    if let Some(folder) = &config.export_matrices {
        matrix_market::export(folder, &matrix, &number)?;
    }
    times.surface = clock.lap();
    times.total = times.assemble + times.factor + times.modes + times.material + times.surface;
    progress(Stage::Surface, 1.0);
    Ok(Bake { model, times })
}

/// Returns the mesh from which hands get the own shapes of the patches that they hold.
///
/// Returns `None` for a mesh of too many elements, whose model would be too large, and for one with
/// an element that is flat in single precision.
fn simulation_mesh(
    mesh: &TetMesh,
    fe: &FeMesh,
    modes: &Eigenpairs,
    number: &[u32],
    skin: &Skin,
) -> Option<SimulationMesh> {
    let displacements = 3 * fe.nodes.len() * modes.lambda.len();
    if mesh.tets.len() > SimulationMesh::MAX_TETS || displacements > SimulationMesh::MAX_DISPLACEMENTS {
        return None;
    }
    let corners: Vec<[f32; 3]> = mesh.nodes.iter().map(|p| p.map(|x| x as f32)).collect();
    let corner = |c: u32| corners[c as usize].map(f64::from);
    if mesh.tets.iter().any(|tet| Affine::new(tet.map(corner)).volume <= 0.0) {
        return None;
    }
    let count = modes.lambda.len();
    let anchored = vec![0.0; 3 * count];
    let values: Vec<f64> = number[..fe.nodes.len()]
        .iter()
        .flat_map(|&row| match row {
            ANCHORED => &anchored[..],
            row => &modes.phi[3 * row as usize * count..][..3 * count],
        })
        .copied()
        .collect();
    let (scales, displacements) = SimulationMesh::quantized(&values, count);
    let vertices = skin.places.clone();
    let varied = fe.stiffness.iter().any(|&factor| factor != 1.0);
    let stiffness = if varied { fe.stiffness.iter().map(|&x| x as f32).collect() } else { Vec::new() };
    Some(SimulationMesh { corners, tets: mesh.tets.clone(), scales, displacements, vertices, stiffness })
}

fn no_modes(failure: Failure) -> BakeError {
    let hertz = |lambda: f64| lambda.sqrt() / std::f64::consts::TAU;
    match failure {
        Failure::NoConvergence => BakeError::NoConvergence,
        Failure::Missed { lambda, modes, found } => {
            BakeError::MissedModes { modes, found, hertz: hertz(lambda) }
        }
        Failure::Uncounted { lambda } => BakeError::UncountedModes { hertz: hertz(lambda) },
    }
}

struct StageClock(Instant);

impl StageClock {
    fn start() -> Self {
        Self(Instant::now())
    }

    /// Returns the seconds since the last lap.
    fn lap(&mut self) -> f64 {
        let now = Instant::now();
        let seconds = (now - self.0).as_secs_f64();
        self.0 = now;
        seconds
    }
}

/// Lame constants of the material: `lambda = E nu / ((1 + nu)(1 - 2 nu))`, `mu = E / (2 (1 + nu))`.
pub(crate) fn law(config: &BakeConfig) -> Law {
    let (e, nu) = (config.young, config.poisson);
    Law {
        lambda: e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)),
        mu: e / (2.0 * (1.0 + nu)),
        density: config.density,
        average_pressure: nu > LOCKING_POISSON,
    }
}

fn check_mode_count(modes: usize, held: &[bool], free_body: bool) -> Result<(), BakeError> {
    let dofs = 3 * held.iter().filter(|held| !**held).count();
    let rigid = if free_body { 6 } else { 0 };
    let most = dofs.saturating_sub(rigid);
    if modes > most { Err(BakeError::Modes { got: modes, most, dofs, rigid }) } else { Ok(()) }
}

/// Returns the row of each node in elimination order and the graph in that order. The row of an
/// anchored node is `ANCHORED`.
pub(crate) fn elimination_order(fe: &FeMesh, graph: &Lists, held: &[bool]) -> (Vec<u32>, Lists) {
    let keep: Vec<bool> = held.iter().map(|held| !held).collect();
    let dissected = ordering::nested_dissection(graph, &fe.nodes, &keep);
    let mut number = vec![ANCHORED; fe.nodes.len()];
    for (row, &node) in dissected.iter().enumerate() {
        number[node as usize] = row as u32;
    }
    let post = symbolic::postorder(&graph.renumber(&number, dissected.len()));
    for (row, &before) in post.iter().enumerate() {
        number[dissected[before as usize] as usize] = row as u32;
    }
    let ordered = graph.renumber(&number, dissected.len());
    (number, ordered)
}

/// Returns the positions of the free nodes in the row order of the matrix.
fn by_row(fe: &FeMesh, number: &[u32]) -> Vec<[f64; 3]> {
    let free = number.iter().filter(|&&row| row != ANCHORED).count();
    let mut out = vec![[0.0; 3]; free];
    for (&row, &p) in number.iter().zip(&fe.nodes) {
        if row != ANCHORED {
            out[row as usize] = p;
        }
    }
    out
}

/// Returns the largest `|K phi - lambda M phi| / |K phi|` and the largest entry of
/// `|Phi^T M Phi - I|`.
pub(crate) fn accuracy(matrix: &BlockCsr, modes: &Eigenpairs) -> (f64, f64) {
    let count = modes.lambda.len();
    let mut k = vec![0.0; modes.phi.len()];
    let mut m = vec![0.0; modes.phi.len()];
    matrix.stiffness_times(&modes.phi, count, &mut k);
    matrix.mass_times(&modes.phi, count, &mut m);
    let (mut residual, mut scale) = (vec![0.0; count], vec![0.0; count]);
    for (k, m) in k.chunks_exact(count).zip(m.chunks_exact(count)) {
        for j in 0..count {
            residual[j] += (k[j] - modes.lambda[j] * m[j]).powi(2);
            scale[j] += k[j] * k[j];
        }
    }
    let worst = residual.iter().zip(&scale).map(|(r, s)| (r / s).sqrt()).fold(0.0, largest);
    let gram = blocks::gram(Tall::new(&modes.phi, count), Tall::new(&m, count));
    let mut off = 0.0;
    for i in 0..count {
        for j in 0..count {
            off = largest(off, (gram[(i, j)] - f64::from(u8::from(i == j))).abs());
        }
    }
    (worst, off)
}

/// Returns the larger number. A NaN stays NaN, so that the accuracy check rejects it.
fn largest(a: f64, b: f64) -> f64 {
    if a.is_nan() || a > b { a } else { b }
}

fn check_accuracy(what: &'static str, got: f64, expected: f64) -> Result<(), BakeError> {
    if got <= expected { Ok(()) } else { Err(BakeError::Inaccurate { what, got, expected }) }
}

/// Returns the participation `Phi^T M 1_axis` of each mode, kg^1/2.
///
/// The participation says how a uniform acceleration drives the mode. It is zero for a free body,
/// because its elastic modes are M-orthogonal to translations.
fn participation(
    fe: &FeMesh,
    modes: &Eigenpairs,
    number: &[u32],
    density: f64,
    free_body: bool,
) -> Vec<[f64; 3]> {
    let count = modes.lambda.len();
    let mut out = vec![[0.0; 3]; count];
    if free_body {
        return out;
    }
    for (&row, mass) in number.iter().zip(fe.nodal_mass(density)) {
        if row == ANCHORED {
            continue;
        }
        let phi = &modes.phi[3 * row as usize * count..][..3 * count];
        for axis in 0..3 {
            for (out, phi) in out.iter_mut().zip(&phi[axis * count..]) {
                out[axis] += mass * phi;
            }
        }
    }
    out
}
