//! The elements around held patches, and static shapes on them.

use nalgebra::{Matrix3, Vector3};

use super::mesh::SimulationMesh;
use crate::{
    Element, Hyperelastic, Patch,
    cubature::Rows,
    tetrahedron::{self, Affine, MAX_NODES},
};

/// Radius of the region around a patch, as a multiple of the patch's radius. Larger regions give no
/// better forces (docs/decisions.md).
const REACH: f64 = 2.0;

/// Least radius of a region, as a share of the body's size.
const LEAST: f64 = 0.3;

/// Maximum number of elements around one patch.
const MAX_ELEMENTS: usize = 2_000;

/// Residual of the static shapes, in the norm of the energy, at which the iteration ends. The
/// shapes are a basis, so that they need not be exact.
const TOLERANCE: f64 = 1e-3;

/// Maximum number of iterations for the static shapes.
const MAX_ITERATIONS: usize = 100;

/// Elements of the simulation mesh around some patches.
pub(super) struct Region<'a> {
    mesh: &'a SimulationMesh,
    kind: Element,
    /// Numbers of the elements in the mesh, ascending.
    pub(super) elements: Vec<u32>,
    /// Region's nodes of each of these elements.
    nodes: Vec<[u32; MAX_NODES]>,
    affine: Vec<Affine>,
    /// Numbers of the region's nodes in the mesh.
    numbers: Vec<u32>,
    /// Node numbers of all elements of the mesh.
    connectivity: Vec<u32>,
    /// For each patch: whether the patch's shapes may move a node of the region.
    free: Vec<Vec<bool>>,
    stiffness: Stiffness,
}

/// Node numbers with shares of a load.
pub(super) type Load = Vec<(u32, f64)>;

impl<'a> Region<'a> {
    pub(super) fn new(
        mesh: &'a SimulationMesh,
        kind: Element,
        law: Hyperelastic,
        patches: &[(Vector3<f64>, f64)],
        size: f64,
    ) -> Self {
        let per = kind.node_count();
        let (connectivity, _) = tetrahedron::connectivity(mesh.corners.len(), &mesh.tets, kind);
        let corner = |i: u32| mesh.corners[i as usize].map(f64::from);
        let around: Vec<Vec<u32>> = patches
            .iter()
            .map(|&(center, radius)| {
                let reach = (REACH * radius).max(LEAST * size);
                let away = |e: u32| {
                    let middle = mesh.tets[e as usize].map(|c| Vector3::from(corner(c)));
                    (0.25 * middle.iter().sum::<Vector3<f64>>() - center).norm()
                };
                let mut near: Vec<(f64, u32)> = (0..mesh.tets.len() as u32)
                    .map(|e| (away(e), e))
                    .filter(|(away, _)| *away <= reach)
                    .collect();
                near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                near.truncate(MAX_ELEMENTS);
                let mut near: Vec<u32> = near.into_iter().map(|(_, e)| e).collect();
                near.sort_unstable();
                near
            })
            .collect();
        let mut elements: Vec<u32> = around.iter().flatten().copied().collect();
        elements.sort_unstable();
        elements.dedup();
        let of = |e: u32| &connectivity[e as usize * per..][..per];
        let mut numbers: Vec<u32> = elements.iter().flat_map(|&e| of(e)).copied().collect();
        numbers.sort_unstable();
        numbers.dedup();
        let local = |node: u32| numbers.partition_point(|&n| n < node) as u32;
        let nodes: Vec<[u32; MAX_NODES]> = elements
            .iter()
            .map(|&e| {
                let mut out = [0; MAX_NODES];
                out.iter_mut().zip(of(e)).for_each(|(out, &node)| *out = local(node));
                out
            })
            .collect();
        // All energies are linear in the moduli, so their factor goes into the volume.
        let affine: Vec<Affine> = elements
            .iter()
            .map(|&e| {
                let affine = Affine::new(mesh.tets[e as usize].map(corner));
                Affine { volume: affine.volume * mesh.stiffness(e), ..affine }
            })
            .collect();
        // A shape ends where an element outside begins, so that it is continuous.
        let mut uses = vec![0u32; numbers.len()];
        for &node in &connectivity {
            if let Ok(at) = numbers.binary_search(&node) {
                uses[at] += 1;
            }
        }
        let anchored: Vec<bool> = numbers.iter().map(|&n| mesh.is_anchored(n)).collect();
        let free = around
            .iter()
            .map(|around| {
                let mut own = vec![0u32; numbers.len()];
                for &e in around {
                    of(e).iter().for_each(|&node| own[local(node) as usize] += 1);
                }
                own.iter()
                    .zip(&uses)
                    .zip(&anchored)
                    .map(|((own, all), anchored)| own == all && !anchored)
                    .collect()
            })
            .collect();
        let stiffness = Stiffness::new(kind, law, numbers.len(), &nodes, &affine);
        Self { mesh, kind, elements, nodes, affine, numbers, connectivity, free, stiffness }
    }

