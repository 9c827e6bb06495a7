//! Displacements that are solved for: static shapes, those of second order, and corrections.

use nalgebra::Matrix3;

use super::{Columns, NodeLoad, Region};
use crate::{
    Hyperelastic,
    cubature::GuidedShape,
    held::{
        elastic::{Amplitudes, Elastic, Sample},
        stiffness::{MAX_ITERATIONS, Stiffness, field, write, zeros},
    },
    nonlinear::{LANES, positive_tangent},
    simd::widest,
    tetrahedron,
};

/// Maximum number of iterations that solve a static shape beyond the region. With 100, those of a
/// whole bunny left the ears off by half as much again.
const FAR_ITERATIONS: usize = 300;

/// Residual of the static shapes, in the norm of the energy, at which the iteration ends. The
/// shapes are a basis, so that they need not be exact.
const STATIC: f64 = 1e-3;

/// The same for the corrections of shapes.
const CORRECTED: f64 = 1e-2;

impl Region<'_> {
    /// The static shape of each axis of a load on the patch with this index, and the shapes of
    /// second order of all six pairs of them: nine columns, `[node][axis][column]`. Those of second
    /// order move the region alone.
    pub(in crate::held) fn static_shapes(
        &self,
        index: usize,
        load: &NodeLoad,
        law: Hyperelastic,
    ) -> Vec<f64> {
        let nodes = self.node_count();
        let mut first = vec![0.0; 9 * nodes];
        for &(node, share) in load {
            if let Some(at) = self.local(node) {
                (0..3).for_each(|axis| first[(3 * at + axis) * 3 + axis] += share);
            }
        }
        let mut forces = field(&first, 3, 0);
        let (stiffness, iterations) = match &self.far_stiffness {
            Some(far) => (far, FAR_ITERATIONS),
            None => (&self.stiffness, MAX_ITERATIONS),
        };
        stiffness.solve(&self.free[index], &mut forces, STATIC, iterations);
        write(&forces, 3, 0, &mut first);
        let mut second = self.second_order_forces(&first, law);
        let mut forces = field(&second, 6, 0);
        self.stiffness.solve(&self.free_near[index], &mut forces, STATIC, MAX_ITERATIONS);
        write(&forces, 6, 0, &mut second);
        second.resize(18 * nodes, 0.0);
        let mut out = Vec::with_capacity(27 * nodes);
        for (a, b) in first.chunks_exact(3).zip(second.chunks_exact(6)) {
            out.extend(a);
            out.extend(b);
        }
        out
    }

    /// The stiffness of the region in a shape of columns and coordinates, positive semidefinite.
    fn stiffness_in(&self, q: &[f64], columns: &Columns, law: Hyperelastic) -> Stiffness {
        let rows = self.node_rows(columns);
        let u: Vec<f64> =
            rows.chunks_exact(q.len()).map(|row| row.iter().zip(q).map(|(u, q)| u * q).sum()).collect();
        let mut gradients = Vec::new();
        let mut h = [Matrix3::zeros()];
        for element in 0..self.elements.len() {
            self.at_points(element, &u, &mut h, |_, _, _, h| gradients.push(h[0]));
        }
        let per = tetrahedron::stiffness_points(self.kind).0.len();
        self.stiffness.with_tangents(self.kind, &self.nodes, &self.affine, |element, point| {
            positive_tangent(law, &gradients[element * per + point])
        })
    }

    /// Displacements by which a Newton step with the stiffness in the shape `at`, or at rest,
    /// corrects shapes in which the patches are held. The shapes are those of columns and
    /// coordinates; the result is `[node][axis][shape]`.
    pub(in crate::held) fn corrections(
        &self,
        loads: &[NodeLoad],
        shapes: &[GuidedShape],
        columns: &Columns,
        law: Hyperelastic,
        at: Option<&[f64]>,
    ) -> Vec<f64> {
        let tangent = at.map(|q| self.stiffness_in(q, columns, law));
        let stiffness = tangent.as_ref().unwrap_or(&self.stiffness);
        let nodes = self.near;
        let mut out = vec![0.0; 3 * nodes * shapes.len()];
        let elements: Vec<Sample> = self
            .nodes
            .iter()
            .zip(&self.affine)
            .map(|(nodes, affine)| Sample { nodes: *nodes, affine: *affine, share: 1.0 })
            .collect();
        let numbers: Vec<(u32, Option<u32>)> =
            self.numbers[..nodes].iter().zip(0..).map(|(&node, own)| (node, Some(own))).collect();
        for (group, shapes_of) in shapes.chunks(LANES).enumerate() {
            let at = Amplitudes::new(shapes_of.iter().map(|shape| &shape.q[..]), columns);
            let mut forces = zeros(nodes);
            widest(Elastic {
                mesh: self.mesh,
                kind: self.kind,
                law,
                columns,
                at: &at,
                nodes: &numbers,
                elements: &elements,
                out: &mut forces,
            });
            forces.iter_mut().flatten().for_each(|lane| *lane = -*lane);
            for (lane, shape) in shapes_of.iter().enumerate() {
                for (load, force) in loads.iter().zip(&shape.forces) {
                    for &(node, share) in load {
                        let Some(force_at) = self.local(node).and_then(|at| forces.get_mut(at)) else {
                            continue;
                        };
                        for (axis, out) in force_at.iter_mut().enumerate() {
                            out.0[lane] += share * force[axis];
                        }
                    }
                }
            }
            stiffness.solve(&self.free_for_any, &mut forces, CORRECTED, MAX_ITERATIONS);
            write(&forces, shapes.len(), group * LANES, &mut out);
        }
        out
    }

    /// The nodal forces of second order of the pairs of three shapes.
    fn second_order_forces(&self, shapes: &[f64], law: Hyperelastic) -> Vec<f64> {
        const PAIRS: [(usize, usize); 6] = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)];
        let mut out = vec![0.0; 18 * self.near];
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
}
