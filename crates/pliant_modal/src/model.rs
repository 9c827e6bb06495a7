//! The baked model: the data of a body that do not depend on its pose and motion.

use std::sync::{Arc, OnceLock};

use serde::{Deserialize, Serialize};

use crate::contact::ContactSites;
use crate::moments::Moments;
use crate::step::{MassSites, SharedModes};
use crate::{
    Basis, Hyperelastic, Material, ModelError, Precision, ReducedElasticity, StepError, SurfaceMesh,
    check::check_parts, nonlinear::Gradients,
};

/// The finite element of a bake.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Element {
    /// 4-node (linear) tetrahedra, as in Tang et al. 2013. They are 20-40 % too stiff in bending on
    /// coarse meshes.
    Tet4,
    /// 10-node (quadratic) tetrahedra, the default.
    Tet10,
}

impl Element {
    /// Number of nodes of one element, 4 or 10.
    pub const fn node_count(self) -> usize {
        match self {
            Self::Tet4 => 4,
            Self::Tet10 => 10,
        }
    }
}

impl std::fmt::Display for Element {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Tet4 => "tet4",
            Self::Tet10 => "tet10",
        })
    }
}

/// Damping law of the modes. Mode `i` has the damping coefficient `c_i` of
/// `q'' + c q' + omega^2 q = f`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Damping {
    /// `c = alpha + beta omega^2` (`C = alpha M + beta K`).
    Rayleigh {
        /// Mass-proportional part, 1/s.
        alpha: f64,
        /// Stiffness-proportional part, s.
        beta: f64,
    },
    /// `c = 2 zeta omega`: the same fraction of critical damping in every mode. The field is
    /// `zeta`.
    Ratio(f64),
}

impl Damping {
    /// Damping coefficient `c_i`, 1/s, of a mode with angular frequency `omega` (rad/s).
    pub fn coefficient(self, omega: f64) -> f64 {
        match self {
            Self::Rayleigh { alpha, beta } => alpha + beta * omega * omega,
            Self::Ratio(zeta) => 2.0 * zeta * omega,
        }
    }
}

/// Origin of a model and quality of its bake.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BakeInfo {
    /// Name for display: the file from which the model was made.
    pub name: String,
    /// Number of tetrahedra of the simulation mesh.
    pub tets: usize,
    /// Number of nodes of the simulation mesh, including mid-edge nodes.
    pub nodes: usize,
    /// Finite element of the bake.
    pub element: Element,
    /// Young's modulus, Pa.
    pub young: f64,
    /// Poisson ratio, -1 < nu < 0.5.
    pub poisson: f64,
    /// Density, kg/m^3.
    pub density: f64,
    /// Damping law.
    pub damping: Damping,
    /// The anchors as given by the user (`x<0.01`). Empty for a free body.
    pub anchors: Vec<String>,
    /// Largest `|K phi - lambda M phi| / |K phi|` over the modes.
    pub residual_max: f64,
    /// Largest entry of `|Phi^T M Phi - I|`.
    pub orthonormality_max: f64,
}

/// The residual flexibility of one patch: the part of its static compliance that the kept modes
/// leave out.
///
/// It is `W^T (K^-1 - Phi Lambda^-1 Phi^T) W` (m/N, body axes), symmetric and positive
/// semi-definite.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FlexibilitySite {
    /// Surface vertex at the center of the patch.
    pub vertex: u32,
    /// Patch radius, m.
    pub radius: f64,
    /// Residual flexibility, 3x3, m/N.
    pub flexibility: [[f64; 3]; 3],
}

/// Content hash of a model: the BLAKE3 hash of its `.modal` payload.
///
/// Two machines with the same hash have the same body, bit for bit.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ModelHash(pub [u8; 32]);

impl std::fmt::Display for ModelHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl std::fmt::Debug for ModelHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ModelHash({self})")
    }
}

