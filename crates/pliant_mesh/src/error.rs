//! Errors of meshes, files and requests, each with a name and a place.

use std::path::PathBuf;

/// Reason why a surface, a tetrahedral mesh, a description or a file was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// A file could not be read from disk.
    #[error("cannot read {path}: {source}")]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A file could not be written. An earlier file of the same name is still intact.
    #[error("cannot write {path}: {source}")]
    Write {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The extension of a file names no format that the crate reads or writes.
    #[error("{path}: the extension names no known format: expected {expected}")]
    UnknownFormat {
        /// Path of the file.
        path: PathBuf,
        /// Accepted extensions.
        expected: &'static str,
    },
    /// The contents of a file are invalid.
    #[error("{path}: {source}")]
    InFile {
        /// Path of the file.
        path: PathBuf,
        /// Error in the contents.
        source: Box<MeshError>,
    },
    /// The text or bytes do not follow the format.
    #[error("{format}, {place}: expected {expected}, found {found}")]
    Parse {
        /// Name of the format.
        format: &'static str,
        /// Line or byte offset of the error.
        place: Place,
        /// Content that the format requires here.
        expected: String,
        /// Content that was found instead.
        found: String,
    },
    /// There are no elements of the required kind.
    #[error("expected at least one {what}, found none")]
    Empty {
        /// Kind of element, for example `"triangle"`.
        what: &'static str,
    },
    /// A coordinate is NaN or infinite.
    #[error("{what} {index}: expected finite coordinates, found {found:?}")]
    NotFinite {
        /// Kind of element, for example `"node"`.
        what: &'static str,
        /// Index of the element, counted from 0.
        index: usize,
        /// Coordinates that were found.
        found: [f64; 3],
    },
    /// An element refers to a node that does not exist.
    #[error("{what} {element}: expected node indices below {count}, found {index}")]
    Index {
        /// Kind of element.
        what: &'static str,
        /// Index of the element, counted from 0.
        element: usize,
        /// Node index that was found.
        index: u64,
        /// Number of nodes.
        count: usize,
    },
    /// Much of the surface has no inside on either side, so it bounds no body.
    #[error("surface that bounds no body: winding numbers find no inside along {:.0} % of its area: expected a closed surface or one with small holes", share * 100.0)]
    Undecided {
        /// Fraction of the area without an inside, 0 to 1.
        share: f64,
    },
    /// A tetrahedron has no volume or is inside out.
    #[error(
        "tetrahedron {tet} with nodes {nodes:?} near {at:?}: expected a positive volume, found {volume:e} m^3"
    )]
    FlatTet {
        /// Index of the tetrahedron, counted from 0.
        tet: usize,
        /// Node indices of the tetrahedron.
        nodes: [u32; 4],
        /// Signed volume, m^3.
        volume: f64,
        /// Center of the tetrahedron, m.
        at: [f64; 3],
    },
    /// A triangle has no area.
    #[error("triangle {triangle} near {at:?}: expected a positive area, found {area:e} m^2")]
    FlatTriangle {
        /// Index of the triangle, counted from 0.
        triangle: usize,
        /// Area of the triangle, m^2.
        area: f64,
        /// Center of the triangle, m.
        at: [f64; 3],
    },
    /// The surface has holes, which are edges with a triangle on one side only.
    #[error(
        "open surface: {edges} edges have a triangle on one side only, the first from {from:?} to {to:?}: expected a closed surface"
    )]
    Open {
        /// Number of such edges.
        edges: usize,
        /// Start of the first such edge, m.
        from: [f64; 3],
        /// End of the first such edge, m.
        to: [f64; 3],
    },
    /// More than two triangles meet at an edge.
    #[error("not a manifold: {triangles} triangles meet in the edge from {from:?} to {to:?}: expected 2")]
    NonManifoldEdge {
        /// Number of triangles at the edge.
        triangles: usize,
        /// Start of the edge, m.
        from: [f64; 3],
        /// End of the edge, m.
        to: [f64; 3],
    },
    /// Two neighboring triangles have opposite winding.
    #[error(
        "flipped faces: {edges} edges have triangles that are wound against each other, the first from {from:?} to {to:?}"
    )]
    Orientation {
        /// Number of such edges.
        edges: usize,
        /// Start of the first such edge, m.
        from: [f64; 3],
        /// End of the first such edge, m.
        to: [f64; 3],
    },
    /// The surface crosses itself.
    #[error(
        "self-crossing surface: {pairs} pairs of triangles cross, the first {first} and {second} near {at:?}"
    )]
    SelfCrossing {
        /// Number of crossing pairs.
        pairs: usize,
        /// Index of one triangle of the first pair, counted from 0.
        first: usize,
        /// Index of the other triangle of the first pair.
        second: usize,
        /// Position of the first crossing, m.
        at: [f64; 3],
    },
    /// No lattice gave the wanted number of tetrahedra.
    #[error(
        "number of tetrahedra: expected a mesh of {wanted} within 5 %, the nearest has {nearest}; ask for that or for more"
    )]
    TetCount {
        /// Wanted number of tetrahedra.
        wanted: usize,
        /// Nearest number that a lattice reached.
        nearest: usize,
    },
    /// So few tetrahedra cannot fill so thin a shape.
    #[error(
        "shape too thin for {tets} tetrahedra: expected its volume within 2 %, the best mesh is off by {:.0} %; ask for more",
        error * 100.0
    )]
    TooThin {
        /// Wanted number of tetrahedra.
        tets: usize,
        /// Error of the volume of the best mesh, as a fraction.
        error: f64,
    },
    /// A mesh that this crate made has dihedral angles outside the guaranteed range.
    #[error("dihedral angles: expected {expected:?} degrees, found {found:?}")]
    Dihedral {
        /// Smallest and largest allowed angle, degrees.
        expected: [f64; 2],
        /// Smallest and largest angle that was found, degrees.
        found: [f64; 2],
    },
    /// A number in the description of a body is out of range.
    #[error("part {part:?}: expected {expected}, found {found}")]
    Part {
        /// Name of the part.
        part: String,
        /// Accepted range.
        expected: String,
        /// Number that was found.
        found: f64,
    },
    /// A parameter is out of its range.
    #[error("{name}: expected {expected}, found {found}")]
    Parameter {
        /// Name of the parameter.
        name: &'static str,
        /// Accepted range.
        expected: String,
        /// Value that was given.
        found: String,
    },
}

/// Place in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Place {
    /// Line of text, counted from 1.
    Line(usize),
    /// Offset from the start of the file, bytes.
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
