//! Three equal peers over bad paths: they agree on one shape, apply their own hands at once and
//! correct all errors.

mod agreement;
mod compensation;
mod inputs;
mod joining;
mod mesh;
mod messages;
mod repair;

use crate::support;

use std::time::Duration;

use pliant_modal::FixedObstacle;
use pliant_stream::{BodyId, Surroundings};

const BODY: BodyId = BodyId(1);
const OTHER: BodyId = BodyId(2);
const S: Duration = Duration::from_secs(1);
const MS: Duration = Duration::from_millis(1);

/// The ground, 4 cm below the bars.
fn floor() -> Surroundings {
    let ground = FixedObstacle { position: [0.0, -0.12, 0.0], ..FixedObstacle::GROUND };
    Surroundings { obstacles: vec![ground], ..Surroundings::default() }
}
