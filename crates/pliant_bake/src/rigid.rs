//! Mass properties and the six rigid modes.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use crate::fem::FeMesh;
use pliant_modal::tetrahedron::cross;

/// Mass, center of mass and inertia of the body at rest.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MassProperties {
    /// Mass, kg.
    pub(crate) mass: f64,
    /// Center of mass, m.
    pub(crate) center: [f64; 3],
    /// Inertia about the center of mass, kg m^2.
    pub(crate) inertia: [[f64; 3]; 3],
}

impl MassProperties {
    /// Computes the mass properties, exactly for the tetrahedra.
    ///
    /// The second moments of a tetrahedron of volume V are `int x_k x_l = V/20 (sum_a x_ak x_al +
    /// sum_a x_ak sum_b x_bl)`.
    pub(crate) fn new(mesh: &FeMesh, density: f64) -> Self {
        let volume: f64 = (0..mesh.affine.len()).map(|index| mesh.filled_volume(index)).sum();
        let mut first = [0.0; 3];
        for (index, nodes) in mesh.elements().enumerate() {
            for (k, first) in first.iter_mut().enumerate() {
                let sum: f64 = nodes[..4].iter().map(|&n| mesh.nodes[n as usize][k]).sum();
                *first += mesh.filled_volume(index) * sum / 4.0;
            }
        }
        let center = first.map(|x| x / volume);
        let mut second = Matrix3::zeros();
        for (index, nodes) in mesh.elements().enumerate() {
            let corners =
                [0, 1, 2, 3].map(|a| Vector3::from(mesh.nodes[nodes[a] as usize]) - Vector3::from(center));
            let sum: Vector3<f64> = corners.iter().sum();
            let mut moment = sum * sum.transpose();
            for corner in corners {
                moment += corner * corner.transpose();
            }
            second += moment * (mesh.filled_volume(index) / 20.0);
        }
        let inertia = (Matrix3::identity() * second.trace() - second) * density;
        Self {
            mass: density * volume,
            center,
            inertia: [0, 1, 2].map(|i| [0, 1, 2].map(|j| 0.5 * (inertia[(i, j)] + inertia[(j, i)]))),
        }
    }

    /// Returns the six mass-normalized rigid modes at `positions` as a block of six columns.
    ///
    /// The first three columns are translations. The last three are rotations about the principal
    /// axes through the center of mass.
    pub(crate) fn rigid_modes(&self, positions: impl ExactSizeIterator<Item = [f64; 3]>) -> Vec<f64> {
        let inertia = Matrix3::from_fn(|i, j| self.inertia[i][j]);
        let principal = SymmetricEigen::new(inertia);
        let translation = 1.0 / self.mass.sqrt();
        let mut out = Vec::with_capacity(18 * positions.len());
        for p in positions {
            let arm = [0, 1, 2].map(|k| p[k] - self.center[k]);
            let turns = [0, 1, 2].map(|r| {
                let axis: [f64; 3] = principal.eigenvectors.column(r).into_owned().into();
                cross(axis, arm).map(|x| x / principal.eigenvalues[r].sqrt())
            });
            for k in 0..3 {
                out.extend((0..3).map(|l| if k == l { translation } else { 0.0 }));
                out.extend(turns.map(|turn| turn[k]));
            }
        }
        out
    }
}

/// Selects six degrees of freedom that hold a rigid body without stress.
///
/// Pivoted Gram-Schmidt selects rows of the rigid modes, so that they are as independent as the
/// body allows.
pub(crate) fn statically_determinate_dofs(modes: &[f64]) -> [usize; 6] {
    let mut rows: Vec<[f64; 6]> =
        modes.chunks_exact(6).map(|row| [0, 1, 2, 3, 4, 5].map(|r| row[r])).collect();
    let mut out = [0; 6];
    for chosen in &mut out {
        let norm2 = |row: &[f64; 6]| row.iter().map(|x| x * x).sum::<f64>();
        let (mut best, mut most) = (0, -1.0);
        for (dof, row) in rows.iter().enumerate() {
            let candidate = norm2(row);
            if candidate > most {
                (best, most) = (dof, candidate);
            }
        }
        *chosen = best;
        let pivot = rows[best].map(|x| x / most.sqrt().max(f64::MIN_POSITIVE));
        for row in &mut rows {
            let along: f64 = row.iter().zip(&pivot).map(|(a, b)| a * b).sum();
            for (x, p) in row.iter_mut().zip(&pivot) {
                *x -= along * p;
            }
        }
        rows[best] = [0.0; 6];
    }
    out
}