    /// Whether every patch's shapes are held somewhere: at an anchor or where the region ends.
    pub(super) fn is_held(&self) -> bool {
        self.free.iter().all(|free| free.iter().any(|free| !free))
    }

    /// Number of nodes.
    pub(super) fn node_count(&self) -> usize {
        self.numbers.len()
    }

    /// Number of elements of the whole mesh.
    pub(super) fn mesh_elements(&self) -> usize {
        self.mesh.tets.len()
    }

    /// Octave of the moduli of an element of the mesh. Only elements of one octave may stand for
    /// each other.
    pub(super) fn octave(&self, element: u32) -> i64 {
        self.mesh.stiffness(element).log2().round() as i64
    }

    /// Center of an element of the mesh, m, and its volume times the factor of its moduli, m^3.
    pub(super) fn place(&self, element: u32) -> (Vector3<f64>, f64) {
        let corners = self.mesh.tets[element as usize].map(|c| self.mesh.corners[c as usize].map(f64::from));
        let center = corners.iter().map(|&c| Vector3::from(c)).sum::<Vector3<f64>>() * 0.25;
        (center, Affine::new(corners).volume * self.mesh.stiffness(element))
    }

    /// Spreads the weights of a patch over the nodes of the mesh.
    pub(super) fn load(&self, patch: &Patch) -> Load {
        let mut out: Load = Vec::new();
        for &(vertex, weight) in patch.entries() {
            self.vertex(vertex, &mut |node, share| out.push((node, weight * share)));
        }
        out.sort_by_key(|&(node, _)| node);
        out.dedup_by(|from, to| {
            let same = from.0 == to.0;
            if same {
                to.1 += from.1;
            }
            same
        });
        out
    }

    /// Mean displacement of a load's nodes by the columns and by the coordinates, `[axis][..]`.
    pub(super) fn mean(&self, load: &Load, columns: &[f64], width: usize) -> (Rows, Rows) {
        let modes = self.mesh.scales.len();
        let mut own: Rows = std::array::from_fn(|_| vec![0.0; width]);
        let mut modal: Rows = std::array::from_fn(|_| vec![0.0; modes]);
        let mut phi = vec![0.0; 3 * modes];
        for &(node, share) in load {
            self.mesh.coordinates(node, &mut phi);
            for (modal, phi) in modal.iter_mut().zip(phi.chunks_exact(modes)) {
                modal.iter_mut().zip(phi).for_each(|(out, x)| *out += share * x);
            }
            let Ok(at) = self.numbers.binary_search(&node) else { continue };
            let column = columns[3 * at * width..][..3 * width].chunks_exact(width);
            for (own, x) in own.iter_mut().zip(column) {
                own.iter_mut().zip(x).for_each(|(out, x)| *out += share * x);
            }
        }
        (own, modal)
    }

    /// The kind of the elements.
    pub(super) fn kind(&self) -> Element {
        self.kind
    }

