//! Friction against the spin of a ball about the normal of its contact.

use nalgebra::Vector3;

use super::super::group::{Group, Member, View};
use crate::contact::{ObstacleShape, Touched, Touching};

/// Torque of sliding friction under the pressure of Hertz, as a share of `mu F a`: the mean
/// distance of the pressure from the middle is `3 pi / 16` of the radius `a`.
const DRILL: f64 = 3.0 * std::f64::consts::PI / 16.0;

/// Spin of an obstacle about a normal at a point, rad/s, from the velocities at the distance
/// `reach` (m).
fn spin(obstacle: &dyn ObstacleShape, point: &Vector3<f64>, sides: [Vector3<f64>; 2], reach: f64) -> f64 {
    let [a, b] = [reach, -reach].map(|reach| obstacle.velocity(&(point + reach * sides[0])));
    let spin = (a - b).dot(&sides[1]) / (2.0 * reach);
    if spin.is_finite() { spin } else { 0.0 }
}

/// Slows the spin of free bodies about the normals of balls that touch obstacles. A contact at one
/// place has no arm against it. Rigid bodies that give way are left out, as they would have to take
/// the torque.
pub(in super::super) fn drill<P: Member>(group: &mut Group<'_, P>, work: &Touching) {
    for point in &work.points {
        let (Some(indent), Touched::Obstacle(index)) = (&point.indent, point.other) else { continue };
        let view = group.view(point.member);
        let View { kernel, state, contacts, .. } = view;
        let Some(obstacle) = contacts.obstacles().get(index) else { continue };
        if point.rigid.is_some() || !view.moves() {
            continue;
        }
        let [normal, first, second] = [0, 1, 2].map(|row| point.axes.row(row).transpose());
        let circle = indent.circle(point.pushed[0]);
        let theirs = spin(&**obstacle, &point.place, [first, second], circle);
        let inertia = state.frame.inertia(&kernel.model);
        let Some(turned) = inertia.try_inverse().map(|inverse| normal.dot(&(inverse * normal))) else {
            continue;
        };
        let stops = (state.frame.angular_velocity(&kernel.model).dot(&normal) - theirs) / turned;
        let most = DRILL * point.friction * point.pushed[0] * circle * kernel.h;
        if stops.is_finite() && most > 0.0 {
            let change = -stops.clamp(-most, most);
            group.parts(point.member).state.frame.shift(Vector3::zeros(), change * normal);
        }
    }
}
