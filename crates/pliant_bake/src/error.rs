//! Errors of a bake.

use std::path::PathBuf;

use pliant_mesh::MeshError;
use pliant_modal::ModelError;

/// Reason why a body cannot be baked, with the expected value, the received value and the place.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BakeError {
    /// A material or damping number is out of its range.
    #[error("{name}: expected {expected}, got {got}")]
    Parameter {
        /// Name of the number.
        name: &'static str,
        /// Accepted range of the number.
        expected: &'static str,
        /// Received value.
        got: f64,
    },
    /// The number of modes does not fit the body.
    #[error(
        "modes: expected 1 to {most} for a body of {dofs} free degrees of freedom ({rigid} of them rigid), got {got}"
    )]
    Modes {
        /// Requested number of modes.
        got: usize,
        /// Largest possible number of modes.
        most: usize,
        /// Degrees of freedom that are not anchored.
        dofs: usize,
        /// Number of rigid modes: 6 for a free body, 0 for an anchored one.
        rigid: usize,
    },
    /// The tetrahedra are not a valid mesh.
    #[error("the tetrahedra: {0}")]
    Mesh(#[source] MeshError),
    /// The skin is not a valid surface.
    #[error("the skin: {0}")]
    Skin(#[source] MeshError),
    /// The painted surface is not a valid surface.
    #[error("the painted surface: {0}")]
    Paint(#[source] MeshError),
    /// A vertex of the skin lies too far from the tetrahedra to move with them.
    #[error(
        "skin vertex {vertex} at {at:?} is {distance} m away from the tetrahedra: expected at most {allowed} m"
    )]
    SkinFar {
        /// Index of the vertex.
        vertex: usize,
        /// Position of the vertex, m.
        at: [f64; 3],
        /// Distance of the vertex from the tetrahedra, m.
        distance: f64,
        /// Largest accepted distance, a tenth of the body's largest extent, m.
        allowed: f64,
    },
    /// An anchor contains no node.
    #[error("anchor `{anchor}` holds nothing: the body spans {low} to {high} m along that axis")]
    AnchorHoldsNothing {
        /// Text of the anchor.
        anchor: String,
        /// Lowest coordinate of the body along the anchor's axis, m.
        low: f64,
        /// Highest coordinate of the body along the anchor's axis, m.
        high: f64,
    },
    /// The anchors contain every node.
    #[error("the anchors {anchors} hold all {nodes} nodes: expected some part of the body to be left free")]
    AnchorHoldsEverything {
        /// Texts of the anchors.
        anchors: String,
        /// Number of nodes of the body.
        nodes: usize,
    },
    /// The anchored nodes of a part lie in one point or on one line, so the part can still turn.
    #[error(
        "the anchors {anchors} hold only {nodes} nodes, in a point or on a line near {at:?}: the part there can still turn; expected three nodes off a line at least"
    )]
    AnchorTooThin {
        /// Texts of the anchors.
        anchors: String,
        /// Number of anchored nodes in the part.
        nodes: usize,
        /// Mean position of these nodes, m.
        at: [f64; 3],
    },
    /// The mesh has several parts that are not connected, and one part has no anchor of its own.
    #[error(
        "the mesh has {parts} parts that do not hang together; the one near {at:?} ({nodes} nodes) has no anchor: expected one part, or an anchor on each"
    )]
    LooseParts {
        /// Number of connected parts.
        parts: usize,
        /// Position of one node of the loose part, m.
        at: [f64; 3],
        /// Number of nodes of the loose part.
        nodes: usize,
    },
    /// The stiffness matrix is not positive definite in floating point arithmetic.
    #[error(
        "the stiffness is not positive definite near {at:?}: tetrahedra there are too thin for the material"
    )]
    NotPositive {
        /// Position of the node where the factorization failed, m.
        at: [f64; 3],
    },
    /// The eigensolver did not converge.
    #[error("the modes did not converge")]
    NoConvergence,
    /// The eigensolver missed modes and did not find them in several further rounds.
    #[error("the modes: there are {modes} below {hertz} Hz, and {found} were found")]
    MissedModes {
        /// Number of modes below the frequency.
        modes: usize,
        /// Number of these modes that the solver found.
        found: usize,
        /// Frequency below which the modes were counted, Hz.
        hertz: f64,
    },
    /// Rounding errors prevent the check for missed modes.
    #[error("the modes up to {hertz} Hz cannot be counted: the mesh is too ill-shaped for these modes")]
    UncountedModes {
        /// The frequency of the last mode, Hz.
        hertz: f64,
    },
    /// The modes are less accurate than every bake requires.
    #[error("{what} is {got:e}: expected at most {expected:e}; the mesh is too ill-shaped for these modes")]
    Inaccurate {
        /// Name of the error measure: `|K phi - lambda M phi| / |K phi|` or `|Phi^T M Phi - I|`.
        what: &'static str,
        /// Measured value.
        got: f64,
        /// Largest accepted value.
        expected: f64,
    },
    /// The matrices could not be written.
    #[error("cannot write {path}: {source}")]
    Export {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The baked parts do not form a valid model.
    #[error("the model: {0}")]
    Model(#[from] ModelError),
}
