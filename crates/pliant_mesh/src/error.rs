//! What can be wrong with a mesh, a file or a request, each by name and with its place.

use std::path::PathBuf;

/// Why a surface, a tetrahedral mesh, a description or a file was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// A file could not be read from disk.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file could not be written; whatever stood under its name before is still there.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file's extension names no format that is read or written here.
    #[error("{path}: the extension names no known format: expected {expected}")]
    UnknownFormat {
        /// The file.
        path: PathBuf,
        /// The extensions that would do.
        expected: &'static str,
    },
    /// Something is wrong with the contents of a file.
    #[error("{path}: {source}")]
    InFile {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Box<MeshError>,
    },
    /// The text or bytes do not follow the format.
    #[error("{format}, {place}: expected {expected}, found {found}")]
    Parse {
        /// Name of the format.
        format: &'static str,
        /// Where: a line or a byte offset.
        place: Place,
        /// What the format asks for here.
        expected: String,
        /// What stands there.
        found: String,
    },
    /// There are no elements of the kind that is needed.
    #[error("expected at least one {what}, found none")]
    Empty {
        /// Kind of element, `"triangle"` say.
        what: &'static str,
    },
    /// A coordinate is NaN or infinite.
    #[error("{what} {index}: expected finite coordinates, found {found:?}")]
    NotFinite {
        /// Kind of element, `"node"` say.
        what: &'static str,
        /// Which one, counted from 0.
        index: usize,
        /// The coordinates.
        found: [f64; 3],
    },
    /// An element refers to a node that is not there.
    #[error("{what} {element}: expected node indices below {count}, found {index}")]
    Index {
        /// Kind of element.
        what: &'static str,
        /// Which element, counted from 0.
        element: usize,
        /// The index it holds.
        index: u64,
        /// How many nodes there are.
        count: usize,
    },
    /// Much of the surface has no inside on either side: it bounds no body.
    #[error("surface that bounds no body: winding numbers find no inside along {:.0} % of its area: expected a closed surface or one with small holes", share * 100.0)]
    Undecided {
        /// The share of the area, 0 to 1.
        share: f64,
    },
    /// A tetrahedron has no volume, or is turned inside out.
    #[error(
        "tetrahedron {tet} with nodes {nodes:?} near {at:?}: expected a positive volume, found {volume:e} m^3"
    )]
    FlatTet {
        /// Which tetrahedron, counted from 0.
        tet: usize,
        /// Its nodes.
        nodes: [u32; 4],
        /// Its signed volume in m^3.
        volume: f64,
        /// Its center in m.
        at: [f64; 3],
    },
    /// A triangle has no area.
    #[error("triangle {triangle} near {at:?}: expected a positive area, found {area:e} m^2")]
    FlatTriangle {
        /// Which triangle, counted from 0.
        triangle: usize,
        /// Its area in m^2.
        area: f64,
        /// Its center in m.
        at: [f64; 3],
    },
    /// The surface has holes: edges with a triangle on one side only.
    #[error(
        "open surface: {edges} edges have a triangle on one side only, the first from {from:?} to {to:?}: expected a closed surface"
    )]
    Open {
        /// How many such edges there are.
        edges: usize,
        /// Start of the first one in m.
        from: [f64; 3],
        /// End of the first one in m.
        to: [f64; 3],
    },
    /// More than two triangles meet in an edge.
    #[error("not a manifold: {triangles} triangles meet in the edge from {from:?} to {to:?}: expected 2")]
    NonManifoldEdge {
        /// How many triangles.
        triangles: usize,
        /// Start of the edge in m.
        from: [f64; 3],
        /// End of the edge in m.
        to: [f64; 3],
    },
    /// Two neighbouring triangles are wound against each other.
    #[error(
        "flipped faces: {edges} edges have triangles that are wound against each other, the first from {from:?} to {to:?}"
    )]
    Orientation {
        /// How many such edges there are.
        edges: usize,
        /// Start of the first one in m.
        from: [f64; 3],
        /// End of the first one in m.
        to: [f64; 3],
    },
    /// The surface passes through itself.
    #[error(
        "self-crossing surface: {pairs} pairs of triangles cross, the first {first} and {second} near {at:?}"
    )]
    SelfCrossing {
        /// How many pairs were found.
        pairs: usize,
        /// One triangle of the first pair, counted from 0.
        first: usize,
        /// The other one.
        second: usize,
        /// Where, in m.
        at: [f64; 3],
    },
    /// No lattice gave the wanted number of tetrahedra.
    #[error(
        "number of tetrahedra: expected a mesh of {wanted} within 5 %, the nearest has {nearest}; ask for that or for more"
    )]
    TetCount {
        /// The wanted number.
        wanted: usize,
        /// The nearest number that was reached.
        nearest: usize,
    },
    /// A mesh that was made here has angles that it should not have.
    #[error("dihedral angles: expected {expected:?} degrees, found {found:?}")]
    Dihedral {
        /// Smallest and largest allowed angle, degrees.
        expected: [f64; 2],
        /// Smallest and largest angle, degrees.
        found: [f64; 2],
    },
    /// A number in the description of a body is out of range.
    #[error("part {part:?}: expected {expected}, found {found}")]
    Part {
        /// Name of the part.
        part: String,
        /// What would do.
        expected: String,
        /// What stands there.
        found: f64,
    },
    /// A parameter is out of its range.
    #[error("{name}: expected {expected}, found {found}")]
    Parameter {
        /// Name of the parameter.
        name: &'static str,
        /// Its range.
        expected: String,
        /// What was given.
        found: String,
    },
}

/// A place in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Place {
    /// A line of text, counted from 1.
    Line(usize),
    /// An offset in bytes from the start of the file.
    Byte(usize),
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Line(line) => write!(f, "line {line}"),
            Self::Byte(byte) => write!(f, "byte {byte}"),
        }
    }
}

impl MeshError {
    pub(crate) fn parameter(name: &'static str, expected: impl Into<String>, found: impl ToString) -> Self {
        Self::Parameter { name, expected: expected.into(), found: found.to_string() }
    }
}
