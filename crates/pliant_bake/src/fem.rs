//! The finite element mesh, its graph, and the assembly of stiffness and mass.
//!
//! The assembly is deterministic: element matrices are computed in parallel, batch by batch, and
//! added in element order.

use pliant_mesh::TetMesh;
use pliant_modal::Element;
use pliant_modal::tetrahedron::{self, Affine, MAX_NODES};
use rayon::prelude::*;

use crate::element;
use crate::sparse::BlockCsr;

/// Row number that marks an anchored node.
pub(crate) const ANCHORED: u32 = u32::MAX;

/// Poisson ratio above which the pressure is averaged over each node's neighborhood.
pub(crate) const LOCKING_POISSON: f64 = 0.45;

/// Nodes and elements of the chosen order. The corners keep their numbers of the tetrahedral mesh,
/// and the mid-edge nodes follow.
#[derive(Clone, Debug)]
pub(crate) struct FeMesh {
    pub(crate) element: Element,
    pub(crate) nodes: Vec<[f64; 3]>,
    /// Number of corners, which are the first entries of `nodes`.
    pub(crate) corners: usize,
    /// Node numbers of the elements, `element.node_count()` per element.
    pub(crate) connectivity: Vec<u32>,
    /// Volume and barycentric gradients of each element.
    pub(crate) affine: Vec<Affine>,
    /// Factor of the moduli of each element.
    pub(crate) stiffness: Vec<f64>,
    /// Factor of the density of each element.
    pub(crate) density: Vec<f64>,
}

impl FeMesh {
    /// Makes the elements of a mesh that has passed `TetMesh::check`.
    pub(crate) fn new(mesh: &TetMesh, element: Element) -> Self {
        let corner = |i: u32| mesh.nodes[i as usize];
        let affine: Vec<Affine> = mesh.tets.par_iter().map(|t| Affine::new(t.map(corner))).collect();
        let (stiffness, density) = (vec![1.0; affine.len()], vec![1.0; affine.len()]);
        let mut nodes = mesh.nodes.clone();
        let corners = nodes.len();
        let (connectivity, edges) = tetrahedron::connectivity(corners, &mesh.tets, element);
        nodes.extend(edges.iter().map(|&[a, b]| {
            let (a, b) = (corner(a), corner(b));
            [0, 1, 2].map(|k| 0.5 * (a[k] + b[k]))
        }));
        Self { element, nodes, corners, connectivity, affine, stiffness, density }
    }

