//! What stands still around a body, for the guests.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{Body, FixedObstacle, ObstacleShape};
use pliant_stream::Surroundings;

/// Shortest interval between two times at which obstacles are added. Each change restarts the
/// streams of the body.
const ADD_EVERY: Duration = Duration::from_millis(250);

/// Follows the obstacles that a body has near it.
///
/// The body has only those that are near, and guests keep those that it had before, so that a body
/// that rolls through a level restarts its streams only for what is new. What moves is no part of
/// it: its contacts reach the guests as a load.
#[derive(Debug, Default)]
pub(super) struct KnownSurroundings {
    around: Surroundings,
    /// The obstacles of the body at the last look.
    seen: Vec<Arc<dyn ObstacleShape>>,
    /// Whether an obstacle waits to be added, and since when one may be.
    waits: bool,
    added: Option<Duration>,
}

impl KnownSurroundings {
    /// Looks at a body after a step. Returns what the guests must know now, if it has changed.
    pub(super) fn look(&mut self, now: Duration, body: &Body) -> Option<&Surroundings> {
        let (obstacles, friction) = (body.contacts().obstacles(), body.contacts().friction());
        let same = obstacles.len() == self.seen.len()
            && obstacles.iter().zip(&self.seen).all(|(a, b)| Arc::ptr_eq(a, b))
            && friction.to_bits() == self.around.friction.to_bits();
        if !body.model().is_free() || (same && !self.waits) {
            return None;
        }
        self.seen.clear();
        self.seen.extend(obstacles.iter().cloned());
        let near: Vec<FixedObstacle> =
            obstacles.iter().filter_map(|o| o.fixed()).filter(|o| o.check().is_ok()).collect();
        let known = &mut self.around.obstacles;
        let center = body.frame().center().into();
        let (size, before) = (body.model().size(), known.len());
        // What is that near and is not among the body's obstacles is not there any more.
        known.retain(|o| near.contains(o) || o.at(&center).distance > size);
        let mut changed = known.len() != before || friction.to_bits() != self.around.friction.to_bits();
        self.around.friction = friction;
        let known = &mut self.around.obstacles;
        self.waits = near.iter().any(|o| !known.contains(o));
        if self.waits && self.added.is_none_or(|added| now.saturating_sub(added) >= ADD_EVERY) {
            let before = known.clone();
            for obstacle in near {
                if !known.contains(&obstacle) {
                    known.push(obstacle);
                }
            }
            if known.len() > Surroundings::MAX_OBSTACLES {
                let distance = |o: &FixedObstacle| o.at(&center).distance;
                known.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
                known.truncate(Surroundings::MAX_OBSTACLES);
            }
            // Where there is no room for all, a new one may be too far away, and the same ones in
            // another order are nothing new.
            if known.iter().all(|o| before.contains(o)) {
                *known = before;
            } else {
                changed = true;
            }
            (self.waits, self.added) = (false, Some(now));
        }
        changed.then_some(&self.around)
    }
}

#[cfg(test)]
mod tests {
    use pliant_modal::{BodyConfig, FixedShape, ModalModel, Moving, Plane, Sphere};

    use super::*;

    fn body() -> Body {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/jack.modal");
        Body::new(Arc::new(ModalModel::read(path).unwrap()), BodyConfig::default()).unwrap()
    }

    fn ball(x: f64) -> Arc<dyn ObstacleShape> {
        Arc::new(Sphere { center: [x, 0.0, 0.0], radius: 0.1 })
    }