    /// Calls `visit` with the nodes of the mesh that move a surface vertex, and their shares.
    fn vertex(&self, vertex: u32, visit: &mut dyn FnMut(u32, f64)) {
        let Some(place) = self.mesh.vertices.get(vertex as usize) else { return };
        let [b, c, d] = place.at.map(f64::from);
        let at = [1.0 - b - c - d, b, c, d];
        let corners =
            self.mesh.tets[place.element as usize].map(|c| self.mesh.corners[c as usize].map(f64::from));
        let gradients = Affine::new(corners).shape_gradients(self.kind, at);
        let shape = tetrahedron::shape(self.kind, at);
        let per = self.kind.node_count();
        let nodes = &self.connectivity[place.element as usize * per..][..per];
        for (i, &node) in nodes.iter().enumerate() {
            let share = shape[i] + tetrahedron::dot(gradients[i], place.offset.map(f64::from));
            if share != 0.0 {
                visit(node, share);
            }
        }
    }

    /// Displacements of a surface vertex by columns on the region, `[axis][column]`. Returns
    /// `false` and writes nothing if no column moves the vertex.
    pub(super) fn columns_at(&self, vertex: u32, columns: &[f64], width: usize, out: &mut [f64]) -> bool {
        let mut moved = false;
        self.vertex(vertex, &mut |node, share| {
            let Ok(at) = self.numbers.binary_search(&node) else { return };
            if !self.free.iter().any(|free| free[at]) {
                return;
            }
            if !moved {
                out.fill(0.0);
                moved = true;
            }
            let column = &columns[3 * at * width..][..3 * width];
            out.iter_mut().zip(column).for_each(|(out, x)| *out += share * x);
        });
        moved
    }

    /// The static shape of each axis of a load on the patch with this index, and the shapes of
    /// second order of all six pairs of them: nine columns, `[node][axis][column]`.
    pub(super) fn static_shapes(&self, index: usize, load: &Load, law: Hyperelastic) -> Vec<f64> {
        let nodes = self.node_count();
        let mut first = vec![0.0; 9 * nodes];
        for &(node, share) in load {
            if let Ok(at) = self.numbers.binary_search(&node) {
                (0..3).for_each(|axis| first[(3 * at + axis) * 3 + axis] += share);
            }
        }
        let free = &self.free[index];
        self.stiffness.solve(free, &mut first, 3);
        let mut second = self.second_order_forces(&first, law);
        self.stiffness.solve(free, &mut second, 6);
        let mut out = Vec::with_capacity(27 * nodes);
        for (a, b) in first.chunks_exact(3).zip(second.chunks_exact(6)) {
            out.extend(a);
            out.extend(b);
        }
        out
    }

    /// Displacements by which a Newton step with the stiffness at rest corrects given displacements
    /// of the region, where a force (N) acts on the load of the patch with this index. `given` and
    /// the result are `[node][axis][case]`.
    pub(super) fn corrections(
        &self,
        index: usize,
        load: &Load,
        forces: &[Vector3<f64>],
        given: &[f64],
        law: Hyperelastic,
    ) -> Vec<f64> {
        let cases = forces.len();
        let mut out = vec![0.0; given.len()];
        for &(node, share) in load {
            let Ok(at) = self.numbers.binary_search(&node) else { continue };
            for (axis, out) in out[3 * at * cases..][..3 * cases].chunks_exact_mut(cases).enumerate() {
                out.iter_mut().zip(forces).for_each(|(out, force)| *out += share * force[axis]);
            }
        }
        let mut u = vec![0.0; 3 * self.node_count()];
        for case in 0..cases {
            u.iter_mut().zip(given.iter().skip(case).step_by(cases)).for_each(|(u, given)| *u = *given);
            for element in 0..self.elements.len() {
                self.at_points(element, &u, &mut [Matrix3::zeros()], |weight, nodes, g, [h]| {
                    let stress = weight * law.stress(h);
                    for (&node, g) in nodes.iter().zip(g) {
                        let force = stress * g;
                        let at = 3 * node as usize;
                        (0..3).for_each(|axis| out[(at + axis) * cases + case] -= force[axis]);
                    }
                });
            }
        }
        self.stiffness.solve(&self.free[index], &mut out, cases);
        out
    }

