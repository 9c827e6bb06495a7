//! The elements around held patches, and static shapes on them.

mod solve;

use nalgebra::{Matrix3, Vector3};

use super::{
    columns::Columns,
    elastic::{AddGradients, Amplitudes, Elastic, Generalized, Sample},
    mesh::SimulationMesh,
    stiffness::{Stiffness, zeros},
};
use crate::{
    Element, Hyperelastic, Patch,
    cubature::{Point, Rows},
    nonlinear::{LANES, Lane},
    simd::widest,
    tetrahedron::{self, Affine, MAX_NODES},
};

/// Radius of the region around a patch, as a multiple of the patch's radius.
const REACH: f64 = 2.0;

/// Least radius of a region, as a share of the body's size.
const LEAST: f64 = 0.3;

/// Maximum number of elements around one patch.
const MAX_ELEMENTS: usize = 2_000;

/// Maximum number of elements around one of two patches of an anchored body on which its static
/// shapes are solved. What
/// a body gives farther from a hand is smooth, but the coordinates do not have all of it: two hands
/// that sheared a bunny were off by 23 % with static shapes that ended at the region. A single hand
/// feels it as a compliance ([`super::left_out`]). Four hands that twist the end of a bar move
/// little beyond the region, and were off by 6 % with static shapes of the whole body.
const FAR_ELEMENTS: usize = 12_000;

/// A quadrature point of an element of the mesh with its weight, m^3.
#[derive(Debug, Clone, Copy)]
pub(super) struct WeightedPoint {
    pub(super) element: u32,
    pub(super) point: usize,
    pub(super) weight: f64,
}

/// Elements of the simulation mesh around some patches: the region, and more beyond it on which the
/// static shapes are solved.
pub(super) struct Region<'a> {
    mesh: &'a SimulationMesh,
    kind: Element,
    /// Numbers of the region's elements in the mesh, ascending.
    elements: Vec<u32>,
    /// Own nodes of each of these elements.
    nodes: Vec<[u32; MAX_NODES]>,
    affine: Vec<Affine>,
    /// Numbers of the nodes in the mesh: those of the region, ascending, then those beyond it,
    /// ascending.
    numbers: Vec<u32>,
    /// Number of nodes of the region.
    near: usize,
    /// Node numbers of all elements of the mesh.
    connectivity: Vec<u32>,
    /// For each patch: whether its static shapes may move a node.
    free: Vec<Vec<bool>>,
    /// For each patch: whether its shapes of second order may move a node of the region.
    free_near: Vec<Vec<bool>>,
    /// Whether the corrections of shapes may move a node of the region.
    free_for_any: Vec<bool>,
    /// Stiffness of the region's elements.
    stiffness: Stiffness,
    /// Whether the body is anchored anywhere.
    is_anchored: bool,
    /// Stiffness of all elements, where there are some beyond the region.
    far_stiffness: Option<Stiffness>,
}

