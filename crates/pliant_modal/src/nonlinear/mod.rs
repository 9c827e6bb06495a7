//! Reduced nonlinear elasticity: the elastic energy for large strains in few coordinates.
//!
//! The displacement is linear in the coordinates, `u = Phi q`, and the energy is that of a
//! hyperelastic [`Material`], integrated by a rule of few points with positive weights (cubature:
//! S. S. An, T. Kim and D. L. James, *Optimizing Cubature for Efficient Integration of Subspace
//! Deformations*, ACM Trans. Graph. 27(5), 2008):
//!
//! ```text
//! U(q) = sum_p w_p W(I + sum_j G_pj q_j)
//! ```
//!
//! `G_pj` is the displacement gradient of coordinate `j` at point `p`. The rule is complete: a
//! linear remainder beside it, however small, would hold back the coordinates in which a bent body
//! shortens, and the body would bend half as far.

mod cholesky;
mod energy;
mod lanes;
mod material;
mod principal;

pub(crate) use cholesky::Cholesky;
pub use energy::ElasticEnergy;
pub(crate) use energy::Gradients;
pub(crate) use lanes::{LANES, Lane};
pub use material::{Hyperelastic, Material};
pub use principal::positive_tangent;

use crate::SimulationMesh;

/// Data of the reduced elastic energy of a model with `m` coordinates: a cubature rule of `n`
/// points.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedElasticity {
    /// Law of the material. Its moduli are those of the bake.
    pub material: Material,
    /// Weights of the points, m^3, positive, with `n` entries.
    pub weights: Vec<f64>,
    /// Displacement gradients of the coordinates at the points, `[point][3 c + r][coordinate]` with
    /// the derivative of component `r` along axis `c`, kg^-1/2 m^-1, with `9 n m` entries.
    pub gradients: Vec<f32>,
    /// Simulation mesh, from which hands get the own shapes of the patches that they hold. `None`
    /// for a model whose hands feel what the coordinates leave out as a compliance alone.
    pub mesh: Option<SimulationMesh>,
}

impl ReducedElasticity {
    /// Maximum number of points of a rule.
    pub const MAX_POINTS: usize = 65_536;

    /// Number of points of the rule.
    pub fn points(&self) -> usize {
        self.weights.len()
    }
}
