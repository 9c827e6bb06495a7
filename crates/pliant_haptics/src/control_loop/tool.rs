//! The tool: the representation of the device's handle in the world.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// Mapping of the device's workspace to the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolMap {
    /// Position of the workspace's center, m, world axes.
    pub origin: [f64; 3],
    /// Rotation from device to world axes, unit quaternion x, y, z, w.
    pub rotation: [f64; 4],
    /// World meters per meter of the hand, above 0.
    pub motion_scale: f64,
    /// Additional scale of the force at the hand, beyond the motion scale, 0 or more. At 1 the hand
    /// does the same work as the tool does in the world.
    pub force_scale: f64,
    /// Force axes that the hand gets, device axes.
    pub force_axes: [bool; 3],
    /// Torque axes that the hand gets, device axes.
    pub torque_axes: [bool; 3],
    /// Mass of the tool at the hand, kg. Its weight pulls down (-y of the device). Default: 0.
    pub mass: f64,
    /// Buttons (as bits) that detach the tool from the hand while they are down. The hand moves and
    /// the tool stays. Default: 0, none.
    pub clutch: u32,
}

impl Default for ToolMap {
    fn default() -> Self {
        Self {
            origin: [0.0; 3],
            rotation: [0.0, 0.0, 0.0, 1.0],
            motion_scale: 1.0,
            force_scale: 1.0,
            force_axes: [true; 3],
            torque_axes: [true; 3],
            mass: 0.0,
            clutch: 0,
        }
    }
}

impl ToolMap {
    /// Returns whether all numbers are finite and in range.
    pub fn is_valid(&self) -> bool {
        let finite = self.origin.iter().chain(&self.rotation).all(|x| x.is_finite());
        let length: f64 = self.rotation.iter().map(|x| x * x).sum();
        finite
            && length > 1e-12
            && self.motion_scale.is_finite()
            && self.motion_scale > 0.0
            && self.force_scale.is_finite()
            && self.force_scale >= 0.0
            && self.mass.is_finite()
            && self.mass >= 0.0
    }
}

/// Standard gravity, m/s^2.
const GRAVITY: f64 = 9.806_65;

/// The moving tool: the map, the origin as shifted by the clutch, and the resulting pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tool {
    map: ToolMap,
    rotation: UnitQuaternion<f64>,
    origin: Vector3<f64>,
    /// Orientation offset between the hand and the tool that the clutch has left.
    grip: UnitQuaternion<f64>,
    pub(crate) position: Vector3<f64>,
    pub(crate) velocity: Vector3<f64>,
    pub(crate) orientation: UnitQuaternion<f64>,
    clutched: bool,
}

impl Tool {
    pub(crate) fn new(map: ToolMap) -> Self {
        let mut tool = Self {
            map: ToolMap::default(),
            rotation: UnitQuaternion::identity(),
            origin: Vector3::zeros(),
            grip: UnitQuaternion::identity(),
            position: Vector3::zeros(),
            velocity: Vector3::zeros(),
            orientation: UnitQuaternion::identity(),
            clutched: false,
        };
        tool.set_map(map);
        tool
    }

    /// Sets the map. An invalid map is refused, and the old map stays.
    pub(crate) fn set_map(&mut self, map: ToolMap) -> bool {
        if !map.is_valid() {
            return false;
        }
        let [x, y, z, w] = map.rotation;
        self.rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        self.origin = map.origin.into();
        self.map = map;
        true
    }

    /// Updates the tool from the hand's pose. With `hold` the tool stays where it is whatever the
    /// hand does (a jump of the measurement).
    pub(crate) fn update(
        &mut self,
        position: Vector3<f64>,
        velocity: Vector3<f64>,
        orientation: UnitQuaternion<f64>,
        buttons: u32,
        hold: bool,
    ) {
        let moved = self.rotation * position * self.map.motion_scale;
        let turned = self.rotation * orientation * self.rotation.inverse();
        self.clutched = buttons & self.map.clutch != 0;
        if self.clutched || hold {
            self.origin = self.position - moved;
            self.grip = turned.inverse() * self.orientation;
            self.velocity = Vector3::zeros();
            return;
        }
        self.position = self.origin + moved;
        self.orientation = turned * self.grip;
        self.velocity = self.rotation * velocity * self.map.motion_scale;
    }

    pub(crate) fn is_clutched(&self) -> bool {
        self.clutched
    }

    /// Converts a world force to a device force. The force does the same work (times the force
    /// scale) for the same motion.
    pub(crate) fn force_to_hand(&self, force: Vector3<f64>) -> Vector3<f64> {
        let f = self.rotation.inverse() * force * (self.map.motion_scale * self.map.force_scale);
        masked(f, self.map.force_axes)
    }

    pub(crate) fn torque_to_hand(&self, torque: Vector3<f64>) -> Vector3<f64> {
        // Angles are not scaled, so the torque does the same work without the motion scale.
        masked(self.rotation.inverse() * torque * self.map.force_scale, self.map.torque_axes)
    }

    pub(crate) fn weight(&self) -> Vector3<f64> {
        masked(Vector3::new(0.0, -GRAVITY * self.map.mass, 0.0), self.map.force_axes)
    }

    /// Factor from world energy to energy at the hand.
    pub(crate) fn energy_scale(&self) -> f64 {
        self.map.motion_scale * self.map.motion_scale * self.map.force_scale
    }
}

pub(crate) fn masked(v: Vector3<f64>, axes: [bool; 3]) -> Vector3<f64> {
    Vector3::from_fn(|i, _| if axes[i] { v[i] } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn still(tool: &mut Tool, p: [f64; 3], buttons: u32) -> [f64; 3] {
        tool.update(p.into(), Vector3::zeros(), UnitQuaternion::identity(), buttons, false);
        tool.position.into()
    }

    #[test]
    fn scale_keeps_work_and_clutch_keeps_place() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        // With a quarter turn about y, the device's x axis is the world's -z axis.
        let map = ToolMap {
            origin: [1.0, 2.0, 3.0],
            rotation: [0.0, half, 0.0, half],
            motion_scale: 4.0,
            clutch: 2,
            ..ToolMap::default()
        };
        let mut tool = Tool::new(map);
        let p = still(&mut tool, [0.1, 0.0, 0.0], 0);
        for (got, want) in p.into_iter().zip([1.0, 2.0, 2.6]) {
            assert!((got - want).abs() < 1e-12, "{p:?}");
        }
        // The work is the same: 5 N along -z over 0.4 m in the world is 20 N along x over 0.1 m at
        // the hand.
        let f = tool.force_to_hand(Vector3::new(0.0, 0.0, -5.0));
        assert!((f - Vector3::new(20.0, 0.0, 0.0)).norm() < 1e-12, "{f}");
        // While clutched, the hand moves back and the tool stays. After the release, the tool
        // continues from its position.
        assert_eq!(still(&mut tool, [0.1, 0.0, 0.0], 2), p);
        assert_eq!(still(&mut tool, [0.0, 0.0, 0.0], 2), p);
        let q = still(&mut tool, [0.1, 0.0, 0.0], 0);
        assert!((q[2] - 2.2).abs() < 1e-12, "{q:?}");
        // An invalid map is refused.
        assert!(!tool.set_map(ToolMap { motion_scale: f64::NAN, ..map }));
        assert_eq!(tool.map.motion_scale, 4.0);
    }
}
