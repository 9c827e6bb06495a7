//! The baked model: what a body is, independent of where it is and how it moves.

use std::sync::{Arc, OnceLock};

use serde::{Deserialize, Serialize};

use crate::step::MassSites;
use crate::{Basis, ModelError, Precision, SurfaceMesh, check::check_parts};

/// The finite element that a body was baked with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Element {
    /// 4-node (linear) tetrahedra: the paper's. 20-40 % too stiff in bending on coarse meshes.
    Tet4,
    /// 10-node (quadratic) tetrahedra: the default.
    Tet10,
}

impl std::fmt::Display for Element {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Tet4 => "tet4",
            Self::Tet10 => "tet10",
        })
    }
}

/// How the modes lose energy. Mode `i` has the damping coefficient `c_i` of `q'' + c q' + omega^2 q = f`.
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
    /// `c = 2 zeta omega`: the same fraction of critical damping in every mode.
    Ratio(f64),
}

impl Damping {
    /// `c_i` in 1/s for a mode of angular frequency `omega` (rad/s).
    pub fn coefficient(self, omega: f64) -> f64 {
        match self {
            Self::Rayleigh { alpha, beta } => alpha + beta * omega * omega,
            Self::Ratio(zeta) => 2.0 * zeta * omega,
        }
    }
}

/// Where a model came from, and how good its bake was.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BakeInfo {
    /// A name for people: the file it was made from.
    pub name: String,
    /// Tetrahedra of the simulation mesh.
    pub tets: usize,
    /// Nodes of the simulation mesh, mid-edge nodes counted.
    pub nodes: usize,
    /// The element used.
    pub element: Element,
    /// Young's modulus, Pa.
    pub young: f64,
    /// Poisson ratio, -1 < nu < 0.5.
    pub poisson: f64,
    /// Density, kg/m^3.
    pub density: f64,
    /// Damping law.
    pub damping: Damping,
    /// The anchors as they were given (`x<0.01`); empty for a free body.
    pub anchors: Vec<String>,
    /// Largest `|K phi - lambda M phi| / |K phi|` over the modes.
    pub residual_max: f64,
    /// Largest entry of `|Phi^T M Phi - I|`.
    pub orthonormality_max: f64,
}

/// The residual flexibility of one patch: what the kept modes leave out of its static compliance,
/// `W^T (K^-1 - Phi Lambda^-1 Phi^T) W` (m/N, body axes, symmetric and positive semi-definite).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FlexibilitySite {
    /// Surface vertex in the middle of the patch.
    pub vertex: u32,
    /// Patch radius, m.
    pub radius: f64,
    /// 3x3, m/N.
    pub flexibility: [[f64; 3]; 3],
}

/// Content hash of a model (BLAKE3 of its `.modal` payload): two machines with the same hash have the same body, bit for bit.
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

/// Everything that a bake hands over. `m` modes, `n` surface vertices.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelParts {
    /// Where it came from.
    pub info: BakeInfo,
    /// The visible surface at rest.
    pub surface: SurfaceMesh,
    /// Angular frequencies of the elastic modes, rad/s, ascending, positive; `m` entries.
    pub omega: Vec<f64>,
    /// Damping coefficients `c_i`, 1/s, not negative; `m` entries.
    pub damping: Vec<f64>,
    /// Mass-normalised mode shapes at the surface, `[mode][vertex][axis]`, kg^-1/2; `3 n m` entries.
    pub displacement: Vec<f32>,
    /// Half the curl of each mode at the surface, `[mode][vertex][axis]`, kg^-1/2 m^-1; `3 n m` entries.
    pub rotation: Vec<f32>,
    /// `Phi^T M 1_axis`, kg^1/2: how a uniform acceleration (gravity) drives each mode; `m` entries. Zero for a free body's elastic modes.
    pub participation: Vec<[f64; 3]>,
    /// No anchors: the body also has the six rigid modes, which a [`Frame`](crate::Frame) carries.
    pub free: bool,
    /// Total mass, kg.
    pub mass: f64,
    /// Center of mass at rest, m.
    pub center_of_mass: [f64; 3],
    /// Inertia about the center of mass at rest, kg m^2, symmetric.
    pub inertia: [[f64; 3]; 3],
    /// Residual flexibility of patches spread over the surface; may be empty (the grab then falls back on a contact estimate).
    pub sites: Vec<FlexibilitySite>,
}

/// A baked body, immutable; share it as `Arc<ModalModel>` between all bodies that look alike.
#[derive(Debug, Clone)]
pub struct ModalModel {
    parts: ModelParts,
    basis: Basis,
    /// Made when it is first asked for.
    half: OnceLock<Basis>,
    /// Made when gravity first pulls on a bent body.
    mass_sites: OnceLock<Arc<MassSites>>,
    size: f64,
    hash: ModelHash,
    bytes: usize,
    /// Radii of the sites, ascending, each once.
    site_radii: Vec<f64>,
}

