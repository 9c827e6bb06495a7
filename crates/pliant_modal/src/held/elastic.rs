//! Elastic forces on the nodes of some elements, in eight shapes at once.

use super::{columns::Columns, mesh::SimulationMesh, stiffness::zeros};
use crate::{
    Element, Hyperelastic,
    nonlinear::{LANES, Lane},
    simd::Work,
    tetrahedron::{self, Affine, MAX_NODES},
};

/// An element whose forces are summed.
pub(super) struct Sample {
    /// Its nodes.
    pub(super) nodes: [u32; MAX_NODES],
    pub(super) affine: Affine,
    /// What part of the body the element stands for, in its own volumes.
    pub(super) share: f64,
}

/// Amplitudes of columns and coordinates in up to eight shapes.
pub(super) struct Amplitudes {
    columns: Vec<Lane>,
    /// Those of the coordinates less the columns' part of them.
    modal: Vec<Lane>,
}

impl Amplitudes {
    pub(super) fn new<'a>(shapes: impl Iterator<Item = &'a [f64]>, columns: &Columns) -> Self {
        let mut out = Self { columns: vec![Lane::splat(0.0); columns.width], modal: Vec::new() };
        for (lane, shape) in shapes.take(LANES).enumerate() {
            let (s, q) = shape.split_at(columns.width);
            let mut q = q.to_vec();
            columns.less_part(s, &mut q);
            out.modal.resize(q.len(), Lane::splat(0.0));
            out.columns.iter_mut().zip(s).for_each(|(out, x)| out.0[lane] = *x);
            out.modal.iter_mut().zip(&q).for_each(|(out, x)| out.0[lane] = *x);
        }
        out
    }
}

/// Sums the elastic forces of elements at given amplitudes.
pub(super) struct Elastic<'a> {
    pub(super) mesh: &'a SimulationMesh,
    pub(super) kind: Element,
    pub(super) law: Hyperelastic,
    pub(super) columns: &'a Columns,
    pub(super) at: &'a Amplitudes,
    /// The nodes: their numbers in the mesh, and in the region where they are of it.
    pub(super) nodes: &'a [(u32, Option<u32>)],
    pub(super) elements: &'a [Sample],
    pub(super) out: &'a mut [[Lane; 3]],
}

impl Work for Elastic<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let Self { mesh, kind, law, columns, at, nodes, elements, out } = self;
        let (modes, width) = (at.modal.len(), columns.width);
        let (mut u, mut phi) = (zeros(nodes.len()), vec![0.0; 3 * modes]);
        for (u, &(node, own)) in u.iter_mut().zip(nodes) {
            mesh.coordinates(node, &mut phi);
            for (axis, (u, phi)) in u.iter_mut().zip(phi.chunks_exact(modes)).enumerate() {
                let mut sum = *u;
                for (phi, q) in phi.iter().zip(&at.modal) {
                    sum = sum.plus(*phi, *q);
                }
                if let Some(own) = own {
                    let row = &columns.values[(3 * own as usize + axis) * width..][..width];
                    for (x, s) in row.iter().zip(&at.columns) {
                        sum = sum.plus(*x, *s);
                    }
                }
                *u = sum;
            }
        }
        let (points, part) = tetrahedron::stiffness_points(kind);
        let per = kind.node_count();
        for element in elements {
            let nodes = &element.nodes[..per];
            for &point in points {
                let g = element.affine.shape_gradients(kind, point);
                let mut h = [Lane::splat(0.0); 9];
                for (&node, g) in nodes.iter().zip(&g) {
                    let u = &u[node as usize];
                    for c in 0..3 {
                        for r in 0..3 {
                            h[3 * c + r] = h[3 * c + r].plus(g[c], u[r]);
                        }
                    }
                }
                let stress = law.stresses(&h);
                let weight = part * element.share * element.affine.volume;
                for (&node, g) in nodes.iter().zip(&g) {
                    let out = &mut out[node as usize];
                    for c in 0..3 {
                        for r in 0..3 {
                            out[r] = out[r].plus(weight * g[c], stress[3 * c + r]);
                        }
                    }
                }
            }
        }
    }
}

/// Sums the generalized forces of forces on nodes: those on the columns, then on the coordinates.
pub(super) struct Generalized<'a> {
    pub(super) mesh: &'a SimulationMesh,
    pub(super) columns: &'a Columns,
    pub(super) nodes: &'a [(u32, Option<u32>)],
    pub(super) forces: &'a [[Lane; 3]],
    pub(super) out: &'a mut [Lane],
}

impl Work for Generalized<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let Self { mesh, columns, nodes, forces, out } = self;
        let width = columns.width;
        let (first, modal) = out.split_at_mut(width);
        let modes = modal.len();
        let mut phi = vec![0.0; 3 * modes];
        for (&(node, own), forces) in nodes.iter().zip(forces) {
            mesh.coordinates(node, &mut phi);
            for (axis, (force, phi)) in forces.iter().zip(phi.chunks_exact(modes)).enumerate() {
                for (out, phi) in modal.iter_mut().zip(phi) {
                    *out = out.plus(*phi, *force);
                }
                if let Some(own) = own {
                    let row = &columns.values[(3 * own as usize + axis) * width..][..width];
                    for (out, x) in first.iter_mut().zip(row) {
                        *out = out.plus(*x, *force);
                    }
                }
            }
        }
        // The columns have the coordinates' part taken out.
        for (modal, parts) in modal.iter().zip(columns.parts.chunks_exact(width)) {
            for (out, part) in first.iter_mut().zip(parts) {
                *out = out.plus(-*part, *modal);
            }
        }
    }
}