    /// Displacements of the region's nodes by the coordinates and columns, `[node][axis]`, m.
    pub(super) fn displacements(&self, q: &[f64], columns: &[f64], s: &[f64]) -> Vec<f64> {
        let (modes, width) = (self.mesh.scales.len(), s.len());
        let mut phi = vec![0.0; 3 * modes];
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let mut out = Vec::with_capacity(3 * self.node_count());
        for (&node, columns) in self.numbers.iter().zip(columns.chunks_exact(3 * width)) {
            self.mesh.coordinates(node, &mut phi);
            let rows = phi.chunks_exact(modes).zip(columns.chunks_exact(width));
            out.extend(rows.map(|(phi, column)| dot(phi, q) + dot(column, s)));
        }
        out
    }

    /// The nodal forces of second order of the pairs of three shapes.
    fn second_order_forces(&self, shapes: &[f64], law: Hyperelastic) -> Vec<f64> {
        const PAIRS: [(usize, usize); 6] = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)];
        let mut out = vec![0.0; 2 * shapes.len()];
        let mut h = [Matrix3::zeros(); 3];
        for element in 0..self.elements.len() {
            self.at_points(element, shapes, &mut h, |weight, nodes, g, h| {
                let own = h.each_ref().map(|h| law.second_order_stress(h));
                for (pair, &(i, j)) in PAIRS.iter().enumerate() {
                    let both = law.second_order_stress(&(h[i] + h[j]));
                    let stress = weight * (both - own[i] - own[j]);
                    for (&node, g) in nodes.iter().zip(g) {
                        let force = stress * g;
                        let at = 3 * node as usize;
                        (0..3).for_each(|axis| out[(at + axis) * 6 + pair] += force[axis]);
                    }
                }
            });
        }
        out
    }

    /// Calls `visit` with the weight, the nodes, the gradients of the shape functions and the
    /// gradients of `N` columns at each quadrature point of an element of the region.
    fn at_points<const N: usize>(
        &self,
        element: usize,
        columns: &[f64],
        gradients: &mut [Matrix3<f64>; N],
        mut visit: impl FnMut(f64, &[u32], &[Vector3<f64>], &[Matrix3<f64>; N]),
    ) {
        let per = self.kind.node_count();
        let (points, share) = tetrahedron::stiffness_points(self.kind);
        let (nodes, affine) = (&self.nodes[element][..per], &self.affine[element]);
        for &point in points {
            let g = affine.shape_gradients(self.kind, point).map(Vector3::from);
            gradients.fill(Matrix3::zeros());
            for (&node, g) in nodes.iter().zip(&g) {
                let at = 3 * node as usize * N;
                for (column, h) in gradients.iter_mut().enumerate() {
                    let u = Vector3::from_fn(|axis, _| columns[at + axis * N + column]);
                    *h += u * g.transpose();
                }
            }
            visit(share * affine.volume, nodes, &g[..per], gradients);
        }
    }

    /// `A^T K B` of columns `a` and `b` on the region, row by row.
    pub(super) fn energies(&self, [a, b]: [&[f64]; 2], [rows, width]: [usize; 2]) -> Vec<f64> {
        let mut forces = vec![0.0; b.len()];
        self.stiffness.times(b, width, &mut forces);
        let mut out = vec![0.0; rows * width];
        for (x, f) in a.chunks_exact(rows).zip(forces.chunks_exact(width)) {
            for (out, x) in out.chunks_exact_mut(width).zip(x) {
                out.iter_mut().zip(f).for_each(|(out, f)| *out += x * f);
            }
        }
        out
    }

    /// `Phi^T K Y` of the coordinates and columns on the region, `[coordinate][column]`.
    pub(super) fn coupling(&self, columns: &[f64], width: usize) -> Vec<f64> {
        let modes = self.mesh.scales.len();
        let mut forces = vec![0.0; columns.len()];
        self.stiffness.times(columns, width, &mut forces);
        let (mut out, mut phi) = (vec![0.0; modes * width], vec![0.0; 3 * modes]);
        for (node, forces) in self.numbers.iter().zip(forces.chunks_exact(3 * width)) {
            self.mesh.coordinates(*node, &mut phi);
            for (phi, forces) in phi.chunks_exact(modes).zip(forces.chunks_exact(width)) {
                for (out, phi) in out.chunks_exact_mut(width).zip(phi) {
                    out.iter_mut().zip(forces).for_each(|(out, f)| *out += phi * f);
                }
            }
        }
        out
    }

    /// Gradients of the columns and of the coordinates after them at a quadrature point of an
    /// element of the mesh, as in [`Point`](crate::cubature::Point).
    pub(super) fn gradients(&self, element: u32, point: usize, columns: &[f64], width: usize) -> Vec<f64> {
        let (modes, per) = (self.mesh.scales.len(), self.kind.node_count());
        let all = modes + width;
        let corners = self.mesh.tets[element as usize].map(|c| self.mesh.corners[c as usize].map(f64::from));
        let (points, _) = tetrahedron::stiffness_points(self.kind);
        let g = Affine::new(corners).shape_gradients(self.kind, points[point % points.len()]);
        let nodes = &self.connectivity[element as usize * per..][..per];
        let (mut out, mut phi) = (vec![0.0; 9 * all], vec![0.0; 3 * modes]);
        let inside = self.elements.binary_search(&element).is_ok();
        for (&node, g) in nodes.iter().zip(&g) {
            self.mesh.coordinates(node, &mut phi);
            let own = if inside { self.numbers.binary_search(&node).ok() } else { None };
            for (c, g) in g.iter().enumerate() {
                for r in 0..3 {
                    let out = &mut out[(3 * c + r) * all..][..all];
                    let phi = &phi[r * modes..][..modes];
                    out[width..].iter_mut().zip(phi).for_each(|(out, x)| *out += x * g);
                    if let Some(at) = own {
                        let column = &columns[(3 * at + r) * width..][..width];
                        out.iter_mut().zip(column).for_each(|(out, x)| *out += x * g);
                    }
                }
            }
        }
        out
    }
}

