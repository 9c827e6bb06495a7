//! Everybody's hands, as one sees them.

use bevy::{math::DVec3, prelude::*};

/// Metres of arrow for a newton.
const LONG: f32 = 0.012;
/// The longest arrow, m.
const LONGEST: f32 = 0.15;

/// Draws a hand at `at`, m, in its user's color: a ball, a thread to the patch that it holds, and the pull that it gives the body, N, as an arrow.
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
