//! Signed distance fields as assets.

use std::sync::Arc;

use bevy::prelude::*;
use pliant_modal as modal;

/// A solid that is given by its signed distance at the nodes of a grid, for
/// [`Obstacle::Field`](crate::Obstacle::Field).
///
/// To find where a body touches it takes the same time whatever the solid's shape is: a terrain, a
/// cave or a scanned statue is as fast as a few boxes. What it costs is memory, 4 bytes a node, and
/// the time to sample it, which is best spent on another thread or in a tool.
///
/// ```
/// # use pliant_contact::DistanceField;
/// # use pliant_modal as modal;
/// // Two balls that melt into each other, sampled every 2 cm.
/// let ball = |p: [f64; 3], x: f64| ((p[0] - x).powi(2) + p[1] * p[1] + p[2] * p[2]).sqrt() - 0.3;
/// let both = |p| -0.05 * ((-ball(p, -0.2) / 0.05).exp() + (-ball(p, 0.2) / 0.05).exp()).ln();
/// let field = modal::DistanceGrid::sample([[-0.6, -0.4, -0.4], [0.6, 0.4, 0.4]], 0.02, both)?;
/// let field = DistanceField::new(field);
/// # Ok::<(), modal::StepError>(())
/// ```
#[derive(Asset, Reflect, Debug, Clone)]
#[reflect(opaque)]
#[reflect(Debug, Clone)]
pub struct DistanceField(Arc<modal::DistanceGrid>);

impl DistanceField {
    /// Makes an asset of a field, whose lengths are those of the obstacle's entity.
    pub fn new(field: modal::DistanceGrid) -> Self {
        Self(Arc::new(field))
    }

    /// Samples the distance to the triangles of a closed mesh every `cell` (m). What is solid is
    /// what it is for [`Obstacle::Mesh`](crate::Obstacle::Mesh). A terrain is better sampled from
    /// the function of its height.
    ///
    /// # Errors
    /// Returns the error of a mesh that is open or cannot be an obstacle, and of a cell that gives
    /// more than 2^26 nodes.
    #[cfg(feature = "mesh")]
    pub fn of_mesh(mesh: &Mesh, cell: f32) -> Result<Self, modal::StepError> {
        use bevy::math::DVec3;
        use modal::ObstacleShape;

        let source = crate::mesh::Source::new(mesh, false)?;
        let solid = crate::mesh::Solid::new(&source, DVec3::ONE)?;
        if !solid.closed {
            let (what, expected) = ("mesh of a distance field", "triangles that enclose a solid");
            return Err(modal::StepError::Input { what, expected, got: f64::NAN });
        }
        let corners = source.positions.iter().map(|p| Vec3::from(*p).as_dvec3());
        let bounds =
            corners.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], p| [low.min(p), high.max(p)]);
        let distance = |p: [f64; 3]| solid.at(&p.into()).distance;
        modal::DistanceGrid::sample(bounds.map(|corner| corner.to_array()), cell.into(), distance)
            .map(Self::new)
    }

    /// The field.
    pub fn field(&self) -> &modal::DistanceGrid {
        &self.0
    }

    pub(crate) fn shape(&self) -> Arc<dyn modal::ObstacleShape> {
        self.0.clone()
    }
}