/// Stiffness of the elements of a region at rest, in rows of 3x3 blocks.
struct Stiffness {
    offsets: Vec<usize>,
    columns: Vec<u32>,
    blocks: Vec<Matrix3<f64>>,
}

impl Stiffness {
    fn new(
        kind: Element,
        law: Hyperelastic,
        count: usize,
        elements: &[[u32; MAX_NODES]],
        affine: &[Affine],
    ) -> Self {
        let per = kind.node_count();
        let mut pairs: Vec<[u32; 2]> = elements
            .iter()
            .flat_map(|nodes| {
                let nodes = &nodes[..per];
                nodes.iter().flat_map(move |&a| nodes.iter().map(move |&b| [a, b]))
            })
            .collect();
        pairs.sort_unstable();
        pairs.dedup();
        let offsets: Vec<usize> =
            (0..=count).map(|row| pairs.partition_point(|&[a, _]| (a as usize) < row)).collect();
        let columns: Vec<u32> = pairs.into_iter().map(|[_, b]| b).collect();
        let mut blocks = vec![Matrix3::zeros(); columns.len()];
        let tangent = law.tangent(&Matrix3::zeros());
        let (points, share) = tetrahedron::stiffness_points(kind);
        for (nodes, affine) in elements.iter().zip(affine) {
            for &point in points {
                let g = affine.shape_gradients(kind, point);
                let weight = share * affine.volume;
                for (b, gb) in nodes[..per].iter().zip(&g) {
                    // Stresses by unit displacements of node b.
                    let mut stress = [Matrix3::zeros(); 3];
                    for (axis, stress) in stress.iter_mut().enumerate() {
                        for (c, gb) in gb.iter().enumerate() {
                            let column = tangent.column(3 * c + axis);
                            stress.iter_mut().zip(column.iter()).for_each(|(s, t)| *s += weight * gb * t);
                        }
                    }
                    for (a, ga) in nodes[..per].iter().zip(&g) {
                        let start = offsets[*a as usize];
                        let row = &columns[start..offsets[*a as usize + 1]];
                        let block = &mut blocks[start + row.partition_point(|c| c < b)];
                        for (axis, stress) in stress.iter().enumerate() {
                            let force = stress * Vector3::from(*ga);
                            (0..3).for_each(|k| block[(k, axis)] += force[k]);
                        }
                    }
                }
            }
        }
        Self { offsets, columns, blocks }
    }

