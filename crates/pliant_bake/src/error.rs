//! Why a body cannot be baked.

use std::path::PathBuf;

use pliant_mesh::MeshError;
use pliant_modal::ModelError;

/// Why a body cannot be baked: what was expected, what came, and where.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BakeError {
    /// A material or damping number is out of its range.
    #[error("{name}: expected {expected}, got {got}")]
    Parameter {
        /// Which number.
        name: &'static str,
        /// Its range.
        expected: &'static str,
        /// What came.
        got: f64,
    },
    /// The number of modes does not fit the body.
    #[error(
        "modes: expected 1 to {most} for a body of {dofs} free degrees of freedom ({rigid} of them rigid), got {got}"
    )]
    Modes {
        /// What came.
        got: usize,
        /// The largest number that would do.
        most: usize,
        /// Degrees of freedom that are not anchored.
        dofs: usize,
        /// 6 for a free body, 0 for an anchored one.
        rigid: usize,
    },
    /// An element that this crate has no matrices for.
    #[error("element: expected tet4 or tet10, got {got}")]
    Element {
        /// What came.
        got: String,
    },
    /// The tetrahedra are no sound mesh.
    #[error("the tetrahedra: {0}")]
    Mesh(#[source] MeshError),
    /// The skin is no sound surface.
    #[error("the skin: {0}")]
    Skin(#[source] MeshError),
    /// A vertex of the skin lies too far from the tetrahedra to move with them.
    #[error(
        "skin vertex {vertex} at {at:?} is {distance} m away from the tetrahedra: expected at most {allowed} m"
    )]
    SkinFar {
        /// The vertex.
        vertex: usize,
        /// Where it is, m.
        at: [f64; 3],
        /// Its distance, m.
        distance: f64,
        /// A tenth of the body's largest extent, m.
        allowed: f64,
    },
    /// An anchor holds no node.
    #[error("anchor `{anchor}` holds nothing: the body spans {low} to {high} m along that axis")]
    AnchorHoldsNothing {
        /// The anchor.
        anchor: String,
        /// Lowest coordinate of the body along the anchor's axis, m.
        low: f64,
        /// Highest coordinate, m.
        high: f64,
    },
    /// The anchors hold every node.
    #[error("the anchors {anchors} hold all {nodes} nodes: expected some part of the body to be left free")]
    AnchorHoldsEverything {
        /// The anchors.
        anchors: String,
        /// Nodes of the body.
        nodes: usize,
    },
    /// The anchored nodes lie in one point or on one line: the body can still turn.
    #[error(
        "the anchors {anchors} hold only {nodes} nodes, in a point or on a line near {at:?}: the part there can still turn; expected three nodes off a line at least"
    )]
    AnchorTooThin {
        /// The anchors.
        anchors: String,
        /// Nodes held.
        nodes: usize,
        /// Where, m.
        at: [f64; 3],
    },
    /// The mesh falls into parts that are not connected, and a part has no anchor of its own.
    #[error(
        "the mesh has {parts} parts that do not hang together; the one near {at:?} ({nodes} nodes) has no anchor: expected one part, or an anchor on each"
    )]
    LooseParts {
        /// How many parts.
        parts: usize,
        /// A node of the loose one, m.
        at: [f64; 3],
        /// Its nodes.
        nodes: usize,
    },
    /// The stiffness matrix is not positive definite in floating point arithmetic.
    #[error(
        "the stiffness is not positive definite near {at:?}: tetrahedra there are too thin for the material"
    )]
    NotPositive {
        /// The node where it was noticed, m.
        at: [f64; 3],
    },
    /// The eigensolver gave up.
    #[error("the modes did not converge")]
    NoConvergence,
    /// The eigensolver has missed modes, and did not find them in several rounds either.
    #[error("the modes: there are {modes} below {hertz} Hz, and {found} were found")]
    MissedModes {
        /// How many there are.
        modes: usize,
        /// How many of them were found.
        found: usize,
        /// Below which frequency, Hz.
        hertz: f64,
    },
    /// Rounding hides whether the eigensolver has missed modes.
    #[error("the modes up to {hertz} Hz cannot be counted: the mesh is too ill-shaped for these modes")]
    UncountedModes {
        /// The frequency of the last mode, Hz.
        hertz: f64,
    },
    /// The modes are not as accurate as every bake must be.
    #[error("{what} is {got:e}: expected at most {expected:e}; the mesh is too ill-shaped for these modes")]
    Inaccurate {
        /// `|K phi - lambda M phi| / |K phi|` or `|Phi^T M Phi - I|`.
        what: &'static str,
        /// What came out.
        got: f64,
        /// The limit.
        expected: f64,
    },
    /// The matrices could not be written.
    #[error("cannot write {path}: {source}")]
    Export {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The parts do not make a model.
    #[error("the model: {0}")]
    Model(#[from] ModelError),
}
