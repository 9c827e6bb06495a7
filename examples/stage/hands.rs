//! Draws the hands of all users.

use bevy::{math::DVec3, prelude::*};

/// Length of an arrow per newton, m/N.
const LONG: f32 = 0.012;
/// Maximum length of an arrow, m.
const LONGEST: f32 = 0.15;

/// Draws a hand at `at`, m, in the color of its user.
///
/// A ball marks the hand, a line leads to the patch that it holds, and an arrow shows the force on
/// the body, N.
pub fn draw_hand<C: GizmoConfigGroup>(
    gizmos: &mut Gizmos<C>,
    at: DVec3,
    patch: Option<DVec3>,
    pull: DVec3,
    color: Color,
) {
    let at = at.as_vec3();
    for radius in [0.012, 0.0105, 0.009] {
        gizmos.sphere(at, radius, color);
    }
    if let Some(patch) = patch {
        gizmos.line(at, patch.as_vec3(), color);
    }
    let arrow = (LONG * pull.as_vec3()).clamp_length_max(LONGEST);
    if arrow.length() > 0.01 {
        gizmos.arrow(at, at + arrow, color).with_tip_length(0.012);
    }
}
