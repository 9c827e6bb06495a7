//! The contacts that the step before left.

use nalgebra::Vector3;

use super::super::{
    group::{Group, Member, View},
    touch::look,
};
use super::{DEEP, carried, far_compliance, far_side, find, friction, locate_at_body, rigid};
use crate::{
    StepError,
    contact::{ContactPoint, Guess, Memory, ObstacleShape, Shape, Site, Touched, Touching},
};

/// Farthest distance of a site's surface from its anchor, as a share of the body's size. Beyond it
/// the body was moved from elsewhere.
pub(super) const SNAPPED: f64 = 0.02;

/// Sets up the contacts that the step before left.
pub(in super::super) fn begin<P: Member>(group: &Group<'_, P>, work: &mut Touching) -> Result<(), StepError> {
    work.points.clear();
    for member in 0..group.who.len() {
        let view = group.view(member);
        let Some(sites) = view.sites() else { continue };
        for memory in &view.contacts.memory {
            let Some(site) = sites.sites.get(memory.site) else { continue };
            match memory.other {
                Touched::Probe(_) => {}
                Touched::Obstacle(index) => {
                    let Some(obstacle) = view.contacts.obstacles().get(index) else { continue };
                    work.points.push(begin_at_obstacle(group, member, memory, site, &**obstacle)?);
                }
                Touched::Body(key) => {
                    let Some(other) = find(group, key) else { continue };
                    let far = group.view(other);
                    let (Some([own, _]), Some([shape, _])) = (group.shapes(member), group.shapes(other))
                    else {
                        continue;
                    };
                    let (members, views) = ([member, other], [&view, &far]);
                    work.points.extend(begin_at_body(members, views, [&own, &shape], memory, site));
                }
            }
        }
    }
    Ok(())
}

fn begin_at_obstacle<P: Member>(
    group: &Group<'_, P>,
    member: usize,
    memory: &Memory,
    site: &Site,
    obstacle: &dyn ObstacleShape,
) -> Result<ContactPoint, StepError> {
    let view = group.view(member);
    let kernel = view.kernel;
    let (frame, q) = (&kernel.before.frame, &kernel.before.q);
    let located = kernel.locate(site, obstacle, frame, q)?;
    let mut point = ContactPoint::new(member, memory.site, memory.other, view.contacts.friction());
    (point.first, point.last) = (memory.toward, located.toward);
    (point.start, point.tangent) = kernel.material(site, &memory.toward, frame, q);
    point.carried = carried(obstacle, &located.point, kernel.h)?;
    point.compliance = kernel.site_compliance(site, frame, q);
    point.gap = look(obstacle, &(located.point + point.carried))?.distance;
    point.arm = located.point - Vector3::from(frame.center());
    // What sticks to a rigid body goes where that body goes.
    let stuck = obstacle.rigid().and_then(|key| rigid::find(group, key));
    let anchor = stuck.map_or(memory.anchor, |[at, _]| group.rigids[at].to_world(&memory.anchor));
    let (carried, farthest) = (point.carried, SNAPPED * kernel.model.size());
    let normal = &located.found.normal;
    resume(&mut point, memory.force, normal, anchor + carried, carried, farthest);
    point.rigid = rigid::side(group, obstacle, &point, point.carried);
    Ok(point)
}

fn begin_at_body(
    [member, other]: [usize; 2],
    [view, far]: [&View<'_>; 2],
    [own, shape]: [&Shape<'_>; 2],
    memory: &Memory,
    site: &Site,
) -> Option<ContactPoint> {
    let (kernel, sites) = (view.kernel, far.sites()?);
    let (frame, q) = (&kernel.before.frame, &kernel.before.q);
    let size = kernel.model.size().min(far.kernel.model.size());
    let (located, near) =
        locate_at_body((own, memory.site, site), shape, DEEP * size, memory.place.as_ref(), Guess::None)
            .ok()?;
    let mut point = ContactPoint::new(member, memory.site, memory.other, friction(view, far));
    (point.first, point.last) = (memory.toward, located.toward);
    (point.start, point.tangent) = own.site(memory.site, &memory.toward);
    let mut side = far_side(other, &near, shape);
    side.compliance = far_compliance(far, sites, &far.kernel.before, &side);
    let velocities = Vector3::from(frame.velocity()) + Vector3::from(shape.frame.velocity());
    side.middle = 0.5 * (located.point + side.start) + 0.25 * kernel.h * velocities;
    point.place = located.point;
    side.anchor = side.start + shape.frame.rotation() * (memory.anchor - shape.field.rest(&near.place));
    point.compliance = kernel.site_compliance(site, frame, q) + side.compliance;
    let anchor = side.anchor;
    point.far = Some(side);
    point.gap = near.distance;
    let carried = point.carried;
    resume(&mut point, memory.force, &near.normal, anchor, carried, SNAPPED * size);
    if let Some(far) = &mut point.far {
        far.anchor = point.anchor;
    }
    Some(point)
}

/// Gives a contact the force and the anchor of the step before, and opens its gap by the dent of
/// the force. `carried` leads from the contact's start to where the anchor counts. An anchor that
/// is farther from there than `farthest` (m) is given up.
pub(super) fn resume(
    point: &mut ContactPoint,
    force: Vector3<f64>,
    normal: &Vector3<f64>,
    anchor: Vector3<f64>,
    carried: Vector3<f64>,
    farthest: f64,
) {
    point.before = force;
    point.turn(normal);
    point.pushed = point.axes * force;
    point.force = point.pushed;
    point.stored_before = point.stored(&force);
    let dent = point.compliance * force;
    point.gap += normal.dot(&dent);
    let unslipped = point.start + dent + carried;
    let slip = anchor - unslipped;
    let slipped = (slip - normal * normal.dot(&slip)).norm();
    point.anchor = if slipped.is_nan() || slipped > farthest { unslipped } else { anchor };
}
