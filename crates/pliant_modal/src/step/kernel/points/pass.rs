//! Sites that pass through an obstacle or another body within one step.

use nalgebra::Vector3;

use super::super::touch::{Located, look};
use crate::{
    StepError,
    contact::{Near, ObstacleShape, Shape, Site, SurfacePoint},
};

/// Number of balls around the way of a site that moves far.
pub(super) const PARTS: u32 = 4;

/// Follows the way of a site relative to another body, and returns where it went in.
pub(super) fn pass(
    (index, site): (usize, &Site),
    [[own_start, own], [start, end]]: [[&Shape<'_>; 2]; 2],
) -> Option<(Located, Near)> {
    let (from, _) = own_start.site(index, &site.outward);
    let (to, tangent) = own.site(index, &site.outward);
    let facing = end.frame.rotation().inverse() * own.facing(index);
    let (came, went) = (start.frame.to_local(&from), end.frame.to_local(&to));
    let half = 0.5 * (went - came);
    // A site behind its body meets nothing.
    if half.dot(&facing) <= 0.0 {
        return None;
    }
    end.field.closest(&(came + half), None, half.norm() + start.bound + end.bound, None)?;
    let ways = [start.pull_back(&from), end.pull_back(&to)];
    let place = end.march(&ways[0], &ways[1], &facing)?;
    let near = end.at(&place, &to);
    let middle = to - own.frame.rotation() * (site.radius * site.outward);
    let found = SurfacePoint { distance: near.distance, normal: near.normal };
    let toward = if site.radius > 0.0 { site.outward } else { Vector3::zeros() };
    let wanted = Vector3::zeros();
    let located = Located { tangent, toward, wanted, center: own.frame.to_local(&middle), point: to, found };
    (near.distance < 0.0).then_some((located, near))
}

/// Follows a way from outside until it enters the obstacle. Returns the distance of its end to the
/// plane at that place, and the plane's normal.
pub(super) fn march(
    obstacle: &dyn ObstacleShape,
    start: &Vector3<f64>,
    way: &Vector3<f64>,
    begin: SurfacePoint,
) -> Result<Option<SurfacePoint>, StepError> {
    const STEPS: usize = 32;
    let length = way.norm();
    if length.is_nan() || length <= 0.0 || begin.distance <= 0.0 {
        return Ok(None);
    }
    let mut gone = begin.distance;
    for _ in 0..STEPS {
        if gone >= length {
            return Ok(None);
        }
        let found = look(obstacle, &(start + way * (gone / length)))?;
        if found.distance <= 1e-3 * length {
            let rest = (length - gone) / length * found.normal.dot(way);
            return Ok((rest < 0.0).then_some(SurfacePoint { distance: found.distance + rest, ..found }));
        }
        gone += found.distance;
    }
    Ok(None)
}