impl PartialEq for ModalModel {
    /// By what it was made from; whether the half-precision basis was asked for makes no difference.
    fn eq(&self, other: &Self) -> bool {
        self.parts == other.parts
    }
}

impl ModalModel {
    /// Most modes that a model may have.
    pub const MAX_MODES: usize = 4096;

    /// Longest name, and longest text of one anchor, that a model keeps: bytes.
    pub const MAX_TEXT: usize = 256;

    /// Most anchors that a model keeps.
    pub const MAX_ANCHORS: usize = 64;

    /// Checks the parts and builds the run-time layout.
    ///
    /// # Errors
    /// A length that does not fit the counts, a number that is not finite or not in its range, a vertex that is not there.
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
            size,
            hash,
            bytes: bytes.len(),
            site_radii,
        }
    }

    pub(crate) fn mass_sites(&self) -> &MassSites {
        self.mass_sites.get_or_init(|| Arc::new(MassSites::new(self)))
    }

    pub(crate) fn site_radii(&self) -> &[f64] {
        &self.site_radii
    }

    /// The parts it was made from.
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

    /// 6 for a free body, 0 for an anchored one.
    pub fn rigid_modes(&self) -> usize {
        if self.parts.free { 6 } else { 0 }
    }

    /// Is the body without anchors?
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

    /// Angular frequency (rad/s) and damping coefficient (1/s) of a mode of the same body made of a material `scale` times as stiff: what a
    /// bake with `scale` times the Young's modulus would give, as `K` is proportional to it and `M` knows nothing of it: the same shapes, `omega sqrt(scale)`,
    /// and damping by the same law at that frequency. At a scale of 1 both are the baked ones to the bit.
    pub fn stiffened(&self, mode: usize, scale: f64) -> (f64, f64) {
        let (Some(&omega), Some(&c)) = (self.omega().get(mode), self.damping().get(mode)) else {
            return (0.0, 0.0);
        };
        if scale == 1.0 {
            return (omega, c);
        }
        let stiff = omega * scale.sqrt();
        let law = self.parts.info.damping;
        // A model's coefficients need not be those of its law: they keep their ratio to it.
        let before = law.coefficient(omega);
        let c = if before > 0.0 { c * (law.coefficient(stiff) / before) } else { c };
        (stiff, c)
    }

    /// How a uniform acceleration drives each mode, kg^1/2.
    pub fn participation(&self) -> &[[f64; 3]] {
        &self.parts.participation
    }

    /// The visible surface at rest.
    pub fn surface(&self) -> &SurfaceMesh {
        &self.parts.surface
    }

    /// Modes at the surface in the layout that reconstruction reads.
    pub fn basis(&self) -> &Basis {
        &self.basis
    }

    /// The same in another precision. In half precision it is made when it is first asked for, and kept: half as much memory again.
    pub fn basis_in(&self, precision: Precision) -> &Basis {
        match precision {
            Precision::Single => &self.basis,
            Precision::Half => self.half.get_or_init(|| self.basis.to_half()),
        }
    }

    /// Largest extent of the rest shape's bounds, m: what errors are measured against.
    pub fn size(&self) -> f64 {
        self.size
    }

    /// Content hash.
    pub fn hash(&self) -> ModelHash {
        self.hash
    }

    /// Size as a `.modal` file, bytes.
    pub fn file_bytes(&self) -> usize {
        self.bytes
    }

    /// Where it came from.
    pub fn info(&self) -> &BakeInfo {
        &self.parts.info
    }

    /// Mode shape `mode` at `vertex` along `axis`, kg^-1/2; zero outside the model.
    pub fn displacement_row(&self, vertex: u32, axis: usize, mode: usize) -> f32 {
        self.parts.displacement.get(self.row(vertex, axis, mode)).copied().unwrap_or(0.0)
    }

    /// Half the curl of mode `mode` at `vertex` about `axis`, kg^-1/2 m^-1; zero outside the model.
    pub fn rotation_row(&self, vertex: u32, axis: usize, mode: usize) -> f32 {
        self.parts.rotation.get(self.row(vertex, axis, mode)).copied().unwrap_or(0.0)
    }

    fn row(&self, vertex: u32, axis: usize, mode: usize) -> usize {
        let count = self.parts.surface.positions().len();
        if axis > 2 || vertex as usize >= count || mode >= self.mode_count() {
            return usize::MAX;
        }
        (mode * count + vertex as usize) * 3 + axis
    }
}
