//! The offset of the visual rigid pose: as [`super::Blend`], for position and rotation.

use nalgebra::{UnitQuaternion, Vector3};

use super::Blend;
use crate::state::RigidState;

/// Offsets of a pose that still fade: 3 of position (m) and 3 of rotation (rotation vector, rad).
#[derive(Debug, Clone)]
pub struct PoseBlend {
    blend: Blend,
}

impl PoseBlend {
    /// Creates an empty blend whose offsets fade over `ticks` (at least 1) steps of `h` seconds.
    pub fn new(h: f64, ticks: u16) -> Self {
        Self { blend: Blend::new(h, ticks) }
    }

    /// Removes all offsets.
    pub fn clear(&mut self) {
        self.blend.clear();
    }

    /// Returns true when no offset is left, so that the visual pose equals the confirmed pose.
    pub fn is_empty(&self) -> bool {
        self.blend.is_empty()
    }

    /// Adds the offset of a correction that moved the confirmed pose from `before` to `now`. The
    /// visual pose does not jump, and the offset fades.
    pub fn add(&mut self, before: &RigidState, now: &RigidState) {
        let (Some(old), Some(new)) = (before.turn(), now.turn()) else { return };
        let turn = (old * new.inverse()).scaled_axis();
        let place = (0..3).map(|k| before.position[k] - now.position[k]).chain(turn.iter().copied());
        let speed = (0..3).map(|k| before.linear[k] - now.linear[k]);
        let speed = speed.chain((0..3).map(|k| before.angular[k] - now.angular[k]));
        self.blend.add(place, speed);
    }

    /// Ages all offsets by one tick.
    pub fn advance(&mut self) {
        self.blend.advance();
    }

    /// The visual pose for a confirmed pose.
    pub fn apply(&self, pose: &RigidState) -> RigidState {
        let Some(turn) = pose.turn().filter(|_| !self.is_empty()) else { return *pose };
        let (mut place, mut speed) = ([0.0; 6], [0.0; 6]);
        self.blend.apply(&mut place, &mut speed);
        let offset = UnitQuaternion::from_scaled_axis(Vector3::new(place[3], place[4], place[5]));
        let q = offset * turn;
        RigidState {
            position: std::array::from_fn(|k| pose.position[k] + place[k]),
            rotation: [q.i, q.j, q.k, q.w],
            linear: std::array::from_fn(|k| pose.linear[k] + speed[k]),
            angular: std::array::from_fn(|k| pose.angular[k] + speed[3 + k]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_correction_moves_nothing_at_once_and_is_gone_after_its_ticks() {
        let half = 0.5_f64.sqrt();
        let before = RigidState {
            position: [1.0, 2.0, 3.0],
            rotation: [0.0, 0.0, half, half],
            ..RigidState::default()
        };
        let now = RigidState { linear: [0.5, 0.0, 0.0], ..RigidState::default() };
        let mut blend = PoseBlend::new(0.025, 8);
        blend.add(&before, &now);
        let visual = blend.apply(&now);
        for (a, b) in
            visual.position.iter().chain(&visual.rotation).zip(before.position.iter().chain(&before.rotation))
        {
            assert!((a - b).abs() < 1e-12, "{visual:?}");
        }
        assert!(visual.linear[0].abs() < 1e-12, "velocity is continuous too: {visual:?}");
        (0..8).for_each(|_| blend.advance());
        assert_eq!(blend.apply(&now), now);
    }
}