    /// Iterates over the node numbers of each element.
    pub(crate) fn elements(&self) -> std::slice::ChunksExact<'_, u32> {
        self.connectivity.chunks_exact(self.element.node_count())
    }

    /// Returns for each node the elements that contain the node, in ascending order.
    pub(crate) fn elements_of_nodes(&self) -> Lists {
        Lists::invert(self.elements().map(|nodes| nodes.iter().copied()), self.nodes.len())
    }

    /// Returns the graph of the stiffness matrix: for each node its coupled nodes, the node itself
    /// included, in ascending order.
    ///
    /// With `wide`, nodes couple through the whole neighborhood of each corner, which the
    /// nodal-averaged pressure requires.
    pub(crate) fn graph(&self, wide: bool) -> Lists {
        let around = self.elements_of_nodes();
        let per = self.element.node_count();
        let element = |e: u32| &self.connectivity[e as usize * per..][..per];
        let n = self.nodes.len();
        if !wide {
            return Lists::unions(n, |i, visit| {
                for &e in around.of(i) {
                    visit(element(e));
                }
            });
        }
        let patches = Lists::unions(self.corners, |a, visit| {
            for &e in around.of(a) {
                visit(element(e));
            }
        });
        Lists::unions(n, |i, visit| {
            for &e in around.of(i) {
                for &corner in &element(e)[..4] {
                    visit(patches.of(corner as usize));
                }
            }
        })
    }

    /// Assembles stiffness (N/m) and consistent mass (kg) of the nodes that `number` does not mark
    /// as anchored.
    ///
    /// `graph` is the sparsity pattern in that numbering.
    pub(crate) fn assemble(&self, law: &Law, number: &[u32], graph: &Lists) -> BlockCsr {
        const BATCH: usize = 512;
        let per = self.element.node_count();
        let mut out = BlockCsr::zeros(graph);
        let unit_mass = element::unit_mass(self.element);
        let lambda = if law.average_pressure { 0.0 } else { law.lambda };
        let mut batch = vec![[0.0; MAX_NODES * MAX_NODES * 9]; BATCH.min(self.affine.len())];
        for (index, affine) in self.affine.chunks(BATCH).enumerate() {
            let factors = &self.stiffness[index * BATCH..][..affine.len()];
            batch[..affine.len()].par_iter_mut().zip(affine).zip(factors).for_each(|((k, affine), s)| {
                element::stiffness(self.element, affine, s * lambda, s * law.mu, k);
            });
            for (local, k) in batch[..affine.len()].iter().enumerate() {
                let nodes = &self.connectivity[(index * BATCH + local) * per..][..per];
                let mass = law.density * self.filled_volume(index * BATCH + local);
                for (i, &a) in nodes.iter().enumerate() {
                    let row = number[a as usize];
                    if row == ANCHORED {
                        continue;
                    }
                    for (j, &b) in nodes.iter().enumerate() {
                        let column = number[b as usize];
                        if column != ANCHORED {
                            let at = out.position(row, column);
                            out.mass[at] += mass * unit_mass[i * MAX_NODES + j];
                            let block = &k[(i * MAX_NODES + j) * 9..][..9];
                            for (to, from) in out.stiffness[9 * at..][..9].iter_mut().zip(block) {
                                *to += from;
                            }
                        }
                    }
                }
            }
        }
        if law.average_pressure {
            self.add_averaged_pressure(law.lambda, number, &mut out);
        }
        out
    }

    /// Adds the volumetric stiffness with nodal-averaged pressure, `sum_a lambda / V_a d_a d_a^T`.
    ///
    /// Here `d_a . u = int N_a div u dV` and `V_a = int N_a / s dV` over the elements around corner
    /// `a`, with the factor `s` of their moduli: the pressure is continuous, so compliances add up.
    /// The method is due to Bonet and Burton (1998) for linear tetrahedra. For quadratic
    /// tetrahedra it is the Taylor-Hood pair with a lumped pressure mass. Neither element therefore
    /// locks as the Poisson ratio approaches 1/2.
    fn add_averaged_pressure(&self, lambda: f64, number: &[u32], out: &mut BlockCsr) {
        let around = self.elements_of_nodes();
        let per = self.element.node_count();
        let gradients: Vec<_> =
            self.affine.par_iter().map(|affine| element::pressure_gradients(self.element, affine)).collect();
        let mut slot = vec![usize::MAX; self.nodes.len()];
        let mut patch: Vec<(u32, [f64; 3])> = Vec::new();
        for corner in 0..self.corners {
            patch.clear();
            let mut volume = 0.0;
            for &e in around.of(corner) {
                let nodes = &self.connectivity[e as usize * per..][..per];
                let local = nodes[..4].iter().position(|&n| n as usize == corner).unwrap_or(0);
                volume += self.affine[e as usize].volume / (4.0 * self.stiffness[e as usize]);
                for (&node, gradient) in nodes.iter().zip(&gradients[e as usize][local]) {
                    let at = &mut slot[node as usize];
                    if *at == usize::MAX {
                        *at = patch.len();
                        patch.push((node, [0.0; 3]));
                    }
                    for (to, from) in patch[*at].1.iter_mut().zip(gradient) {
                        *to += from;
                    }
                }
            }
            for &(node, _) in &patch {
                slot[node as usize] = usize::MAX;
            }
            patch.retain(|&(node, _)| number[node as usize] != ANCHORED);
            for &(a, da) in &patch {
                for &(b, db) in &patch {
                    let at = out.position(number[a as usize], number[b as usize]);
                    let block = &mut out.stiffness[9 * at..][..9];
                    for (row, da) in block.chunks_exact_mut(3).zip(da) {
                        for (to, db) in row.iter_mut().zip(db) {
                            *to += lambda / volume * (da * db);
                        }
                    }
                }
            }
        }
    }

    /// Returns `M 1` per node over all nodes, anchored nodes included: the mass that a uniform
    /// field moves at each node, kg.
    pub(crate) fn nodal_mass(&self, density: f64) -> Vec<f64> {
        let unit_mass = element::unit_mass(self.element);
        let mut out = vec![0.0; self.nodes.len()];
        for (index, nodes) in self.elements().enumerate() {
            let mass = density * self.filled_volume(index);
            for (i, &node) in nodes.iter().enumerate() {
                let row: f64 = unit_mass[i * MAX_NODES..][..nodes.len()].iter().sum();
                out[node as usize] += mass * row;
            }
        }
        out
    }

    /// Returns the volume of an element times the factor of its density, m^3.
    pub(crate) fn filled_volume(&self, index: usize) -> f64 {
        self.affine[index].volume * self.density[index]
    }

    /// Returns the volume of an element times the factor of its moduli, m^3.
    pub(crate) fn elastic_volume(&self, index: usize) -> f64 {
        self.affine[index].volume * self.stiffness[index]
    }

    /// Returns the volume of the mesh, m^3.
    pub(crate) fn volume(&self) -> f64 {
        self.affine.iter().map(|a| a.volume).sum()
    }
}

