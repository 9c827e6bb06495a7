//! Full finite elements that share no line with those of the bake: displacements alone, so that
//! they lock as such elements do, and a Cholesky factor within a band.

use std::collections::HashMap;

use nalgebra::{Matrix3, Vector3};
use pliant_mesh::TetMesh;
use pliant_modal::{Element, Patch, SurfaceMesh};

/// Corner pairs of a ten-node element's other nodes.
const MIDDLES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

/// A linear solid, held where x is below a plane.
pub(super) struct Solid {
    nodes: Vec<Vector3<f64>>,
    /// First row of each node, if it is not held.
    rows: Vec<Option<usize>>,
    stiffness: Band,
}

impl Solid {
    /// Assembles and factors the stiffness. `lame` has lambda and mu, Pa.
    pub(super) fn new(mesh: &TetMesh, element: Element, lame: [f64; 2], held: f64) -> Self {
        let mut nodes: Vec<Vector3<f64>> = mesh.nodes.iter().map(|p| (*p).into()).collect();
        let mut middle: HashMap<[u32; 2], usize> = HashMap::new();
        let elements: Vec<Vec<usize>> = (mesh.tets.iter())
            .map(|tet| {
                let mut all: Vec<usize> = tet.iter().map(|&n| n as usize).collect();
                if element == Element::Tet10 {
                    for [a, b] in MIDDLES {
                        let (a, b) = (tet[a].min(tet[b]), tet[a].max(tet[b]));
                        all.push(*middle.entry([a, b]).or_insert_with(|| {
                            nodes.push(0.5 * (nodes[a as usize] + nodes[b as usize]));
                            nodes.len() - 1
                        }));
                    }
                }
                all
            })
            .collect();
        // Along the bar, so that the band is narrow.
        let mut along: Vec<usize> = (0..nodes.len()).filter(|&n| nodes[n].x >= held).collect();
        along.sort_by(|&a, &b| nodes[a].x.total_cmp(&nodes[b].x));
        let mut rows = vec![None; nodes.len()];
        along.iter().enumerate().for_each(|(row, &node)| rows[node] = Some(3 * row));
        let span = |all: &Vec<usize>| {
            let of = || all.iter().filter_map(|&n| rows[n]);
            of().max().unwrap_or(0) - of().min().unwrap_or(0) + 2
        };
        let mut stiffness = Band::new(3 * along.len(), elements.iter().map(span).max().unwrap_or(0));
        for (tet, all) in mesh.tets.iter().zip(&elements) {
            let corners = tet.map(|n| nodes[n as usize]);
            let edges = Matrix3::from_columns(&[
                corners[1] - corners[0],
                corners[2] - corners[0],
                corners[3] - corners[0],
            ]);
            let volume = edges.determinant() / 6.0;
            let Some(inverse) = edges.try_inverse() else { continue };
            let [b, c, d] = [0, 1, 2].map(|k| inverse.row(k).transpose());
            let slopes = [-(b + c + d), b, c, d];
            for l in points(element) {
                let g = gradients(element, slopes, l);
                let w = volume / points(element).len() as f64;
                for (i, &a) in all.iter().enumerate() {
                    for (j, &b) in all.iter().enumerate() {
                        let (Some(a), Some(b)) = (rows[a], rows[b]) else { continue };
                        let block = lame[0] * g[i] * g[j].transpose()
                            + lame[1] * (g[j] * g[i].transpose() + Matrix3::identity() * g[i].dot(&g[j]));
                        for k in 0..3 {
                            for m in (0..3).filter(|m| b + m <= a + k) {
                                *stiffness.at(a + k, b + m) += w * block[(k, m)];
                            }
                        }
                    }
                }
            }
        }
        stiffness.factor();
        Self { nodes, rows, stiffness }
    }

    /// The force on a hand that holds a patch of the solid's surface `by` (m) from its rest, N. It
    /// is not a number if a vertex of the patch is no node.
    pub(super) fn reaction(&self, surface: &SurfaceMesh, patch: &Patch, by: [f64; 3]) -> Vector3<f64> {
        let stiffness = self.compliance(surface, patch).try_inverse();
        stiffness.map_or_else(|| Vector3::repeat(f64::NAN), |inverse| -(inverse * Vector3::from(by)))
    }

    /// The way of a patch of the solid's surface under a force on it, m/N. It is not a number if a
    /// vertex of the patch is no node.
    pub(super) fn compliance(&self, surface: &SurfaceMesh, patch: &Patch) -> Matrix3<f64> {
        let mut shares = vec![0.0; self.stiffness.size / 3];
        for &(vertex, weight) in patch.entries() {
            let at = Vector3::from(surface.positions()[vertex as usize].map(f64::from));
            let off = |n: usize| (self.nodes[n] - at).norm();
            let node = (0..self.nodes.len()).min_by(|&a, &b| off(a).total_cmp(&off(b)));
            // The surface has its places in single precision.
            let Some(node) = node.filter(|&n| off(n) <= 1e-6 * at.norm()) else {
                return Matrix3::repeat(f64::NAN);
            };
            if let Some(row) = self.rows[node] {
                shares[row / 3] += weight;
            }
        }
        let mut compliance = Matrix3::zeros();
        for axis in 0..3 {
            let mut moved = vec![0.0; self.stiffness.size];
            shares.iter().enumerate().for_each(|(n, share)| moved[3 * n + axis] = *share);
            self.stiffness.solve(&mut moved);
            for (n, share) in shares.iter().enumerate() {
                (0..3).for_each(|k| compliance[(k, axis)] += share * moved[3 * n + k]);
            }
        }
        compliance
    }
}

