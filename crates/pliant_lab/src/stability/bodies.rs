//! The bodies of the matrix, baked when needed, and shared measurements.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use pliant_bake::{Anchor, BakeConfig, Comparison, bake};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Body, BodyConfig, Damping, Element, GrabConfig, GrabId, Material, ModalModel, Patch, State, StepError,
};

use super::Bound;
use crate::LabError;

/// A bar along x with a corner at the origin.
#[derive(Debug, Clone)]
pub(super) struct BarBody {
    pub(super) cells: [usize; 3],
    /// Length, m.
    pub(super) length: f64,
    /// Width and height as shares of the length.
    pub(super) section: [f64; 2],
    pub(super) element: Element,
    pub(super) modes: usize,
    pub(super) young: f64,
    pub(super) poisson: f64,
    pub(super) density: f64,
    /// Fraction of critical damping.
    pub(super) zeta: f64,
    /// Share of the length from x = 0 that is held. `None`: the body is free.
    pub(super) held: Option<f64>,
    /// Sites at which flexibilities are baked. `None`: as the bake has it.
    pub(super) sites: Option<usize>,
    /// Material for large strains. The modes are then coordinates.
    pub(super) material: Option<Material>,
}

impl Default for BarBody {
    fn default() -> Self {
        Self {
            cells: [8, 2, 2],
            length: 1.0,
            section: [0.2, 0.2],
            element: Element::Tet10,
            modes: 20,
            young: 1e5,
            poisson: 0.4,
            density: 1000.0,
            zeta: 0.03,
            held: Some(1e-9),
            sites: Some(48),
            material: None,
        }
    }
}

impl BarBody {
    fn size(&self) -> [f64; 3] {
        [self.length, self.section[0] * self.length, self.section[1] * self.length]
    }

    pub(super) fn mesh(&self) -> Result<TetMesh, LabError> {
        Ok(shapes::bar(self.cells, self.size())?)
    }

    pub(super) fn bake(&self) -> Result<Arc<ModalModel>, LabError> {
        self.bake_mesh(&self.mesh()?)
    }

    pub(super) fn bake_mesh(&self, mesh: &TetMesh) -> Result<Arc<ModalModel>, LabError> {
        let anchor = |share| Anchor { axis: 0, comparison: Comparison::Less, bound: share * self.length };
        let config = BakeConfig {
            element: self.element,
            modes: self.modes,
            material: self.material,
            young: self.young,
            poisson: self.poisson,
            density: self.density,
            damping: Damping::Ratio(self.zeta),
            anchors: self.held.map(anchor).into_iter().collect(),
            sites: self.sites,
            ..BakeConfig::default()
        };
        Ok(Arc::new(bake(mesh, None, &config, &mut |_, _| ())?.model))
    }

    /// The surface vertex nearest to a position in shares of the bar's edges.
    pub(super) fn vertex(&self, model: &ModalModel, share: [f64; 3]) -> u32 {
        let size = self.size();
        nearest_vertex(model, std::array::from_fn(|k| share[k] * size[k]))
    }

    /// The patch in the middle of the free end.
    pub(super) fn tip(&self, model: &ModalModel) -> Result<Patch, LabError> {
        Ok(Patch::around(model.surface(), self.vertex(model, [1.0, 0.5, 0.5]), 0.12 * self.length)?)
    }
}

/// The surface vertex nearest to a place, m.
pub(super) fn nearest_vertex(model: &ModalModel, at: [f64; 3]) -> u32 {
    let away = |p: &[f32; 3]| (0..3).map(|k| (f64::from(p[k]) - at[k]).powi(2)).sum::<f64>();
    let positions = model.surface().positions();
    (0..positions.len() as u32)
        .min_by(|a, b| away(&positions[*a as usize]).total_cmp(&away(&positions[*b as usize])))
        .unwrap_or(0)
}

/// A held body with a hand on its tip.
pub(super) struct HeldCase {
    pub(super) model: Arc<ModalModel>,
    pub(super) body: Body,
    pub(super) patch: Patch,
    pub(super) grab: GrabId,
    pub(super) start: [f64; 3],
}

impl HeldCase {
    pub(super) fn new(bar: &BarBody, config: BodyConfig, hand: GrabConfig) -> Result<Self, LabError> {
        let model = bar.bake()?;
        let patch = bar.tip(&model)?;
        Self::of(model, patch, config, hand)
    }

    pub(super) fn of(
        model: Arc<ModalModel>,
        patch: Patch,
        config: BodyConfig,
        hand: GrabConfig,
    ) -> Result<Self, LabError> {
        let mut body = Body::new(model.clone(), config)?;
        let grab = body.grab(&patch, hand)?;
        let start = body.grab_position(grab)?;
        Ok(Self { model, body, patch, grab, start })
    }

    /// Moves the target to `away` (m) from the start of the grab.
    pub(super) fn pull(&mut self, away: [f64; 3]) -> Result<(), StepError> {
        self.body.set_target(self.grab, std::array::from_fn(|k| self.start[k] + away[k]))
    }

    pub(super) fn reaction(&self) -> Result<Vector3<f64>, StepError> {
        Ok(self.body.reaction(self.grab)?.into())
    }
}

/// Number of steps after which the slowest mode of a body has decayed to about a
/// hundred-thousandth.
pub(super) fn settling(model: &ModalModel, step: f64) -> usize {
    let rate = model.omega().iter().zip(model.damping()).map(|(omega, c)| {
        let half = 0.5 * c;
        // An overdamped mode decays with the slower of its two roots.
        if half > *omega { omega * omega / (half + (half * half - omega * omega).sqrt()) } else { half }
    });
    let slowest = rate.fold(f64::INFINITY, f64::min);
    ((12.0 / (slowest * step)) as usize).clamp(200, 3_000_000)
}

