//! Where probes touch bodies and rigid obstacles.

use nalgebra::{Matrix3, Vector3};

use super::super::{
    group::{Group, Member, View},
    touch::look,
};
use super::{
    RECOVERY_SPEED,
    begin::{SNAPPED, resume},
    carried, carrier_compliance, find, floor, friction_at,
    pass::march,
    share,
};
use crate::{
    ProbeContact, StepError,
    contact::{AtProbe, Carriers, ContactPoint, Grown, Near, Place, ProbeMemory, Shape, Touched, Touching},
    step::Tangent,
};

/// Way in a step, as a share of the ball's radius, beyond which the ball meets the plane of the
/// place that it had, and not the place that is nearest after the way.
const FAR: f64 = 0.5;

/// Depth of a ball's center inside a body down to which it is pushed out, as a share of the body's
/// size.
const DEEP: f64 = 0.1;

/// How far from a ball's center the nearest place of a body is searched, m.
fn reach(radius: f64, size: f64) -> f64 {
    (2.0 * radius).max(DEEP * size)
}

/// Whether the ball has gone far in this step.
fn is_far(probe: &crate::Probe) -> bool {
    // Comparisons with no number are false.
    (probe.position - probe.start).norm() > FAR * probe.config().radius
}

/// The plane of a surface to which the nearest place of a body belongs.
fn plane_of(near: &Near, center: &Vector3<f64>) -> [Vector3<f64>; 2] {
    [center - near.distance * near.normal, near.normal]
}

/// Sets up the contacts of probes that the step before left.
pub(in super::super) fn begin_probes<P: Member>(
    group: &Group<'_, P>,
    work: &mut Touching,
) -> Result<(), StepError> {
    for (number, &index) in group.held.iter().enumerate() {
        let (probe, span) = (&group.probes[index], group.len() + number);
        let friction = probe.config().friction;
        for memory in &probe.memory {
            let point = match memory.other {
                Touched::Obstacle(at) => {
                    let Some(obstacle) = probe.obstacles().get(at) else { continue };
                    let found = look(&**obstacle, &probe.start)?;
                    let friction = friction_at(friction, &**obstacle);
                    let mut point = ContactPoint::new(span, at, memory.other, friction);
                    point.carried = carried(&**obstacle, &probe.start, group.h)?;
                    point.start = probe.start;
                    point.compliance = probe.rigid();
                    let plane = [probe.start - found.distance * found.normal, found.normal];
                    point.probe = Some(AtProbe { probe: index, span, first: None, last: None, plane });
                    point.gap = look(&**obstacle, &(probe.start + point.carried))?.distance;
                    point.gap -= probe.config().radius;
                    let carried = point.carried;
                    let anchor = memory.anchor + carried;
                    resume(&mut point, memory.force, &found.normal, anchor, carried, f64::INFINITY);
                    point
                }
                Touched::Body(key) => {
                    let Some(member) = find(group, key) else { continue };
                    let view = group.view(member);
                    let (Some([shape, _]), Some(place)) = (group.shapes(member), memory.place) else {
                        continue;
                    };
                    let within = reach(probe.config().radius, shape.size);
                    let near = shape.nearest(&probe.start, within, Some(&place));
                    let near = near.unwrap_or_else(|| shape.at(&place, &probe.start));
                    let mut point = at_body(&view, &shape, (member, span, index), &place, probe, &near);
                    point.gap = near.distance - probe.config().radius;
                    let (normal, farthest) = (-near.normal, SNAPPED * shape.size);
                    resume(&mut point, memory.force, &normal, memory.anchor, -probe.start, farthest);
                    point
                }
                Touched::Probe(_) | Touched::Attachment(_) => continue,
            };
            work.points.push(point);
        }
    }
    Ok(())
}

