//! Static solutions with `K^-1`, or with the inertia-relief pseudo-inverse for a free body.

use crate::blocks::{self, Tall};
use crate::factor::{Factor, NotPositive};
use crate::rigid;
use crate::sparse::BlockCsr;
use crate::symbolic::Symbolic;

/// Rigid modes of a free body, M-orthonormal, and their images under M, as blocks of six columns.
#[derive(Clone, Debug)]
pub(crate) struct Rigid {
    pub(crate) modes: Vec<f64>,
    pub(crate) mass_times_modes: Vec<f64>,
}

/// Factored stiffness and rigid modes for static solutions.
///
/// Six springs hold a free body at a statically determinate set of degrees of freedom. A load in
/// equilibrium puts no force on these springs, so its solution is exact up to a rigid motion: with
/// `P = I - R R^T M`, `K^+ = P (K + springs)^-1 P^T`.
#[derive(Clone, Debug)]
pub(crate) struct Solver<'a> {
    pub(crate) matrix: &'a BlockCsr,
    pub(crate) factor: Factor,
    pub(crate) rigid: Option<Rigid>,
}

impl<'a> Solver<'a> {
    /// Factors the matrix. `rigid_modes` holds six M-orthonormal columns for a free body.
    pub(crate) fn new(
        matrix: &'a BlockCsr,
        symbolic: Symbolic,
        rigid_modes: Option<Vec<f64>>,
    ) -> Result<Self, NotPositive> {
        let mut springs = Vec::new();
        let rigid = rigid_modes.map(|modes| {
            for dof in rigid::statically_determinate_dofs(&modes) {
                let (node, axis) = (dof / 3, dof % 3);
                let at = matrix.position(node as u32, node as u32);
                springs.push((dof, matrix.stiffness[9 * at + 4 * axis]));
            }
            let mut mass_times_modes = vec![0.0; modes.len()];
            matrix.mass_times(&modes, 6, &mut mass_times_modes);
            Rigid { modes, mass_times_modes }
        });
        let factor = Factor::new(symbolic, matrix, &springs)?;
        Ok(Self { matrix, factor, rigid })
    }

    /// Returns the number of degrees of freedom.
    pub(crate) fn dofs(&self) -> usize {
        self.matrix.dofs()
    }

    /// Removes the rigid motion from displacements: `P x = x - R (M R)^T x`.
    pub(crate) fn remove_rigid(&self, x: &mut [f64], width: usize) {
        if let Some(rigid) = &self.rigid {
            let along = blocks::gram(Tall::new(&rigid.mass_times_modes, 6), Tall::new(x, width));
            blocks::add_product(x, Tall::new(&rigid.modes, 6), along.as_ref(), -1.0);
        }
    }

    /// Balances loads with the inertia of the rigid acceleration that they cause:
    /// `P^T f = f - M R R^T f`.
    pub(crate) fn balance(&self, f: &mut [f64], width: usize) {
        if let Some(rigid) = &self.rigid {
            let along = blocks::gram(Tall::new(&rigid.modes, 6), Tall::new(f, width));
            blocks::add_product(f, Tall::new(&rigid.mass_times_modes, 6), along.as_ref(), -1.0);
        }
    }

    /// Replaces loads by displacements: `K^-1 f`, or `K^+ f` for a free body.
    pub(crate) fn solve(&self, f: &mut [f64], width: usize) {
        self.balance(f, width);
        self.factor.solve(f, width);
        self.remove_rigid(f, width);
    }

    /// Returns `K^-1 M x`.
    pub(crate) fn operator(&self, x: &[f64], width: usize) -> Vec<f64> {
        let mut out = vec![0.0; x.len()];
        self.matrix.mass_times(x, width, &mut out);
        self.solve(&mut out, width);
        out
    }
}