/// All output of a bake. The model has `m` modes and `n` surface vertices.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelParts {
    /// Origin of the model and quality of its bake.
    pub info: BakeInfo,
    /// The visible surface at rest.
    pub surface: SurfaceMesh,
    /// Angular frequencies of the elastic modes, rad/s, positive and ascending, with `m` entries.
    pub omega: Vec<f64>,
    /// Damping coefficients `c_i`, 1/s, not negative, with `m` entries.
    pub damping: Vec<f64>,
    /// Mass-normalized mode shapes at the surface, `[mode][vertex][axis]`, kg^-1/2, with `3 n m`
    /// entries.
    pub displacement: Vec<f32>,
    /// Half the curl of each mode at the surface, `[mode][vertex][axis]`, kg^-1/2 m^-1, with
    /// `3 n m` entries.
    pub rotation: Vec<f32>,
    /// `Phi^T M 1_axis`, kg^1/2: how a uniform acceleration (gravity) drives each mode. It has `m`
    /// entries, which are zero for the elastic modes of a free body.
    pub participation: Vec<[f64; 3]>,
    /// Whether the body has no anchors. A free body also has the six rigid modes, which a
    /// [`Frame`](crate::Frame) carries.
    pub free: bool,
    /// Total mass, kg.
    pub mass: f64,
    /// Center of mass at rest, m.
    pub center_of_mass: [f64; 3],
    /// Inertia about the center of mass at rest, kg m^2, symmetric.
    pub inertia: [[f64; 3]; 3],
    /// Residual flexibility of patches that are spread over the surface. It may be empty. A grab
    /// then uses a contact estimate.
    pub sites: Vec<FlexibilitySite>,
    /// Elastic energy for large strains. `None` for a model that has linear elasticity only.
    pub reduced: Option<ReducedElasticity>,
}

/// A baked, immutable body. Bodies of the same shape and material share it as `Arc<ModalModel>`.
#[derive(Debug, Clone)]
pub struct ModalModel {
    parts: ModelParts,
    basis: Basis,
    /// The basis in half precision, made at the first request.
    half: OnceLock<Basis>,
    /// The mass sites for gravity on a bent body, made at the first request.
    mass_sites: OnceLock<Arc<MassSites>>,
    /// The coefficients of the steps of its bodies.
    shared_modes: SharedModes,
    /// The first moments of the modes, made at the first request.
    moments: OnceLock<Arc<Moments>>,
    /// The contact sites for all modes, made at the first request.
    contact_sites: OnceLock<Arc<ContactSites>>,
    /// The gradients of the reduced elasticity in the layout of a step, made at the first request.
    gradients: OnceLock<Arc<Gradients>>,
    size: f64,
    hash: ModelHash,
    bytes: usize,
    /// Radii of the sites, ascending and without duplicates.
    site_radii: Vec<f64>,
}

impl PartialEq for ModalModel {
    /// Compares the parts only. Whether the half-precision basis has been made makes no difference.
    fn eq(&self, other: &Self) -> bool {
        self.parts == other.parts
    }
}

impl ModalModel {
    /// Maximum number of modes of a model.
    pub const MAX_MODES: usize = 4096;

    /// Maximum length of the name and of each anchor text, bytes.
    pub const MAX_TEXT: usize = 256;

    /// Maximum number of anchors that a model keeps.
    pub const MAX_ANCHORS: usize = 64;

    /// Checks the parts and builds the run-time layout.
    ///
    /// # Errors
    /// Returns an error if a length does not match the counts, if a number is not finite or out of
    /// range, or if a vertex index is not on the surface.
    pub fn from_parts(parts: ModelParts) -> Result<Self, ModelError> {
        check_parts(&parts)?;
        let bytes = crate::file::encode(&parts);
        Ok(Self::assemble(parts, &bytes))
    }

    pub(crate) fn from_checked_bytes(parts: ModelParts, bytes: &[u8]) -> Result<Self, ModelError> {
        check_parts(&parts)?;
        Ok(Self::assemble(parts, bytes))
    }