/// A contact of a probe with a body, before its first look at the end of the step.
fn at_body(
    view: &View<'_>,
    shape: &Shape<'_>,
    (member, span, index): (usize, usize, usize),
    place: &Place,
    probe: &crate::Probe,
    near: &Near,
) -> ContactPoint {
    let friction = (view.contacts.friction() * probe.config().friction).sqrt();
    let mut point = ContactPoint::new(member, 0, Touched::Probe(index), friction);
    let carriers = shape.field.carriers(place);
    (point.start, point.tangent) = shape.material(place, &carriers);
    let first = Some((*place, carriers));
    let plane = plane_of(near, &probe.start);
    point.probe = Some(AtProbe { probe: index, span, first, last: Some(near.place), plane });
    point.arm = point.start - Vector3::from(shape.frame.center());
    point.compliance = compliance(view, shape, &carriers);
    point
}

fn compliance(view: &View<'_>, shape: &Shape<'_>, carriers: &Carriers) -> Matrix3<f64> {
    carrier_compliance(view, shape.sites, (shape.frame, shape.q), carriers)
}

/// Adds points for what the probes touch or are near. Returns whether any penetrates.
pub(in super::super) fn detect_probes<P: Member>(
    group: &Group<'_, P>,
    work: &mut Touching,
) -> Result<bool, StepError> {
    let mut penetrates = false;
    for (number, &index) in group.held.iter().enumerate() {
        let (probe, span) = (&group.probes[index], group.len() + number);
        let radius = probe.config().radius;
        let (from, to) = (probe.start, probe.position);
        let way = to - from;
        for (at, obstacle) in probe.obstacles().iter().enumerate() {
            let same = |point: &ContactPoint| point.member == span && point.other == Touched::Obstacle(at);
            if work.points.iter().any(same) {
                continue;
            }
            let grown = Grown { shape: &**obstacle, by: radius };
            let (begin, mut found) = (look(&grown, &from)?, look(&grown, &to)?);
            let passed = if is_far(probe) { march(&grown, &from, &way, begin)? } else { None };
            found = passed.unwrap_or(found);
            if found.distance >= radius {
                continue;
            }
            let friction = friction_at(probe.config().friction, &**obstacle);
            let mut point = ContactPoint::new(span, at, Touched::Obstacle(at), friction);
            point.start = from;
            point.carried = carried(&**obstacle, &to, group.h)?;
            point.gap = look(&grown, &(from + point.carried))?.distance;
            let slid = way - point.carried;
            point.anchor = from + point.carried + share(point.gap, found.distance) * slid;
            point.passed = passed.is_some();
            let plane = [to - (found.distance + radius) * found.normal, found.normal];
            point.probe = Some(AtProbe { probe: index, span, first: None, last: None, plane });
            point.turn(&found.normal);
            penetrates |= found.distance < 0.0;
            work.points.push(point);
        }
        for member in 0..group.len() {
            let same = |point: &ContactPoint| {
                point.member == member && point.probe.is_some_and(|probe| probe.probe == index)
            };
            if !probe.near.contains(&group.who[member]) || work.points.iter().any(same) {
                continue;
            }
            let view = group.view(member);
            let Some([start, end]) = group.shapes(member) else { continue };
            let swept = is_far(probe)
                .then(|| end.sweep(&start.pull_back(&from), &end.pull_back(&to), radius))
                .flatten();
            let near = match &swept {
                Some(place) => Some(end.at(place, &to)),
                None => end.nearest(&to, reach(radius, end.size), None),
            };
            let Some(near) = near.filter(|near| near.distance < 2.0 * radius) else { continue };
            let begun = start.at(&near.place, &from);
            let mut point = at_body(&view, &start, (member, span, index), &near.place, probe, &begun);
            point.gap = begun.distance - radius;
            point.passed = swept.is_some();
            let ended = end.material(&near.place, &end.field.carriers(&near.place)).0;
            let slid = (ended - point.start) - way;
            point.anchor = point.start - from + share(point.gap, near.distance - radius) * slid;
            point.turn(&-near.normal);
            penetrates |= near.distance < radius;
            work.points.push(point);
        }
    }
    Ok(penetrates)
}