/// Lambda and mu of a stiffness (Pa) and a Poisson ratio.
pub(super) fn lame(young: f64, poisson: f64) -> [f64; 2] {
    [young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))]
}

/// The force (N) that bends a square bar of `length` and `edge` (m) by a meter at its end:
/// Timoshenko's beam with Cowper's shear coefficient.
pub(super) fn timoshenko(young: f64, poisson: f64, length: f64, edge: f64) -> f64 {
    let (area, moment) = (edge.powi(2), edge.powi(4) / 12.0);
    let shear = 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson);
    let [_, mu] = lame(young, poisson);
    1.0 / (length.powi(3) / (3.0 * young * moment) + length / (shear * mu * area))
}

/// Points at which the integrand is summed with equal weights: exactly for both elements.
fn points(element: Element) -> &'static [[f64; 4]] {
    // (5 - sqrt 5) / 20 and (5 + 3 sqrt 5) / 20.
    const A: f64 = 0.138_196_601_125_010_5;
    const B: f64 = 0.585_410_196_624_968_5;
    match element {
        Element::Tet4 => &[[0.25; 4]],
        Element::Tet10 => &[[B, A, A, A], [A, B, A, A], [A, A, B, A], [A, A, A, B]],
    }
}

/// Gradients of the nodes' functions at a point, 1/m.
fn gradients(element: Element, slopes: [Vector3<f64>; 4], l: &[f64; 4]) -> Vec<Vector3<f64>> {
    match element {
        Element::Tet4 => slopes.to_vec(),
        Element::Tet10 => {
            let corner = |k: usize| (4.0 * l[k] - 1.0) * slopes[k];
            let between = |[a, b]: [usize; 2]| 4.0 * (l[a] * slopes[b] + l[b] * slopes[a]);
            (0..4).map(corner).chain(MIDDLES.map(between)).collect()
        }
    }
}

/// The lower half of a symmetric matrix, row by row, and then its Cholesky factor.
struct Band {
    size: usize,
    /// Entries left of the diagonal.
    width: usize,
    entries: Vec<f64>,
}

impl Band {
    fn new(size: usize, width: usize) -> Self {
        Self { size, width, entries: vec![0.0; size * (width + 1)] }
    }

    fn at(&mut self, row: usize, column: usize) -> &mut f64 {
        &mut self.entries[row * (self.width + 1) + self.width + column - row]
    }

    /// The entries of a row in the columns from `from` to before `to`.
    fn part(&self, row: usize, from: usize, to: usize) -> &[f64] {
        let start = row * (self.width + 1) + self.width - row;
        &self.entries[start + from..start + to]
    }

    fn factor(&mut self) {
        for i in 0..self.size {
            let first = i.saturating_sub(self.width);
            for j in first..=i {
                let from = first.max(j.saturating_sub(self.width));
                let left = self.part(i, j, j + 1)[0] - dot(self.part(i, from, j), self.part(j, from, j));
                *self.at(i, j) = if i == j { left.sqrt() } else { left / self.part(j, j, j + 1)[0] };
            }
        }
    }

    fn solve(&self, x: &mut [f64]) {
        for i in 0..self.size {
            let first = i.saturating_sub(self.width);
            x[i] = (x[i] - dot(self.part(i, first, i), &x[first..i])) / self.part(i, i, i + 1)[0];
        }
        for i in (0..self.size).rev() {
            x[i] /= self.part(i, i, i + 1)[0];
            let (first, known) = (i.saturating_sub(self.width), x[i]);
            for (x, entry) in x[first..i].iter_mut().zip(self.part(i, first, i)) {
                *x -= entry * known;
            }
        }
    }
}

/// A sum in eight parts, so that the processor adds several at a time.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut sums = [0.0; 8];
    for (a, b) in a.iter().zip(b) {
        (0..8).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f64>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f64>()
}

#[cfg(test)]
mod tests {
    #![expect(clippy::unwrap_used, reason = "a failed test should panic")]

    use super::{super::bodies::BarBody, *};

    /// The force at the end of a bar 10 : 1 over that of Timoshenko's beam.
    fn over_beam(element: Element, cells: [usize; 3], poisson: f64) -> f64 {
        let bar = BarBody { cells, section: [0.1, 0.1], modes: 1, ..BarBody::default() };
        let model = bar.bake().unwrap();
        let patch = Patch::around(model.surface(), bar.vertex(&model, [1.0, 0.5, 0.5]), 0.06).unwrap();
        let solid = Solid::new(&bar.mesh().unwrap(), element, lame(1e5, poisson), 1e-9);
        let force = solid.reaction(model.surface(), &patch, [0.0, 1e-6, 0.0]);
        -force.y / (1e-6 * timoshenko(1e5, poisson, 1.0, 0.1))
    }

    #[test]
    fn ten_node_elements_bend_as_a_beam_and_four_node_elements_lock() {
        let [some, all] = [0.3, 0.499].map(|poisson| over_beam(Element::Tet4, [20, 2, 2], poisson));
        println!("tet4: {some} and {all}");
        // The held end cannot contract, which a beam knows nothing of.
        for (poisson, limit) in [(0.0, 0.002), (0.3, 0.02), (0.499, 0.07)] {
            let off = over_beam(Element::Tet10, [20, 2, 2], poisson) - 1.0;
            assert!(off.abs() < limit, "{poisson}: {off}");
        }
        assert!(some > 1.5 && all > 5.0 * some, "{some} and {all}");
    }
}