    fn assemble(parts: ModelParts, bytes: &[u8]) -> Self {
        let basis =
            Basis::new(parts.surface.positions(), parts.omega.len(), &parts.displacement, &parts.rotation);
        let size = parts.surface.size();
        let hash = crate::file::stored_hash(bytes);
        let mut site_radii: Vec<f64> = parts.sites.iter().map(|site| site.radius).collect();
        site_radii.sort_by(f64::total_cmp);
        site_radii.dedup();
        Self {
            parts,
            basis,
            half: OnceLock::new(),
            mass_sites: OnceLock::new(),
            shared_modes: SharedModes::default(),
            moments: OnceLock::new(),
            contact_sites: OnceLock::new(),
            gradients: OnceLock::new(),
            size,
            hash,
            bytes: bytes.len(),
            site_radii,
        }
    }

    pub(crate) fn mass_sites(&self) -> &MassSites {
        self.mass_sites.get_or_init(|| Arc::new(MassSites::new(self)))
    }

    pub(crate) fn shared_modes(&self) -> &SharedModes {
        &self.shared_modes
    }

    pub(crate) fn contact_sites(&self) -> Result<Arc<ContactSites>, StepError> {
        if let Some(sites) = self.contact_sites.get() {
            return Ok(sites.clone());
        }
        let made = Arc::new(ContactSites::new(self, self.mode_count())?);
        Ok(self.contact_sites.get_or_init(|| made).clone())
    }

    pub(crate) fn cubature_gradients(&self) -> Arc<Gradients> {
        let make = || {
            let gradients = self.parts.reduced.as_ref().map_or(&[][..], |reduced| &reduced.gradients);
            Arc::new(Gradients::new(gradients, self.omega()))
        };
        self.gradients.get_or_init(make).clone()
    }

    pub(crate) fn site_radii(&self) -> &[f64] {
        &self.site_radii
    }

    /// The parts from which the model was made.
    pub fn parts(&self) -> &ModelParts {
        &self.parts
    }

    /// Number of elastic modes.
    pub fn mode_count(&self) -> usize {
        self.parts.omega.len()
    }

    /// Angular frequencies of the elastic modes, rad/s, ascending.
    pub fn omega(&self) -> &[f64] {
        &self.parts.omega
    }

    /// Damping coefficients `c_i` of `q'' + c q' + omega^2 q = f`, 1/s.
    pub fn damping(&self) -> &[f64] {
        &self.parts.damping
    }

    /// Number of rigid modes: 6 for a free body, 0 for an anchored body.
    pub fn rigid_modes(&self) -> usize {
        if self.parts.free { 6 } else { 0 }
    }

    /// Material of the reduced elasticity. `None` for a model that has linear elasticity only.
    pub fn material(&self) -> Option<Material> {
        self.parts.reduced.as_ref().map(|reduced| reduced.material)
    }