/// Takes the gap of a point at a probe at the end of the computed step.
pub(super) fn linearize_at_probe<P: Member>(
    group: &Group<'_, P>,
    point: &mut ContactPoint,
    recovers: bool,
) -> Result<(), StepError> {
    let Some(mut at) = point.probe else { return Ok(()) };
    let probe = &group.probes[at.probe];
    let (radius, x) = (probe.config().radius, probe.position);
    let far = is_far(probe) || point.passed;
    let distance = match &at.first {
        None => {
            let Touched::Obstacle(index) = point.other else { return Ok(()) };
            let Some(obstacle) = probe.obstacles().get(index) else { return Ok(()) };
            if !far {
                let found = look(&**obstacle, &x)?;
                at.plane = [x - found.distance * found.normal, found.normal];
            }
            point.compliance = probe.rigid();
            point.turn(&at.plane[1]);
            point.end = x;
            point.floor = floor(point.gap, RECOVERY_SPEED * radius * group.h, recovers);
            at.plane[1].dot(&(x - at.plane[0])) - radius
        }
        Some((place, carriers)) => {
            let view = group.view(point.member);
            let Some([_, shape]) = group.shapes(point.member) else { return Ok(()) };
            let last = at.last.unwrap_or(*place);
            let near = if far { None } else { shape.nearest(&x, reach(radius, shape.size), Some(&last)) };
            let near = near.unwrap_or_else(|| shape.at(&last, &x));
            (at.last, at.plane) = (Some(near.place), plane_of(&near, &x));
            let (end, tangent): (_, Tangent) = shape.material(place, carriers);
            point.end = end;
            point.carried = x - probe.start;
            point.compliance = compliance(&view, &shape, carriers);
            point.turn(&-near.normal);
            if point.mean.is_none() {
                point.arm = near.at - Vector3::from(shape.frame.center());
            }
            let begun = point.tangent;
            point.mean.get_or_insert_with(|| 0.5 * (begun + tangent));
            point.floor = floor(point.gap, RECOVERY_SPEED * radius * group.h, recovers);
            near.distance - radius
        }
    };
    point.place = at.plane[0];
    let from = if at.first.is_some() { x } else { Vector3::zeros() };
    let offset = point.axes * (point.end - from - point.anchor);
    point.off = Vector3::new(distance - point.floor, offset[1], offset[2]);
    point.probe = Some(at);
    Ok(())
}

/// What the next step and users need of a contact of a probe. `None` for a memory of a contact
/// without force.
pub(in super::super) fn keep_at_probe<P: Member>(
    group: &Group<'_, P>,
    point: &ContactPoint,
) -> Option<(usize, ProbeContact, Option<ProbeMemory>)> {
    let at = point.probe?;
    let pushes = point.pushed[0] > 0.0;
    let force = if pushes { point.world_force() } else { Vector3::zeros() };
    if !force.iter().all(|x| x.is_finite()) {
        return None;
    }
    let dent = point.compliance * force;
    let held = point.pushed[1].hypot(point.pushed[2]);
    let sliding = held >= point.friction * point.pushed[0] * (1.0 - 1e-9);
    let h = group.h;
    let x = group.probes[at.probe].position;
    let (other, on_probe, velocity, compliance, memory) = match &at.first {
        None => {
            let anchor = if sliding { x + dent } else { point.anchor };
            let memory = ProbeMemory { other: point.other, force, anchor, place: None };
            (point.other, force, point.carried / h, Matrix3::zeros(), memory)
        }
        Some((place, carriers)) => {
            let view = group.view(point.member);
            let [start, end] = group.shapes(point.member)?;
            let mut anchor = if sliding { point.end - x + dent } else { point.anchor };
            // The next step holds the material of the place that is nearest now.
            let next = at.last.unwrap_or(*place);
            let of = end.field.carriers(&next);
            anchor += end.material(&next, &of).0 - end.material(place, carriers).0;
            let other = Touched::Body(view.contacts.key);
            let memory = ProbeMemory { other, force, anchor, place: Some(next) };
            let way = end.material(&next, &of).0 - start.material(&next, &of).0;
            (other, -force, way / h, point.compliance, memory)
        }
    };
    let contact = ProbeContact {
        other,
        point: at.plane[0].into(),
        normal: at.plane[1].into(),
        velocity: velocity.into(),
        compliance: std::array::from_fn(|i| std::array::from_fn(|j| compliance[(i, j)])),
        friction: point.friction,
        force: on_probe.into(),
        sliding: pushes && sliding,
    };
    Some((at.probe, contact, pushes.then_some(memory)))
}