/// Node numbers with shares of a load.
pub(super) type NodeLoad = Vec<(u32, f64)>;

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
        let around = |least: f64, most: usize| -> Vec<Vec<u32>> {
            let around = |&(center, radius): &(Vector3<f64>, f64)| {
                let reach = (REACH * radius).max(least * size);
                let away = |e: u32| {
                    let middle = mesh.tets[e as usize].map(|c| Vector3::from(corner(c)));
                    (0.25 * middle.iter().sum::<Vector3<f64>>() - center).norm()
                };
                let mut near: Vec<(f64, u32)> = (0..mesh.tets.len() as u32)
                    .map(|e| (away(e), e))
                    .filter(|(away, _)| *away <= reach)
                    .collect();
                near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                near.truncate(most);
                let mut near: Vec<u32> = near.into_iter().map(|(_, e)| e).collect();
                near.sort_unstable();
                near
            };
            patches.iter().map(around).collect()
        };
        let sorted = |mut numbers: Vec<u32>| {
            numbers.sort_unstable();
            numbers.dedup();
            numbers
        };
        let near = around(LEAST, MAX_ELEMENTS);
        // Nothing holds the shapes of a free body beyond the region.
        let is_anchored = (0..mesh.node_count() as u32).any(|node| mesh.is_anchored(node));
        let reaches_far = patches.len() == 2 && is_anchored;
        let far = if reaches_far { around(f64::INFINITY, FAR_ELEMENTS) } else { near.clone() };
        let elements = sorted(near.iter().flatten().copied().collect());
        let beyond: Vec<u32> = sorted(far.iter().flatten().copied().collect());
        let beyond: Vec<u32> = beyond.into_iter().filter(|e| elements.binary_search(e).is_err()).collect();
        let of = |e: &u32| &connectivity[*e as usize * per..][..per];
        let mut numbers = sorted(elements.iter().flat_map(of).copied().collect());
        let near_count = numbers.len();
        let farther = sorted(beyond.iter().flat_map(of).copied().collect());
        let is_farther = |node: &u32| numbers.binary_search(node).is_err();
        let farther: Vec<u32> = farther.into_iter().filter(is_farther).collect();
        numbers.extend(farther);
        let own_nodes = |e: &u32| {
            let mut out = [0; MAX_NODES];
            let local = |node| local(&numbers, near_count, node).unwrap_or_default();
            out.iter_mut().zip(of(e)).for_each(|(out, &node)| *out = local(node));
            out
        };
        // All energies are linear in the moduli, so their factor goes into the volume.
        let weighed = |e: &u32| {
            let affine = Affine::new(mesh.tets[*e as usize].map(corner));
            Affine { volume: affine.volume * mesh.stiffness(*e), ..affine }
        };
        let nodes: Vec<[u32; MAX_NODES]> = elements.iter().map(own_nodes).collect();
        let affine: Vec<Affine> = elements.iter().map(weighed).collect();
        // A shape ends where an element outside begins, so that it is continuous.
        let mut uses = vec![0u32; numbers.len()];
        for &node in &connectivity {
            if let Some(at) = local(&numbers, near_count, node) {
                uses[at as usize] += 1;
            }
        }
        let anchored: Vec<bool> = numbers.iter().map(|&n| mesh.is_anchored(n)).collect();
        let inner = |elements: &[u32], count: usize| -> Vec<bool> {
            let mut own = vec![0u32; numbers.len()];
            for node in elements.iter().flat_map(of) {
                if let Some(at) = local(&numbers, near_count, *node) {
                    own[at as usize] += 1;
                }
            }
            let nodes = own.iter().zip(&uses).zip(&anchored).take(count);
            nodes.map(|((own, all), anchored)| own == all && !anchored).collect()
        };
        let free_near: Vec<Vec<bool>> = near.iter().map(|around| inner(around, near_count)).collect();
        let free = far.iter().map(|around| inner(around, numbers.len())).collect();
        // Something must hold the shapes of a free body.
        let mut free_for_any = inner(&elements, near_count);
        if let (true, Some(first)) = (free_for_any.iter().all(|free| *free), free_near.first()) {
            free_for_any.clone_from(first);
        }
        let stiffness = Stiffness::new(kind, law, near_count, &nodes, &affine);
        let far_stiffness = (!beyond.is_empty()).then(|| {
            let nodes = [nodes.clone(), beyond.iter().map(own_nodes).collect()].concat();
            let affine = [affine.clone(), beyond.iter().map(weighed).collect()].concat();
            Stiffness::new(kind, law, numbers.len(), &nodes, &affine)
        });
        Self {
            mesh,
            kind,
            elements,
            nodes,
            affine,
            numbers,
            near: near_count,
            connectivity,
            free,
            free_near,
            free_for_any,
            stiffness,
            is_anchored,
            far_stiffness,
        }
    }

    /// Whether every patch's shapes are held somewhere: at an anchor or where the region ends.
    pub(super) fn is_held(&self) -> bool {
        self.free_near.iter().all(|free| free.iter().any(|free| !free))
    }

    /// Whether the body is anchored anywhere.
    pub(super) fn is_anchored(&self) -> bool {
        self.is_anchored
    }

    /// Number of nodes of the region and beyond it.
    pub(super) fn node_count(&self) -> usize {
        self.numbers.len()
    }

    /// Own number of a node of the mesh.
    fn local(&self, node: u32) -> Option<usize> {
        local(&self.numbers, self.near, node).map(|own| own as usize)
    }

    /// Octave of the moduli of an element of the mesh. Only elements of one octave may stand for
    /// each other.
    fn octave(&self, element: u32) -> i64 {
        self.mesh.stiffness(element).log2().round() as i64
    }

    /// Center of an element of the mesh, m, and its volume times the factor of its moduli, m^3.
    fn place(&self, element: u32) -> (Vector3<f64>, f64) {
        let corners = self.mesh.tets[element as usize].map(|c| self.mesh.corners[c as usize].map(f64::from));
        let center = corners.iter().map(|&c| Vector3::from(c)).sum::<Vector3<f64>>() * 0.25;
        (center, Affine::new(corners).volume * self.mesh.stiffness(element))
    }

    /// Spreads the weights of a patch over the nodes of the mesh.
    pub(super) fn load(&self, patch: &Patch) -> NodeLoad {
        let mut out: NodeLoad = Vec::new();
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
    pub(super) fn mean(&self, load: &NodeLoad, columns: &[f64], width: usize) -> (Rows, Rows) {
        let modes = self.mesh.scales.len();
        let mut own: Rows = std::array::from_fn(|_| vec![0.0; width]);
        let mut modal: Rows = std::array::from_fn(|_| vec![0.0; modes]);
        let mut phi = vec![0.0; 3 * modes];
        for &(node, share) in load {
            self.mesh.coordinates(node, &mut phi);
            for (modal, phi) in modal.iter_mut().zip(phi.chunks_exact(modes)) {
                modal.iter_mut().zip(phi).for_each(|(out, x)| *out += share * x);
            }
            let Some(at) = self.local(node) else { continue };
            let column = columns[3 * at * width..][..3 * width].chunks_exact(width);
            for (own, x) in own.iter_mut().zip(column) {
                own.iter_mut().zip(x).for_each(|(out, x)| *out += share * x);
            }
        }
        (own, modal)
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
            let Some(at) = self.local(node) else { return };
            if !self.free_for_any.get(at).is_some_and(|free| *free) && !self.free.iter().any(|free| free[at])
            {
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

    /// The elastic forces of the body on columns and coordinates in given shapes: those of the
    /// region, and of at most about `most` quadrature points outside of it.
    pub(super) fn forces(
        &self,
        columns: &Columns,
        shapes: &[Vec<f64>],
        law: Hyperelastic,
        outside: &[WeightedPoint],
    ) -> Vec<Vec<f64>> {
        let per = self.kind.node_count();
        let points = tetrahedron::stiffness_points(self.kind).0.len() as f64;
        let of = |e: u32| &self.connectivity[e as usize * per..][..per];
        let inside = self.elements.iter().map(|&element| (element, None));
        let outside = outside.iter().filter(|place| place.point == 0);
        let outside = outside.map(|place| (place.element, Some(points * place.weight)));
        let sampled: Vec<(u32, Option<f64>)> = inside.chain(outside).collect();
        // The nodes of these elements have numbers of their own.
        let mut local = vec![u32::MAX; self.mesh.node_count()];
        sampled.iter().flat_map(|&(e, _)| of(e)).for_each(|&node| local[node as usize] = 0);
        let mut nodes: Vec<(u32, Option<u32>)> = Vec::new();
        for (node, local) in local.iter_mut().enumerate().filter(|(_, local)| **local == 0) {
            *local = nodes.len() as u32;
            nodes.push((node as u32, self.local(node as u32).map(|own| own as u32)));
        }
        let elements: Vec<Sample> = sampled
            .iter()
            .map(|&(element, volume)| {
                let mut nodes = [0; MAX_NODES];
                nodes.iter_mut().zip(of(element)).for_each(|(n, &node)| *n = local[node as usize]);
                let affine = self.affine_of(element);
                Sample { nodes, affine, share: volume.map_or(1.0, |volume| volume / affine.volume) }
            })
            .collect();
        let all = columns.width + self.mesh.scales.len();
        let mut out = Vec::with_capacity(shapes.len());
        for shapes in shapes.chunks(LANES) {
            let at = Amplitudes::new(shapes.iter().map(|q| &q[..]), columns);
            let mut forces = zeros(nodes.len());
            widest(Elastic {
                mesh: self.mesh,
                kind: self.kind,
                law,
                columns,
                at: &at,
                nodes: &nodes,
                elements: &elements,
                out: &mut forces,
            });
            let mut sums = vec![Lane::splat(0.0); all];
            widest(Generalized { mesh: self.mesh, columns, nodes: &nodes, forces: &forces, out: &mut sums });
            out.extend((0..shapes.len()).map(|lane| sums.iter().map(|sum| sum.0[lane]).collect()));
        }
        out
    }

    /// All energies are linear in the moduli, so their factor goes into the volume.
    fn affine_of(&self, element: u32) -> Affine {
        let corners = self.mesh.tets[element as usize].map(|c| self.mesh.corners[c as usize].map(f64::from));
        let affine = Affine::new(corners);
        Affine { volume: affine.volume * self.mesh.stiffness(element), ..affine }
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

    /// The stiffness of the elements around the nodes that columns are given for.
    fn stiffness_of(&self, nodes: usize) -> &Stiffness {
        self.far_stiffness.as_ref().filter(|_| nodes > self.near).unwrap_or(&self.stiffness)
    }

    /// `A^T K B` of columns `a` and `b`, row by row. Columns that move the region alone may be
    /// given for its nodes alone.
    pub(super) fn energies(&self, [a, b]: [&[f64]; 2], [rows, width]: [usize; 2]) -> Vec<f64> {
        let mut forces = vec![0.0; b.len()];
        self.stiffness_of(b.len() / (3 * width)).times(b, width, &mut forces);
        let mut out = vec![0.0; rows * width];
        for (x, f) in a.chunks_exact(rows).zip(forces.chunks_exact(width)) {
            for (out, x) in out.chunks_exact_mut(width).zip(x) {
                out.iter_mut().zip(f).for_each(|(out, f)| *out += x * f);
            }
        }
        out
    }

    /// `Phi^T K Y` of the coordinates and columns, `[coordinate][column]`. Columns that move the
    /// region alone may be given for its nodes alone.
    pub(super) fn coupling(&self, columns: &[f64], width: usize) -> Vec<f64> {
        let modes = self.mesh.scales.len();
        let mut forces = vec![0.0; columns.len()];
        self.stiffness_of(columns.len() / (3 * width)).times(columns, width, &mut forces);
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

    /// Displacements of the region's nodes by the columns, less the coordinates' part of them, and
    /// by the coordinates after them, `[node][axis][..]`.
    pub(super) fn node_rows(&self, columns: &Columns) -> Vec<f64> {
        let all = columns.width + self.mesh.scales.len();
        let mut out = vec![0.0; 3 * self.near * all];
        for ((own, &node), out) in (0..).zip(&self.numbers).zip(out.chunks_exact_mut(3 * all)) {
            self.node_row(node, Some(own), columns, out);
        }
        out
    }

    fn node_row(&self, node: u32, own: Option<usize>, columns: &Columns, out: &mut [f64]) {
        let (modes, width) = (self.mesh.scales.len(), columns.width);
        let mut phi = vec![0.0; 3 * modes];
        self.mesh.coordinates(node, &mut phi);
        for (axis, out) in out.chunks_exact_mut(width + modes).enumerate() {
            let (first, modal) = out.split_at_mut(width);
            modal.copy_from_slice(&phi[axis * modes..][..modes]);
            match own {
                Some(own) => {
                    first.copy_from_slice(&columns.values[(3 * own + axis) * width..][..width]);
                }
                None => first.fill(0.0),
            }
            columns.take_out(modal, first);
        }
    }

    /// Gradients of the columns and of the coordinates after them at quadrature points of elements
    /// of the mesh, with the points' weights. `rows` are the [`Region::node_rows`].
    pub(super) fn points(&self, places: &[WeightedPoint], columns: &Columns, rows: &[f64]) -> Vec<Point> {
        let per = self.kind.node_count();
        let all = columns.width + self.mesh.scales.len();
        let (points, _) = tetrahedron::stiffness_points(self.kind);
        let mut outer = vec![0.0; 3 * all];
        let make = |place: &WeightedPoint| {
            let affine = self.affine_of(place.element);
            let g = affine.shape_gradients(self.kind, points[place.point % points.len()]);
            let nodes = &self.connectivity[place.element as usize * per..][..per];
            let mut gradients = vec![0.0; 9 * all];
            for (&node, g) in nodes.iter().zip(&g) {
                let own = self.local(node);
                let rows = match own {
                    Some(own) if own < self.near => &rows[3 * own * all..][..3 * all],
                    _ => {
                        self.node_row(node, own, columns, &mut outer);
                        &outer
                    }
                };
                widest(AddGradients { rows, g, out: &mut gradients, all });
            }
            Point { weight: place.weight, gradients }
        };
        places.iter().map(make).collect()
    }

    /// All quadrature points of the region's elements.
    pub(super) fn inside(&self) -> Vec<WeightedPoint> {
        let points = tetrahedron::stiffness_points(self.kind).0.len();
        let make = |(&element, affine): (&u32, &Affine)| {
            let weight = affine.volume / points as f64;
            (0..points).map(move |point| WeightedPoint { element, point, weight })
        };
        self.elements.iter().zip(&self.affine).flat_map(make).collect()
    }

    /// At most about `most` quadrature points outside of the region, spread over the body, with
    /// weights whose sum is the volume there.
    pub(super) fn outside(&self, size: f64, most: usize) -> Vec<WeightedPoint> {
        let mut order: Vec<((i64, [i64; 3]), u32, f64)> = (0..self.mesh.tets.len() as u32)
            .filter(|element| self.elements.binary_search(element).is_err())
            .map(|element| {
                let (center, volume) = self.place(element);
                // Elements in the order of a coarse grid lie beside each other.
                let cell: [i64; 3] = std::array::from_fn(|k| (16.0 * center[k] / size).floor() as i64);
                ((self.octave(element), cell), element, volume)
            })
            .collect();
        order.sort_by_key(|&(cell, element, _)| (cell, element));
        let points = tetrahedron::stiffness_points(self.kind).0.len();
        let stride = (order.len() * points).div_ceil(most).max(1);
        let groups = order.chunks(stride).enumerate();
        groups
            .flat_map(|(group, members)| {
                // All points of one element of each group, for the volume of the group.
                let weight = members.iter().map(|(_, _, volume)| volume).sum::<f64>() / points as f64;
                let (_, element, _) = members[(group * 7919) % members.len()];
                (0..points).map(move |point| WeightedPoint { element, point, weight })
            })
            .collect()
    }
}

/// Own number of a node of the mesh, given the numbers of the own nodes, those of the region first.
fn local(numbers: &[u32], near: usize, node: u32) -> Option<u32> {
    let (near, far) = numbers.split_at(near);
    let found = near.binary_search(&node).or_else(|_| far.binary_search(&node).map(|at| near.len() + at));
    found.ok().map(|at| at as u32)
}