/// Material constants for the assembly.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Law {
    /// First Lame constant, Pa.
    pub(crate) lambda: f64,
    /// Shear modulus, Pa.
    pub(crate) mu: f64,
    /// Density, kg/m^3.
    pub(crate) density: f64,
    /// Whether the pressure is averaged over nodes.
    pub(crate) average_pressure: bool,
}

/// Lists of numbers in one array. List `i` is `items[offsets[i]..offsets[i + 1]]`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Lists {
    pub(crate) offsets: Vec<usize>,
    pub(crate) items: Vec<u32>,
}

impl Lists {
    /// Returns the number of lists.
    pub(crate) fn len(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Returns list `i`.
    pub(crate) fn of(&self, i: usize) -> &[u32] {
        &self.items[self.offsets[i]..self.offsets[i + 1]]
    }

    /// Returns for each member below `members` the numbers of the groups that contain the member,
    /// in ascending order.
    fn invert<G: Iterator<Item = u32>>(groups: impl Iterator<Item = G> + Clone, members: usize) -> Self {
        let mut offsets = vec![0; members + 1];
        for group in groups.clone() {
            for member in group {
                offsets[member as usize + 1] += 1;
            }
        }
        for i in 0..members {
            offsets[i + 1] += offsets[i];
        }
        let mut next = offsets.clone();
        let mut items = vec![0; offsets[members]];
        for (number, group) in groups.enumerate() {
            for member in group {
                items[next[member as usize]] = number as u32;
                next[member as usize] += 1;
            }
        }
        Self { offsets, items }
    }

    /// Makes lists where list `i` is the sorted union of the slices that `each(i, visit)` visits.
    fn unions(count: usize, each: impl Fn(usize, &mut dyn FnMut(&[u32])) + Sync) -> Self {
        const CHUNK: usize = 1024;
        let chunks: Vec<(Vec<usize>, Vec<u32>)> = (0..count.div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let (mut lengths, mut items) = (Vec::with_capacity(CHUNK), Vec::new());
                let mut list: Vec<u32> = Vec::new();
                for i in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                    list.clear();
                    each(i, &mut |slice| list.extend_from_slice(slice));
                    list.sort_unstable();
                    list.dedup();
                    lengths.push(list.len());
                    items.extend_from_slice(&list);
                }
                (lengths, items)
            })
            .collect();
        let mut out = Self { offsets: vec![0], items: Vec::new() };
        let mut end = 0;
        for (lengths, items) in chunks {
            for length in lengths {
                end += length;
                out.offsets.push(end);
            }
            out.items.extend_from_slice(&items);
        }
        out
    }

    /// Restricts the graph to the nodes that `number` keeps and returns the graph in the new
    /// numbering (`kept` nodes).
    pub(crate) fn renumber(&self, number: &[u32], kept: usize) -> Self {
        let mut old = vec![0usize; kept];
        for (i, &new) in number.iter().enumerate() {
            if new != ANCHORED {
                old[new as usize] = i;
            }
        }
        let mut out = Self { offsets: vec![0], items: Vec::new() };
        for &i in &old {
            let start = out.items.len();
            out.items.extend(self.of(i).iter().map(|&j| number[j as usize]).filter(|&j| j != ANCHORED));
            out.items[start..].sort_unstable();
            out.offsets.push(out.items.len());
        }
        out
    }
}