/// Adds the products of a node's displacements with the gradient of its shape function, entry
/// `3 c + r` with the derivative of component `r` along axis `c`.
pub(super) struct AddGradients<'a> {
    /// Displacements of the node, `[axis][..]`, `all` along each axis.
    pub(super) rows: &'a [f64],
    pub(super) g: &'a [f64; 3],
    pub(super) out: &'a mut [f64],
    pub(super) all: usize,
}

impl Work for AddGradients<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let Self { rows, g, out, all } = self;
        for (entry, out) in out.chunks_exact_mut(all).enumerate() {
            let (row, g) = (&rows[(entry % 3) * all..][..all], g[entry / 3]);
            out.iter_mut().zip(row).for_each(|(out, x)| *out += x * g);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Material,
        held::stiffness::{MAX_ITERATIONS, Stiffness, field, write},
        simd::widest,
    };

    /// A tetrahedron beside another one, with ten nodes each.
    fn mesh() -> SimulationMesh {
        let corners =
            vec![[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 0.9, 0.1], [0.1, 0.2, 1.1], [0.9, 0.8, 0.9]];
        let tets = vec![[0, 1, 2, 3], [1, 4, 2, 3]];
        let nodes = corners.len() + tetrahedron::connectivity(5, &tets, Element::Tet10).1.len();
        let displacements = vec![0; 3 * nodes];
        SimulationMesh {
            corners,
            tets,
            scales: vec![1.0],
            displacements,
            vertices: Vec::new(),
            stiffness: Vec::new(),
        }
    }

    #[test]
    fn small_shapes_have_the_forces_of_the_stiffness_and_those_are_solved() {
        let (mesh, kind, law) = (mesh(), Element::Tet10, Material::NeoHookean.with(2e4, 1e4));
        let (connectivity, _) = tetrahedron::connectivity(5, &mesh.tets, kind);
        let elements: Vec<Sample> = mesh
            .tets
            .iter()
            .zip(connectivity.as_chunks::<MAX_NODES>().0)
            .map(|(tet, nodes)| {
                let affine = Affine::new(tet.map(|c| mesh.corners[c as usize].map(f64::from)));
                assert!(affine.volume > 0.0);
                Sample { nodes: *nodes, affine, share: 1.0 }
            })
            .collect();
        let count = mesh.node_count();
        let [nodes, affine] = [0, 1].map(|_| elements.iter());
        let stiffness = Stiffness::new(
            kind,
            law,
            count,
            &nodes.map(|element| element.nodes).collect::<Vec<_>>(),
            &affine.map(|element| element.affine).collect::<Vec<_>>(),
        );
        let values: Vec<f64> = (0..3 * count).map(|i| ((i * 7919 + 13) % 101) as f64 / 101.0 - 0.5).collect();
        let columns = Columns { values: values.clone(), width: 1, parts: vec![0.0] };
        let size = 1e-7;
        let at = Amplitudes::new([[size, 0.0]].iter().map(|shape| &shape[..]), &columns);
        let numbers: Vec<(u32, Option<u32>)> = (0..count as u32).map(|node| (node, Some(node))).collect();
        let mut forces = zeros(count);
        let (nodes, elements) = (&numbers[..], &elements[..]);
        widest(Elastic {
            mesh: &mesh,
            kind,
            law,
            columns: &columns,
            at: &at,
            nodes,
            elements,
            out: &mut forces,
        });
        let mut want = vec![0.0; 3 * count];
        stiffness.times(&values, 1, &mut want);
        let most = want.iter().fold(0.0f64, |most, x| most.max(x.abs()));
        for (force, want) in forces.iter().flatten().zip(&want) {
            let got = force.0[0] / size;
            assert!((got - want).abs() < 1e-5 * most, "{got} and {want}");
        }
        // Three corners are held.
        let free: Vec<bool> = (0..count).map(|node| ![0, 1, 2].contains(&node)).collect();
        let held = |values: &mut Vec<f64>| {
            values.iter_mut().enumerate().filter(|(i, _)| !free[i / 3]).for_each(|(_, x)| *x = 0.0);
        };
        let mut wanted = values;
        held(&mut wanted);
        let mut forces = vec![0.0; 3 * count];
        stiffness.times(&wanted, 1, &mut forces);
        let mut solved = field(&forces, 1, 0);
        stiffness.solve(&free, &mut solved, 1e-10, MAX_ITERATIONS);
        let mut got = vec![0.0; 3 * count];
        write(&solved, 1, 0, &mut got);
        for (got, want) in got.iter().zip(&wanted) {
            assert!((got - want).abs() < 1e-6, "{got} and {want}");
        }
    }
}