/// `W^T Phi Lambda^-1 Phi^T W` of the kept modes, m/N: the static compliance of a patch without
/// residual flexibility.
pub(super) fn modal_compliance(model: &ModalModel, patch: &Patch) -> Matrix3<f64> {
    let mut sum = Matrix3::zeros();
    for mode in 0..model.mode_count() {
        let phi = patch.entries().iter().fold(Vector3::zeros(), |phi: Vector3<f64>, &(vertex, weight)| {
            phi + weight * Vector3::from_fn(|axis, _| f64::from(model.displacement_row(vertex, axis, mode)))
        });
        sum += phi * phi.transpose() / model.omega()[mode].powi(2);
    }
    sum
}

/// The immediate compliance at a hand, m/N.
pub(super) fn compliance(body: &Body, grab: GrabId) -> Result<Matrix3<f64>, StepError> {
    let c = body.compliance(grab)?;
    Ok(Matrix3::from_fn(|i, j| c[i][j]))
}

/// The force (N) that holds a patch `away` (m) from its rest: the static limit of a small
/// displacement.
pub(super) fn static_pull(held: &HeldCase, away: [f64; 3]) -> Result<Vector3<f64>, StepError> {
    let whole = compliance(&held.body, held.grab)? + modal_compliance(&held.model, &held.patch);
    Ok(whole.try_inverse().map_or_else(|| Vector3::repeat(f64::NAN), |inverse| inverse * Vector3::from(away)))
}

/// max |second difference of F| / max |F|: 4 for a force that flips its sign each step.
pub(super) fn ringing(forces: &[Vector3<f64>]) -> f64 {
    let largest = forces.iter().fold(0.0f64, |m, f| m.max(f.norm()));
    let second = forces.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).norm()).fold(0.0, f64::max);
    if largest > 0.0 { second / largest } else { 0.0 }
}

/// The largest growth of the energy in a step and the energy at the end, both as shares of the
/// energy at the start.
pub(super) fn energy_growth(body: &mut Body, steps: usize) -> Result<[f64; 2], StepError> {
    let start = body.energy().max(f64::MIN_POSITIVE);
    let (mut last, mut growth) = (start, 0.0f64);
    for _ in 0..steps {
        body.step()?;
        let now = body.energy();
        growth = growth.max((now - last) / start);
        last = now;
    }
    Ok([growth, last / start])
}

/// What rounding may add in a step, as a share: a hundred times the spacing of numbers near 1.
pub(super) const ROUNDING: f64 = 100.0 * f64::EPSILON;

/// Energy that may be left after [`settling`], as a share: the amplitude of the slowest mode has
/// then decayed by `e^-12`, and its energy by `e^-24`, 4e-11.
pub(super) const RESTED: f64 = 1e-10;

/// Force that may still come and go after [`settling`], as a share: `e^-12` is 6e-6.
pub(super) const STILL: f64 = 1e-5;

/// The bound on [`energy_growth`], which leaves room for rounding only. Generalized-alpha conserves
/// another norm, which equals the energy within a factor.
pub(super) fn no_growth(growth: f64) -> Bound {
    Bound::new("largest growth of the energy in a step / energy", growth, ROUNDING)
}

/// The bound on a largest energy as a multiple of the first one, which leaves room for rounding
/// only.
pub(super) fn gain(what: &'static str, multiple: f64) -> Bound {
    // A number that is not finite stays so.
    Bound::new(what, if multiple.is_finite() { (multiple - 1.0).max(0.0) } else { multiple }, ROUNDING)
}

/// The largest of some numbers, or no number if one of them is none.
pub(super) fn largest(numbers: impl Iterator<Item = f64>) -> f64 {
    numbers.fold(f64::NEG_INFINITY, |a, b| if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) })
}

/// A state from coordinates and velocities, with the matching accelerations.
pub(super) fn state(body: &Body, q: Vec<f64>, v: Vec<f64>) -> State {
    let mut state = body.state().clone();
    let model = body.model();
    let damping = body.config().settings.damping_scale;
    state.a = (0..q.len())
        .map(|i| -model.damping()[i] * damping * v[i] - model.omega()[i].powi(2) * q[i])
        .collect();
    (state.q, state.v) = (q, v);
    state
}

/// The modal coordinates whose linear displacement of the surface comes closest to a field (least
/// squares).
pub(super) fn nearest(model: &ModalModel, field: impl Fn([f64; 3]) -> [f64; 3]) -> Vec<f64> {
    let positions = model.surface().positions();
    let modes = model.mode_count();
    let rows = DMatrix::from_fn(3 * positions.len(), modes, |row, mode| {
        f64::from(model.displacement_row((row / 3) as u32, row % 3, mode))
    });
    let wanted =
        DVector::from_fn(3 * positions.len(), |row, _| field(positions[row / 3].map(f64::from))[row % 3]);
    let normal = rows.transpose() * &rows;
    let right = rows.transpose() * wanted;
    normal.lu().solve(&right).map_or_else(|| vec![0.0; modes], |q| q.iter().copied().collect())
}

/// SplitMix64 as random numbers from -1 to 1.
pub(super) struct Dice(pub(super) u64);

impl Dice {
    pub(super) fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^= z >> 31;
        (z >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}
