//! A hyperelastic continuum on finite elements: its energy, its nodal forces and its tangent.

use nalgebra::{Matrix3, Vector3};
use pliant_modal::tetrahedron::{self, MAX_NODES};
use pliant_modal::{Hyperelastic, positive_tangent};
use rayon::prelude::*;

use crate::fem::{ANCHORED, FeMesh};

/// Tangent of an element as 3x3 blocks: block (i, j) is at `(i * MAX_NODES + j) * 9`.
pub(crate) type Blocks = [f64; MAX_NODES * MAX_NODES * 9];

/// Elements with a material. Weights of quadrature points contain the factor of the element's
/// moduli, in which all energies are linear. Displacements and forces have one entry per free
/// degree of freedom.
#[derive(Clone, Copy)]
pub(crate) struct Continuum<'a> {
    pub(crate) fe: &'a FeMesh,
    pub(crate) law: Hyperelastic,
    /// Row of each node, or `ANCHORED`.
    pub(crate) number: &'a [u32],
}

impl Continuum<'_> {
    /// Returns the nodes of an element.
    pub(crate) fn nodes(&self, index: usize) -> &[u32] {
        let per = self.fe.element.node_count();
        &self.fe.connectivity[index * per..][..per]
    }

    /// Calls `visit` with the weight (m^3), the gradients of the shape functions and the
    /// displacement gradients of all `width` columns of `u` at each quadrature point of an element.
    pub(crate) fn gradients_of_columns(
        &self,
        index: usize,
        u: &[f64],
        width: usize,
        gradients: &mut [Matrix3<f64>],
        mut visit: impl FnMut(f64, &[Vector3<f64>], &[Matrix3<f64>]),
    ) {
        let (nodes, affine) = (self.nodes(index), &self.fe.affine[index]);
        let (points, share) = tetrahedron::stiffness_points(self.fe.element);
        for &point in points {
            let g = affine.shape_gradients(self.fe.element, point).map(Vector3::from);
            gradients.fill(Matrix3::zeros());
            for (&node, g) in nodes.iter().zip(&g) {
                let row = self.number[node as usize];
                if row == ANCHORED {
                    continue;
                }
                let at = 3 * row as usize * width;
                for (column, h) in gradients.iter_mut().enumerate() {
                    let u = Vector3::from_fn(|axis, _| u[at + axis * width + column]);
                    *h += u * g.transpose();
                }
            }
            visit(share * self.fe.elastic_volume(index), &g[..nodes.len()], gradients);
        }
    }

    /// Returns the displacements of an element's nodes.
    pub(crate) fn of_element(&self, index: usize, u: &[f64]) -> [Vector3<f64>; MAX_NODES] {
        let per = self.fe.element.node_count();
        let mut at = [Vector3::zeros(); MAX_NODES];
        for (at, &node) in at.iter_mut().zip(&self.fe.connectivity[index * per..][..per]) {
            let row = self.number[node as usize];
            if row != ANCHORED {
                *at = Vector3::from_fn(|axis, _| u[3 * row as usize + axis]);
            }
        }
        at
    }

    /// Calls `visit` with the weight (m^3), the gradients of the shape functions and the
    /// displacement gradient at each quadrature point of an element.
    pub(crate) fn at_points(
        &self,
        index: usize,
        u: &[f64],
        mut visit: impl FnMut(f64, &[Vector3<f64>], &Matrix3<f64>),
    ) {
        let per = self.fe.element.node_count();
        let (at, affine) = (self.of_element(index, u), &self.fe.affine[index]);
        let (points, share) = tetrahedron::stiffness_points(self.fe.element);
        for &point in points {
            let g = affine.shape_gradients(self.fe.element, point).map(Vector3::from);
            let h = at.iter().zip(&g[..per]).fold(Matrix3::zeros(), |sum, (u, g)| sum + u * g.transpose());
            visit(share * self.fe.elastic_volume(index), &g[..per], &h);
        }
    }

    /// Returns the elastic energy, J. The sum has the same bits for any number of threads.
    pub(crate) fn elastic_energy(&self, u: &[f64]) -> f64 {
        let parts: Vec<f64> = (0..self.fe.affine.len())
            .into_par_iter()
            .map(|index| {
                let mut sum = 0.0;
                self.at_points(index, u, |w, _, h| sum += w * self.law.energy(h));
                sum
            })
            .collect();
        parts.iter().sum()
    }

    /// Returns the nodal forces of the stresses at a displacement, N.
    pub(crate) fn inner_forces(&self, u: &[f64]) -> Vec<f64> {
        let mut out = vec![0.0; u.len()];
        let forces: Vec<[Vector3<f64>; MAX_NODES]> = (0..self.fe.affine.len())
            .into_par_iter()
            .map(|index| {
                let mut f = [Vector3::zeros(); MAX_NODES];
                self.at_points(index, u, |w, g, h| {
                    let stress = w * self.law.stress(h);
                    f.iter_mut().zip(g).for_each(|(f, g)| *f += stress * g);
                });
                f
            })
            .collect();
        for (nodes, forces) in self.fe.elements().zip(&forces) {
            for (&node, force) in nodes.iter().zip(forces) {
                let row = self.number[node as usize];
                if row != ANCHORED {
                    (0..3).for_each(|axis| out[3 * row as usize + axis] += force[axis]);
                }
            }
        }
        out
    }

    /// Computes the tangent of an element, with `project` the positive semidefinite one.
    pub(crate) fn element_tangent(&self, index: usize, u: &[f64], project: bool, k: &mut Blocks) {
        k.fill(0.0);
        self.at_points(index, u, |w, g, h| {
            let tangent = if project { positive_tangent(self.law, h) } else { self.law.tangent(h) };
            for (j, gj) in g.iter().enumerate() {
                // Stress in each direction by a displacement of node j.
                let mut by_node = [Matrix3::zeros(); 3];
                for (c, by_node) in by_node.iter_mut().enumerate() {
                    for d in 0..3 {
                        *by_node += (w * gj[d]) * tangent.fixed_view::<3, 3>(3 * c, 3 * d);
                    }
                }
                for (i, gi) in g.iter().enumerate() {
                    let block = gi[0] * by_node[0] + gi[1] * by_node[1] + gi[2] * by_node[2];
                    let k = &mut k[(i * MAX_NODES + j) * 9..][..9];
                    // Blocks are stored row by row.
                    for (to, from) in k.iter_mut().zip(block.transpose().as_slice()) {
                        *to += from;
                    }
                }
            }
        });
    }
}
