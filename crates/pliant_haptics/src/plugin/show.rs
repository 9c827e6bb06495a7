//! Drawing of the force on screen, for players without force feedback and for spectators.

use bevy::{math::DVec3, prelude::*};
use pliant_body::{Grab, GrabForce, PliantGizmos};

use super::{HapticTool, ToolGrabs, ToolPose};

/// Draws the position, the springs and the force of its tool.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct ForceArrow {
    /// Length of the arrow per newton, m of the world. Default: `0.05`.
    pub per_newton: f32,
    /// Maximum length of the arrow, m. Default: `0.5`.
    pub longest: f32,
    /// Radius of the ball at the tool point, m. Default: `0.008`.
    pub radius: f32,
    /// Color of the arrow. Default: red.
    pub color: Color,
    /// Color of the tool and of the lines to the held patches. Default: a warm yellow.
    pub tool: Color,
}

impl Default for ForceArrow {
    fn default() -> Self {
        Self {
            per_newton: 0.05,
            longest: 0.5,
            radius: 0.008,
            color: Color::srgb(0.85, 0.1, 0.15),
            tool: Color::srgb(1.0, 0.85, 0.25),
        }
    }
}

impl ForceArrow {
    /// Returns the arrow of the force `force` (N, device axes) on a tool turned by `rotation`. The
    /// arrow starts at the tool point and is in m of the world.
    pub fn arrow(&self, rotation: Quat, force: DVec3) -> Vec3 {
        let arrow = rotation * (force.as_vec3() * self.per_newton);
        if arrow.is_finite() { arrow.clamp_length_max(self.longest.max(0.0)) } else { Vec3::ZERO }
    }
}

pub(crate) fn draw(
    mut gizmos: Gizmos<PliantGizmos>,
    tools: Query<(&ToolPose, &GlobalTransform, &ForceArrow, Option<&ToolGrabs>), With<HapticTool>>,
    grabs: Query<&GrabForce, With<Grab>>,
) {
    for (pose, place, style, held) in &tools {
        let at = pose.position.as_vec3();
        gizmos.sphere(at, style.radius, style.tool);
        for force in grabs.iter_many(held.map_or(&[][..], ToolGrabs::entities)) {
            gizmos.line(at, force.point.as_vec3(), style.tool);
        }
        let arrow = style.arrow(place.rotation(), pose.force);
        if arrow.length() > 0.25 * style.radius {
            gizmos.arrow(at, at + arrow, style.color);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_arrow_is_turned_scaled_and_bounded() {
        let style = ForceArrow { per_newton: 0.1, longest: 0.3, ..ForceArrow::default() };
        let quarter = Quat::from_rotation_y(std::f32::consts::FRAC_PI_2);
        let arrow = style.arrow(quarter, DVec3::X);
        assert!(arrow.distance(Vec3::new(0.0, 0.0, -0.1)) < 1e-6, "{arrow}");
        assert!((style.arrow(quarter, DVec3::X * 50.0).length() - 0.3).abs() < 1e-6);
        assert_eq!(style.arrow(quarter, DVec3::NAN), Vec3::ZERO);
    }
}