    /// A law with `scale` times the baked stiffness.
    pub(crate) fn law(&self, material: Material, scale: f64) -> Hyperelastic {
        let info = self.info();
        let (young, nu) = (scale * info.young, info.poisson);
        material.with(young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), young / (2.0 * (1.0 + nu)))
    }

    /// Whether the body has no anchors.
    pub fn is_free(&self) -> bool {
        self.parts.free
    }

    /// Total mass, kg.
    pub fn mass(&self) -> f64 {
        self.parts.mass
    }

    /// Center of mass at rest, m, body axes.
    pub fn center_of_mass(&self) -> [f64; 3] {
        self.parts.center_of_mass
    }

    /// Inertia about the center of mass at rest, kg m^2, body axes.
    pub fn inertia(&self) -> [[f64; 3]; 3] {
        self.parts.inertia
    }

    /// Angular frequency (rad/s) and damping coefficient (1/s) of a mode if the material were
    /// `scale` times as stiff.
    ///
    /// The values are those of a bake with `scale` times the Young's modulus: `K` is proportional
    /// to it and `M` does not depend on it. The shapes stay, the frequency is `omega sqrt(scale)`,
    /// and the damping follows the same law at that frequency. At a scale of 1 both values are the
    /// baked values to the bit.
    pub fn stiffened(&self, mode: usize, scale: f64) -> (f64, f64) {
        let (Some(&omega), Some(&c)) = (self.omega().get(mode), self.damping().get(mode)) else {
            return (0.0, 0.0);
        };
        if scale == 1.0 {
            return (omega, c);
        }
        let stiff = omega * scale.sqrt();
        let law = self.parts.info.damping;
        // The coefficients of a model may differ from its damping law. Their ratio to the law
        // stays.
        let before = law.coefficient(omega);
        let c = if before > 0.0 { c * (law.coefficient(stiff) / before) } else { c };
        (stiff, c)
    }

    /// Participation of each mode in a uniform acceleration, kg^1/2.
    pub fn participation(&self) -> &[[f64; 3]] {
        &self.parts.participation
    }

    /// First moment `integral of rho phi_a r_b` of a mode of an anchored body, kg^1/2 m, body axes,
    /// with `r` from the model's origin: how a turning of the anchors drives the mode. Zero for a
    /// mode that the model does not have.
    ///
    /// The moments are fitted to the modes at the surface, at the first request.
    pub fn moment(&self, mode: usize) -> [[f64; 3]; 3] {
        let moment = self.moments().first.get(mode);
        std::array::from_fn(|a| std::array::from_fn(|b| moment.map_or(0.0, |moment| moment[(a, b)])))
    }

    pub(crate) fn moments(&self) -> &Moments {
        self.moments.get_or_init(|| Arc::new(Moments::new(self)))
    }

    /// The visible surface at rest.
    pub fn surface(&self) -> &SurfaceMesh {
        &self.parts.surface
    }

    /// The modes at the surface in the layout for reconstruction.
    pub fn basis(&self) -> &Basis {
        &self.basis
    }

    /// The basis in the given precision.
    ///
    /// The half-precision basis is made at the first request and then kept, which takes half as
    /// much memory again.
    pub fn basis_in(&self, precision: Precision) -> &Basis {
        match precision {
            Precision::Single => &self.basis,
            Precision::Half => self.half.get_or_init(|| self.basis.to_half()),
        }
    }

    /// Largest extent of the bounds of the rest shape, m. It is the reference length for errors.
    pub fn size(&self) -> f64 {
        self.size
    }

    /// Content hash of the model.
    pub fn hash(&self) -> ModelHash {
        self.hash
    }

    /// Size of the model as a `.modal` file, bytes.
    pub fn file_bytes(&self) -> usize {
        self.bytes
    }

    /// Origin of the model and quality of its bake.
    pub fn info(&self) -> &BakeInfo {
        &self.parts.info
    }

    /// Mode shape `mode` at `vertex` along `axis`, kg^-1/2. Zero for indices outside the model.
    pub fn displacement_row(&self, vertex: u32, axis: usize, mode: usize) -> f32 {
        self.parts.displacement.get(self.row(vertex, axis, mode)).copied().unwrap_or(0.0)
    }

    /// Half the curl of mode `mode` at `vertex` about `axis`, kg^-1/2 m^-1. Zero for indices
    /// outside the model.
    pub fn rotation_row(&self, vertex: u32, axis: usize, mode: usize) -> f32 {
        self.parts.rotation.get(self.row(vertex, axis, mode)).copied().unwrap_or(0.0)
    }

    /// Position of one surface vertex at modal coordinates `q`, m, body axes, bent by modal warping
    /// if `warps`. It is one row of [`Basis::reconstruct`]. `None` for a vertex that is not on the
    /// surface.
    pub fn vertex_position(&self, vertex: u32, q: &[f64], warps: bool) -> Option<[f64; 3]> {
        let rest = self.surface().positions().get(vertex as usize)?;
        let sum = |row: fn(&Self, u32, usize, usize) -> f32| -> [f64; 3] {
            std::array::from_fn(|axis| {
                q.iter().enumerate().map(|(mode, q)| q * f64::from(row(self, vertex, axis, mode))).sum()
            })
        };
        let straight = sum(Self::displacement_row);
        let moved = if warps { crate::warp(sum(Self::rotation_row), straight) } else { straight };
        Some(std::array::from_fn(|axis| f64::from(rest[axis]) + moved[axis]))
    }

    fn row(&self, vertex: u32, axis: usize, mode: usize) -> usize {
        let count = self.parts.surface.positions().len();
        if axis > 2 || vertex as usize >= count || mode >= self.mode_count() {
            return usize::MAX;
        }
        (mode * count + vertex as usize) * 3 + axis
    }
}