    /// Computes `out = K x` for columns stored as `[node][axis][column]`.
    fn times(&self, x: &[f64], width: usize, out: &mut [f64]) {
        for (row, out) in out.chunks_exact_mut(3 * width).enumerate() {
            out.fill(0.0);
            let range = self.offsets[row]..self.offsets[row + 1];
            for (&column, block) in self.columns[range.clone()].iter().zip(&self.blocks[range]) {
                let x = &x[3 * column as usize * width..][..3 * width];
                for (i, out) in out.chunks_exact_mut(width).enumerate() {
                    for (j, x) in x.chunks_exact(width).enumerate() {
                        let k = block[(i, j)];
                        out.iter_mut().zip(x).for_each(|(out, x)| *out += k * x);
                    }
                }
            }
        }
    }

    /// Replaces forces by displacements of the free nodes, `width` columns at once, by conjugate
    /// gradients with the inverses of the diagonal blocks (M. R. Hestenes and E. Stiefel, *Methods
    /// of Conjugate Gradients for Solving Linear Systems*, 1952).
    fn solve(&self, free: &[bool], f: &mut [f64], width: usize) {
        let inverses: Vec<Matrix3<f64>> = (0..free.len())
            .map(|row| {
                let range = self.offsets[row]..self.offsets[row + 1];
                let at = range.start + self.columns[range].partition_point(|&c| (c as usize) < row);
                let diagonal = self.blocks.get(at).and_then(|block| block.try_inverse());
                diagonal.filter(|_| free[row]).unwrap_or_default()
            })
            .collect();
        let precondition = |r: &[f64], z: &mut [f64]| {
            let rows = z.chunks_exact_mut(3 * width).zip(r.chunks_exact(3 * width));
            for ((z, r), inverse) in rows.zip(&inverses) {
                for (i, z) in z.chunks_exact_mut(width).enumerate() {
                    z.fill(0.0);
                    for (j, r) in r.chunks_exact(width).enumerate() {
                        z.iter_mut().zip(r).for_each(|(z, r)| *z += inverse[(i, j)] * r);
                    }
                }
            }
        };
        let dots = |a: &[f64], b: &[f64]| {
            let mut sums = vec![0.0; width];
            for (a, b) in a.chunks_exact(width).zip(b.chunks_exact(width)) {
                sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
            }
            sums
        };
        let add = |to: &mut [f64], share: &[f64], from: &[f64], sign: f64| {
            for (to, from) in to.chunks_exact_mut(width).zip(from.chunks_exact(width)) {
                for ((to, from), share) in to.iter_mut().zip(from).zip(share) {
                    *to += sign * share * from;
                }
            }
        };
        let ratio = |a: &[f64], b: &[f64]| -> Vec<f64> {
            a.iter().zip(b).map(|(a, b)| if *b > 0.0 { a / b } else { 0.0 }).collect()
        };
        let mut residual = f.to_vec();
        let mut z = vec![0.0; f.len()];
        precondition(&residual, &mut z);
        let (mut direction, mut forces) = (z.clone(), vec![0.0; f.len()]);
        let mut left = dots(&residual, &z);
        let enough: Vec<f64> = left.iter().map(|x| TOLERANCE * TOLERANCE * x).collect();
        f.fill(0.0);
        for _ in 0..MAX_ITERATIONS {
            self.times(&direction, width, &mut forces);
            // Nodes that are not free have no direction, and their forces count for nothing.
            let step = ratio(&left, &dots(&direction, &forces));
            add(f, &step, &direction, 1.0);
            add(&mut residual, &step, &forces, -1.0);
            precondition(&residual, &mut z);
            let now = dots(&residual, &z);
            if now.iter().zip(&enough).all(|(now, enough)| now <= enough) {
                break;
            }
            let keep = ratio(&now, &left);
            for (direction, z) in direction.chunks_exact_mut(width).zip(z.chunks_exact(width)) {
                for ((direction, z), keep) in direction.iter_mut().zip(z).zip(&keep) {
                    *direction = z + keep * *direction;
                }
            }
            left = now;
        }
    }
}