    #[test]
    fn guests_keep_what_is_left_behind_and_lose_what_is_gone_or_moves() {
        let (mut body, mut known) = (body(), KnownSurroundings::default());
        let size = body.model().size();
        let floor: Arc<dyn ObstacleShape> =
            Arc::new(Plane { point: [0.0, -9.0 * size, 0.0], ..Plane::GROUND });
        let at = Duration::from_millis;
        assert!(known.look(at(0), &body).is_none(), "it has no obstacles yet");
        body.set_obstacles(vec![floor.clone(), ball(size)]).unwrap();
        assert_eq!(known.look(at(10), &body).map(|around| around.obstacles.len()), Some(2));
        assert!(known.look(at(20), &body).is_none(), "nothing has changed");

        // It goes away from the ball, which is no longer near, and comes back.
        body.set_pose([40.0 * size, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).unwrap();
        body.set_obstacles(vec![floor.clone()]).unwrap();
        assert!(known.look(at(300), &body).is_none(), "the ball may still be there");
        body.set_pose([0.0; 3], [0.0, 0.0, 0.0, 1.0]).unwrap();
        body.set_obstacles(vec![floor.clone(), ball(size)]).unwrap();
        assert!(known.look(at(600), &body).is_none());

        // The ball begins to move, and rests elsewhere.
        let moves = Moving {
            shape: Sphere { center: [0.0; 3], radius: 0.1 },
            position: [size, 0.0, 0.0],
            rotation: [0.0, 0.0, 0.0, 1.0],
            velocity: [0.1, 0.0, 0.0],
            angular_velocity: [0.0; 3],
        };
        body.set_obstacles(vec![floor.clone(), Arc::new(moves)]).unwrap();
        let around = known.look(at(610), &body).unwrap();
        assert!(around.obstacles.iter().all(|o| o.shape == FixedShape::Plane), "{around:?}");
        body.set_obstacles(vec![floor.clone(), ball(1.1 * size)]).unwrap();
        assert_eq!(known.look(at(620), &body).map(|around| around.obstacles.len()), Some(2));
        body.set_obstacles(vec![floor, ball(1.2 * size)]).unwrap();
        assert_eq!(known.look(at(630), &body).map(|around| around.obstacles.len()), Some(1));
        assert!(known.look(at(640), &body).is_none(), "a new one waits, because each restarts the streams");
        assert_eq!(known.look(at(871), &body).map(|around| around.obstacles.len()), Some(2));
        body.set_friction(0.2).unwrap();
        assert_eq!(known.look(at(872), &body).map(|around| around.friction), Some(0.2));
    }

    #[test]
    fn a_thousand_obstacles_are_the_nearest_256() {
        let (mut body, mut known) = (body(), KnownSurroundings::default());
        body.set_obstacles((0..1000).rev().map(|k| ball(f64::from(k))).collect()).unwrap();
        let around = known.look(Duration::ZERO, &body).unwrap();
        around.check().unwrap();
        assert_eq!(around.obstacles.len(), 256);
        assert!(around.obstacles.iter().all(|o| o.position[0] < 256.5));
        assert!(known.look(Duration::from_secs(1), &body).is_none());
    }

    #[test]
    fn the_nearest_256_in_another_order_restart_no_streams() {
        let (mut body, mut known) = (body(), KnownSurroundings::default());
        let fixed: Vec<_> = (0..1000).map(|k| ball(f64::from(k - 500))).collect();
        let mut restarts = Vec::new();
        for tick in 0..400_u32 {
            // Something that moves is another obstacle in each tick, and the body sways between
            // two of those that stand still, so that now the one and now the other is nearer.
            let x = f64::from(tick % 5) * 0.2 + 0.1;
            body.set_pose([x, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).unwrap();
            let moves = Moving {
                shape: Sphere { center: [0.0; 3], radius: 0.1 },
                position: [0.0, 9.0, 0.0],
                rotation: [0.0, 0.0, 0.0, 1.0],
                velocity: [0.1, 0.0, 0.0],
                angular_velocity: [0.0; 3],
            };
            let mut all = fixed.clone();
            all.push(Arc::new(moves));
            body.set_obstacles(all).unwrap();
            let at = Duration::from_millis(10) * tick;
            restarts.extend(known.look(at, &body).map(|around| (tick, around.obstacles.len())));
        }
        assert_eq!(restarts, [(0, 256)], "in four seconds");
    }
}
