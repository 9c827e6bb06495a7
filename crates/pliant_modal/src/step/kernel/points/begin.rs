//! The contacts that the step before left.

use nalgebra::Vector3;

use super::super::{
    group::{Group, Member, View},
    touch::look,
};
use super::{DEEP, carried, far_compliance, far_side, find, friction, friction_at, locate_at_body, rigid};
use crate::{
    StepError,
    contact::{
        Carriers, ContactPoint, ContactSites, Guess, Memory, ObstacleShape, Shape, Site, Touched, Touching,
    },
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
            let Some(mut site) = sites.sites.get(memory.site) else { continue };
            match memory.other {
                Touched::Probe(_) | Touched::Attachment(_) => {}
                Touched::Obstacle(index) => {
                    let Some(obstacle) = view.contacts.obstacles().get(index) else { continue };
                    let mut memory = *memory;
                    let leads = leader(group, member, sites, &memory, &**obstacle)?;
                    if let Some((leader, _)) = leads.filter(|(leader, _)| *leader != memory.site) {
                        // Another site of the ball takes over.
                        let same = |m: &Memory| m.other == memory.other && m.site == leader;
                        let taken = |p: &ContactPoint| {
                            p.member == member && p.other == memory.other && p.site == leader
                        };
                        if view.contacts.memory.iter().any(same) || work.points.iter().any(taken) {
                            continue;
                        }
                        (memory.site, site) = (leader, &sites.sites[leader]);
                    }
                    let place = (member, sites, leads.map(|(_, carriers)| carriers));
                    work.points.push(begin_at_obstacle(group, place, &memory, site, &**obstacle)?);
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

/// The site that leads the ball at which a contact goes on, and those that carry it. `None` for a
/// contact of one site.
fn leader<P: Member>(
    group: &Group<'_, P>,
    member: usize,
    sites: &ContactSites,
    memory: &Memory,
    obstacle: &dyn ObstacleShape,
) -> Result<Option<(usize, Carriers)>, StepError> {
    let site = &sites.sites[memory.site];
    let Some(ball) = site.ball.filter(|ball| ball.leads && memory.leads.is_some()) else { return Ok(None) };
    let kernel = group.view(member).kernel;
    let (frame, q) = (&kernel.before.frame, &kernel.before.q);
    let located = kernel.locate((sites, site), obstacle, frame, q, None)?;
    let carriers = sites.carriers(&ball, &located.wanted, memory.site);
    Ok(Some((sites.leader(&ball, &located.wanted, memory.site), carriers)))
}

fn begin_at_obstacle<P: Member>(
    group: &Group<'_, P>,
    (member, sites, leads): (usize, &ContactSites, Option<Carriers>),
    memory: &Memory,
    site: &Site,
    obstacle: &dyn ObstacleShape,
) -> Result<ContactPoint, StepError> {
    let view = group.view(member);
    let kernel = view.kernel;
    let (frame, q) = (&kernel.before.frame, &kernel.before.q);
    let at = (sites, site);
    let located = kernel.locate(at, obstacle, frame, q, leads.as_ref())?;
    let friction = friction_at(view.contacts.friction(), obstacle);
    let mut point = ContactPoint::new(member, memory.site, memory.other, friction);
    (point.first, point.last) = (memory.toward, located.toward);
    (point.start, point.tangent) = kernel.material(at, &memory.toward, frame, q, leads.as_ref());
    point.carried = carried(obstacle, &located.point, kernel.h)?;
    point.compliance = kernel.site_compliance(site, frame, q);
    if let Some(carriers) = leads {
        point.indent = kernel.indent((sites, memory.site), carriers, obstacle);
    }
    point.gap = look(obstacle, &(located.point + point.carried))?.distance;
    point.arm = located.point - Vector3::from(frame.center());
    // What sticks to a rigid body goes where that body goes.
    let stuck = obstacle.rigid().and_then(|key| rigid::find(group, key));
    let anchor = stuck.map_or(memory.anchor, |[at, _]| group.rigids[at].to_world(&memory.anchor));
    let (carried, farthest) = (point.carried, SNAPPED * kernel.model.size());
    let normal = &located.found.normal;
    resume(&mut point, memory.force, normal, anchor + carried, carried, farthest);
    if let (Some(stored), true) = (memory.leads, point.indent.is_some()) {
        // The law differs a little from place to place on a ball.
        let here = point.stored_before.max(0.0);
        point.stored_before = stored.clamp(0.5 * here, 2.0 * here);
    }
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
    point.linearize(point.pushed[0]);
    point.stored_before = point.stored(&force);
    let dent = point.dent(&force);
    point.gap += normal.dot(&dent);
    let unslipped = point.start + dent + carried;
    let slip = anchor - unslipped;
    let slipped = (slip - normal * normal.dot(&slip)).norm();
    point.anchor = if slipped.is_nan() || slipped > farthest { unslipped } else { anchor };
}
