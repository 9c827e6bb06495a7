//! What stands still around a body.

use pliant_modal::{Contacts, FixedObstacle, ObstacleShape};
use serde::{Deserialize, Serialize};

use crate::StreamError;

/// What stands still around a body and what it touches there, in the axes of the body's world.
///
/// All machines of a session step a body's contacts with the same surroundings. A host sends them
/// with the body ([`HostSession::set_surroundings`](crate::HostSession::set_surroundings)), and
/// peers must have the same
/// ([`PeerSession::set_surroundings`](crate::peer::PeerSession::set_surroundings)).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Surroundings {
    /// Coefficient of friction between the body and the obstacles, 0 to
    /// [`Contacts::MAX_FRICTION`]. Default: [`Contacts::FRICTION`].
    pub friction: f64,
    /// The obstacles, at most [`Surroundings::MAX_OBSTACLES`]. Default: none.
    pub obstacles: Vec<FixedObstacle>,
}

impl Default for Surroundings {
    fn default() -> Self {
        Self { friction: Contacts::FRICTION, obstacles: Vec::new() }
    }
}

impl Surroundings {
    /// Largest number of obstacles around a body.
    pub const MAX_OBSTACLES: usize = 256;

    /// The numbers as bytes, for a digest.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        // Plain data, so serializing it to a growing buffer cannot fail.
        postcard::to_stdvec(self).unwrap_or_default()
    }

    /// Checks all numbers.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] for too many obstacles, and [`StreamError::Model`] for a
    /// friction or an obstacle out of range ([`FixedObstacle::check`](ObstacleShape::check)).
    pub fn check(&self) -> Result<(), StreamError> {
        if self.obstacles.len() > Self::MAX_OBSTACLES {
            return Err(StreamError::Full { what: "obstacles", limit: Self::MAX_OBSTACLES });
        }
        let refused = |error: pliant_modal::StepError| StreamError::Model(error.to_string());
        Contacts::default().set_friction(self.friction).map_err(refused)?;
        self.obstacles.iter().try_for_each(ObstacleShape::check).map_err(refused)
    }
}
