//! Straight-sided tetrahedra with 4 or 10 nodes: their shape functions and quadrature.
//!
//! The nodes of an [`Element::Tet10`] are the four corners and the midpoints of the six [`EDGES`].

use crate::Element;

/// Corner pairs of the six mid-edge nodes, in the order of nodes 4 to 9 of a 10-node element.
pub const EDGES: [[usize; 2]; 6] = [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]];

/// Largest number of nodes of an element.
pub const MAX_NODES: usize = 10;

/// Returns the node numbers of each element, `element.node_count()` per tetrahedron, and the edges
/// (pairs of corners) whose midpoints are the nodes after the `corners` corners.
///
/// The edges are in ascending order. A mesh of 4-node elements has none.
pub fn connectivity(corners: usize, tets: &[[u32; 4]], element: Element) -> (Vec<u32>, Vec<[u32; 2]>) {
    if element == Element::Tet4 {
        return (tets.iter().flatten().copied().collect(), Vec::new());
    }
    let key = |t: &[u32; 4], [a, b]: [usize; 2]| [t[a].min(t[b]), t[a].max(t[b])];
    let mut edges: Vec<[u32; 2]> = tets.iter().flat_map(|t| EDGES.map(|edge| key(t, edge))).collect();
    edges.sort_unstable();
    edges.dedup();
    let number = |edge: [u32; 2]| (corners + edges.partition_point(|&e| e < edge)) as u32;
    let nodes = tets.iter().flat_map(|t| t.iter().copied().chain(EDGES.map(|edge| number(key(t, edge)))));
    (nodes.collect(), edges)
}

/// Affine tetrahedron: its volume (m^3) and the gradients of its barycentric coordinates (1/m).
#[derive(Clone, Copy, Debug)]
pub struct Affine {
    /// Volume, m^3.
    pub volume: f64,
    /// Gradients of the barycentric coordinates, 1/m.
    pub gradients: [[f64; 3]; 4],
}

impl Affine {
    /// Makes the tetrahedron from its four corners.
    ///
    /// The volume is signed: it is positive when `(b-a) x (c-a) . (d-a) > 0`.
    pub fn new(corners: [[f64; 3]; 4]) -> Self {
        let [a, b, c, d] = corners;
        let (u, v, w) = (sub(b, a), sub(c, a), sub(d, a));
        let six_volume = dot(cross(u, v), w);
        let scale = 1.0 / six_volume;
        let g1 = cross(v, w).map(|x| x * scale);
        let g2 = cross(w, u).map(|x| x * scale);
        let g3 = cross(u, v).map(|x| x * scale);
        let g0 = [0, 1, 2].map(|k| -(g1[k] + g2[k] + g3[k]));
        Self { volume: six_volume / 6.0, gradients: [g0, g1, g2, g3] }
    }

    /// Returns the gradients of the element's shape functions at barycentric coordinates `l`, 1/m.
    pub fn shape_gradients(&self, element: Element, l: [f64; 4]) -> [[f64; 3]; MAX_NODES] {
        let g = &self.gradients;
        let mut out = [[0.0; 3]; MAX_NODES];
        match element {
            Element::Tet4 => out[..4].copy_from_slice(g),
            Element::Tet10 => {
                for a in 0..4 {
                    out[a] = g[a].map(|x| (4.0 * l[a] - 1.0) * x);
                }
                for (e, &[a, b]) in EDGES.iter().enumerate() {
                    out[4 + e] = [0, 1, 2].map(|k| 4.0 * (l[a] * g[b][k] + l[b] * g[a][k]));
                }
            }
        }
        out
    }
}

/// Returns the shape functions of the element at barycentric coordinates `l`.
pub fn shape(element: Element, l: [f64; 4]) -> [f64; MAX_NODES] {
    let mut out = [0.0; MAX_NODES];
    match element {
        Element::Tet4 => out[..4].copy_from_slice(&l),
        Element::Tet10 => {
            for a in 0..4 {
                out[a] = l[a] * (2.0 * l[a] - 1.0);
            }
            for (e, &[a, b]) in EDGES.iter().enumerate() {
                out[4 + e] = 4.0 * l[a] * l[b];
            }
        }
    }
    out
}

/// Returns the points of the quadrature that integrates the stiffness exactly, and their common
/// weight as a fraction of the volume.
pub fn stiffness_points(element: Element) -> (&'static [[f64; 4]], f64) {
    const CENTER: [[f64; 4]; 1] = [[0.25; 4]];
    // Quadrature rule of degree 2: a = (5 + 3 sqrt 5) / 20, b = (5 - sqrt 5) / 20.
    const A: f64 = 0.585_410_196_624_968_5;
    const B: f64 = 0.138_196_601_125_010_5;
    const FOUR: [[f64; 4]; 4] = [[A, B, B, B], [B, A, B, B], [B, B, A, B], [B, B, B, A]];
    match element {
        Element::Tet4 => (&CENTER, 1.0),
        Element::Tet10 => (&FOUR, 0.25),
    }
}

/// Returns `a - b`.
pub fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Returns the cross product of two vectors.
pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Returns the scalar product of two vectors.
pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
