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
    ObstacleShape, Probe, StepError,
    contact::{
        ALONG, AtProbe, Carriers, ContactPoint, Grown, Near, Place, Shape, Side, Spot, SurfacePoint, Touched,
        Touching,
    },
};

mod solve;

pub(super) use solve::linearize_at_probe;
pub(in super::super) use solve::{fill_probe_rows, keep_at_probe, pull_on_probe};

/// Way in a step, as a share of the radius, beyond which a place of a probe meets the plane of the
/// place that it had, and not the place that is nearest after the way.
const FAR: f64 = 0.5;

/// Depth of a sphere's center inside a body down to which it is pushed out, as a share of the
/// body's size.
const DEEP: f64 = 0.1;

/// How far from a sphere's center the nearest place of a body is searched, m.
fn reach(radius: f64, size: f64) -> f64 {
    (2.0 * radius).max(DEEP * size)
}

/// Whether a place of a probe has gone far in this step.
fn is_far(probe: &Probe, spot: &Spot) -> bool {
    // Comparisons with no number are false.
    (probe.ended(&spot.at) - probe.begun(&spot.at)).norm() > FAR * probe.config().radius
}

/// The plane of a surface to which the nearest place of a body belongs.
fn plane_of(near: &Near, center: &Vector3<f64>) -> [Vector3<f64>; 2] {
    [center - near.distance * near.normal, near.normal]
}

/// Height of each of two places above the plane of the other from which on they are on two sides of
/// a groove, as a share of the radius.
const ABOVE: f64 = 0.05;

/// Whether two planes that a place of a probe touches are the sides of a groove: each touches above
/// the plane of the other. Two faces that meet in an edge are none, and a contact moves from one to
/// the other. A place that slides over the probe touches one side.
fn is_groove(probe: &Probe, spot: &Spot, [a, n]: &[Vector3<f64>; 2], [b, m]: &[Vector3<f64>; 2]) -> bool {
    let (way, least) = (b - a, ABOVE * probe.config().radius);
    spot.fixed.is_some() && n.dot(m) < ALONG && n.dot(&way) > least && -m.dot(&way) > least
}

/// The place of a body that is nearest to a point (m, world axes), no farther than `within` (m). Of
/// the two sides of a groove it is that of the plane of the contact, as long as it is there.
/// Without that a contact would alternate between the sides, and each time lose its force.
fn on_side(
    (probe, spot, plane): (&Probe, &Spot, &[Vector3<f64>; 2]),
    shape: &Shape<'_>,
    point: &Vector3<f64>,
    within: f64,
    hint: Option<&Place>,
) -> Option<Near> {
    let near = shape.nearest(point, within, hint)?;
    if is_groove(probe, spot, plane, &plane_of(&near, point)) {
        return shape.nearest_of(point, &Side::Along(plane[1]), within, hint);
    }
    Some(near)
}

/// Whether a place of a probe that is near an existing contact with the same thing is no other.
fn is_taken(work: &Touching, of: impl Fn(&ContactPoint, &AtProbe) -> bool, spot: &Spot, radius: f64) -> bool {
    let same = |at: &AtProbe| at.nearest.is_same(spot, radius) || at.spot.is_same(spot, radius);
    work.points.iter().any(|point| point.probe.is_some_and(|at| same(&at) && of(point, &at)))
}

/// The side of a new contact at a probe, with the plane of the surface.
fn at_probe((index, span): (usize, usize), probe: &Probe, spot: Spot, plane: [Vector3<f64>; 2]) -> AtProbe {
    let [arm, _] = probe.arms(&spot.at, &plane[1]);
    let carried = probe.begun(&spot.at);
    AtProbe { probe: index, span, first: None, last: None, spot, nearest: spot, arm, carried, plane }
}

/// Sets up the contacts of probes that the step before left.
pub(in super::super) fn begin_probes<P: Member>(
    group: &Group<'_, P>,
    work: &mut Touching,
) -> Result<(), StepError> {
    for (number, &index) in group.held.iter().enumerate() {
        let (probe, span) = (&group.probes[index], group.len() + number);
        let (radius, own) = (probe.config().radius, (index, span));
        let of = |between: bool| {
            probe.memory.iter().filter(move |memory| probe.is_between(&memory.spot) == between)
        };
        for memory in of(false).chain(of(true)) {
            match memory.other {
                Touched::Obstacle(at) => {
                    let Some(obstacle) = probe.obstacles().get(at) else { continue };
                    let spot = slide(probe, &memory.spot, false, |x| Ok(Some(ground(&**obstacle, x)?)))?;
                    if is_taken(work, |point, _| is_at_obstacle(point, span, at), &spot, radius) {
                        continue;
                    }
                    let center = probe.begun(&spot.at);
                    let found = look(&**obstacle, &center)?;
                    let mut point = at_obstacle(probe, own, at, &**obstacle, spot, &found);
                    point.carried = carried(&**obstacle, &center, group.h)?;
                    point.gap = look(&**obstacle, &(center + point.carried))?.distance - radius;
                    let carried = point.carried;
                    let anchor = memory.anchor + (center - probe.begun(&memory.spot.at)) + carried;
                    resume(&mut point, memory.force, &found.normal, anchor, carried, f64::INFINITY);
                    work.points.push(point);
                }
                Touched::Body(key) => {
                    let Some(member) = find(group, key) else { continue };
                    let view = group.view(member);
                    let (Some([shape, _]), Some(place)) = (group.shapes(member), memory.place) else {
                        continue;
                    };
                    let within = reach(radius, shape.size);
                    let mut hint = place;
                    let spot = slide(probe, &memory.spot, false, |x| {
                        Ok(found_of(shape.nearest(x, within, Some(&hint)), &mut hint))
                    })?;
                    let center = probe.begun(&spot.at);
                    let near = on_side((probe, &spot, &memory.plane), &shape, &center, within, Some(&place));
                    let near = near.unwrap_or_else(|| shape.beside(&place, &center));
                    let plane = plane_of(&near, &center);
                    let same = |point: &ContactPoint, at: &AtProbe| {
                        is_at_body(point, at, member, index) && !is_groove(probe, &spot, &plane, &at.plane)
                    };
                    if is_taken(work, same, &spot, radius) {
                        continue;
                    }
                    let mut point = at_body(&view, &shape, member, &place, (probe, own, spot), &near);
                    point.gap = near.distance - radius;
                    let (normal, farthest) = (-near.normal, SNAPPED * shape.size);
                    let anchor = memory.anchor - (center - probe.begun(&memory.spot.at));
                    resume(&mut point, memory.force, &normal, anchor, -center, farthest);
                    if !(probe.is_between(&spot) && shares_site(work, &point)) {
                        work.points.push(point);
                    }
                }
                Touched::Probe(_) | Touched::Attachment(_) => {}
            }
        }
    }
    Ok(())
}

/// The distance and the normal of what was found, whose place the next search begins with.
fn found_of(near: Option<Near>, hint: &mut Place) -> Option<(f64, Vector3<f64>)> {
    near.map(|near| {
        *hint = near.place;
        (near.distance, near.normal)
    })
}

/// The distance and the normal of an obstacle.
fn ground(obstacle: &dyn ObstacleShape, point: &Vector3<f64>) -> Result<(f64, Vector3<f64>), StepError> {
    let found = look(obstacle, point)?;
    Ok((found.distance, found.normal))
}

fn is_at_obstacle(point: &ContactPoint, span: usize, obstacle: usize) -> bool {
    point.member == span && point.other == Touched::Obstacle(obstacle)
}

fn is_at_body(point: &ContactPoint, at: &AtProbe, member: usize, probe: usize) -> bool {
    point.member == member && at.first.is_some() && at.probe == probe
}

/// The place of a probe that is nearest to a surface, no farther from `spot` than a radius: what is
/// nearer farther away is another contact. Some places stay.
fn slide(
    probe: &Probe,
    spot: &Spot,
    is_ended: bool,
    look: impl FnMut(&Vector3<f64>) -> Result<Option<(f64, Vector3<f64>)>, StepError>,
) -> Result<Spot, StepError> {
    match spot.fixed {
        Some(_) => Ok(*spot),
        None => Ok(Spot { at: probe.slide(&spot.at, probe.config().radius, is_ended, look)?, fixed: None }),
    }
}

/// The site that carries most of a point at a body.
fn site_of(point: &ContactPoint) -> Option<usize> {
    point.probe.and_then(|at| at.first)?.1.largest()
}

/// Whether a place between corners would share its site with another place of the probe, whose
/// dent it then has already.
fn shares_site(work: &Touching, new: &ContactPoint) -> bool {
    let (Some(at), Some(site)) = (new.probe, site_of(new)) else { return false };
    let same = |point: &ContactPoint| {
        point.member == new.member
            && point.probe.is_some_and(|other| other.probe == at.probe)
            && site_of(point) == Some(site)
    };
    work.points.iter().any(same)
}

/// A contact of a probe with an obstacle, before its first look at the end of the step.
fn at_obstacle(
    probe: &Probe,
    (index, span): (usize, usize),
    at: usize,
    obstacle: &dyn ObstacleShape,
    spot: Spot,
    found: &SurfacePoint,
) -> ContactPoint {
    let friction = friction_at(probe.config().friction, obstacle);
    let mut point = ContactPoint::new(span, at, Touched::Obstacle(at), friction);
    point.start = probe.begun(&spot.at);
    point.compliance = probe.rigid();
    let plane = [point.start - found.distance * found.normal, found.normal];
    point.probe = Some(at_probe((index, span), probe, spot, plane));
    point
}

/// A contact of a probe with a body, before its first look at the end of the step.
fn at_body(
    view: &View<'_>,
    shape: &Shape<'_>,
    member: usize,
    place: &Place,
    (probe, of, spot): (&Probe, (usize, usize), Spot),
    near: &Near,
) -> ContactPoint {
    let friction = (view.contacts.friction() * probe.config().friction).sqrt();
    let mut point = ContactPoint::new(member, 0, Touched::Probe(of.0), friction);
    let carriers = shape.field.carriers(place);
    (point.start, point.tangent) = shape.material(place, &carriers);
    let first = Some((*place, carriers));
    let side = at_probe(of, probe, spot, plane_of(near, &probe.begun(&spot.at)));
    point.probe = Some(AtProbe { first, last: Some(near.place), ..side });
    point.arm = point.start - Vector3::from(shape.frame.center());
    point.compliance = compliance(view, shape, &carriers);
    point
}

fn compliance(view: &View<'_>, shape: &Shape<'_>, carriers: &Carriers) -> Matrix3<f64> {
    carrier_compliance(view, shape.sites, (shape.frame, shape.q), carriers)
}

/// Adds points for what the probes touch or are near. Returns whether any penetrates. `is_first`
/// says that the step is computed for the first time.
pub(in super::super) fn detect_probes<P: Member>(
    group: &Group<'_, P>,
    work: &mut Touching,
    is_first: bool,
) -> Result<bool, StepError> {
    let mut penetrates = false;
    unite(group, work);
    for (number, &index) in group.held.iter().enumerate() {
        let (probe, span) = (&group.probes[index], group.len() + number);
        for at in 0..probe.obstacles().len() {
            penetrates |= detect_at_obstacle(group, work, (index, span), at)?;
        }
        for member in 0..group.len() {
            if probe.near.contains(&group.who[member]) {
                penetrates |= detect_at_body(group, work, (index, span), member, is_first)?;
            }
        }
    }
    Ok(penetrates)
}

/// Makes one point of those whose places on a probe have slid together. It has the force of both.
fn unite<P: Member>(group: &Group<'_, P>, work: &mut Touching) {
    let mut number = 0;
    while number < work.points.len() {
        let point = work.points[number];
        let other = point.probe.filter(|at| at.nearest.fixed.is_none()).and_then(|at| {
            let radius = group.probes[at.probe].config().radius;
            let same = |other: &ContactPoint| {
                (other.member, other.other) == (point.member, point.other)
                    && other
                        .probe
                        .is_some_and(|own| own.probe == at.probe && own.nearest.is_same(&at.nearest, radius))
            };
            (0..work.points.len()).find(|&other| other != number && same(&work.points[other]))
        });
        match other {
            Some(other) => {
                let force = point.world_force();
                let kept = &mut work.points[other];
                kept.pushed += kept.axes * force;
                kept.force = kept.pushed;
                work.points.remove(number);
            }
            None => number += 1,
        }
    }
}

/// Rise of a surface beside the place of a probe that is nearest to it, as a share of the radius,
/// below which it is flat there: what touches already is enough.
const FLAT: f64 = 1e-3;

/// Whether a surface falls away from a place between the corners of a probe towards all of them.
/// `look` has the distance of a point (m, world axes), if it is near.
fn is_summit(
    probe: &Probe,
    spot: &Spot,
    distance: f64,
    mut look: impl FnMut(&Vector3<f64>) -> Result<Option<f64>, StepError>,
) -> Result<bool, StepError> {
    let radius = probe.config().radius;
    for corner in probe.corners() {
        let way = corner - spot.at;
        let length = way.norm();
        if length <= 0.0 {
            return Ok(false);
        }
        let beside = spot.at + way * (0.5 * length).min(2.0 * radius) / length;
        if look(&probe.ended(&beside))?.is_some_and(|there| there < distance + FLAT * radius) {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Adds points for the places of a probe that touch an obstacle or are near it: all corners, and
/// the place between them that is nearest. Returns whether any penetrates.
fn detect_at_obstacle<P: Member>(
    group: &Group<'_, P>,
    work: &mut Touching,
    (index, span): (usize, usize),
    at: usize,
) -> Result<bool, StepError> {
    let probe = &group.probes[index];
    let (obstacle, radius) = (&*probe.obstacles()[at], probe.config().radius);
    let grown = Grown { shape: obstacle, by: radius };
    // The surface where a place ends, and whether it has passed through.
    let look_at = |spot: &Spot| {
        let [from, to] = [probe.begun(&spot.at), probe.ended(&spot.at)];
        let found = look(&grown, &to)?;
        let passed = if is_far(probe, spot) {
            march(&grown, &from, &(to - from), look(&grown, &from)?)?
        } else {
            None
        };
        Ok::<_, StepError>((passed.unwrap_or(found), passed.is_some()))
    };
    let mut penetrates = false;
    let mut add = |work: &mut Touching, spot: Spot, found: SurfacePoint, passed: bool| {
        let [from, to] = [probe.begun(&spot.at), probe.ended(&spot.at)];
        let mut point = at_obstacle(probe, (index, span), at, obstacle, spot, &found);
        point.carried = carried(obstacle, &to, group.h)?;
        point.gap = look(&grown, &(from + point.carried))?.distance;
        let slid = probe.carried(&spot.at, &found.normal) - from - point.carried;
        point.anchor = from + point.carried + share(point.gap, found.distance) * slid;
        point.passed = passed;
        if let Some(side) = &mut point.probe {
            side.plane = [to - (found.distance + radius) * found.normal, found.normal];
        }
        point.turn(&found.normal);
        penetrates |= found.distance < 0.0;
        work.points.push(point);
        Ok::<_, StepError>(())
    };
    let mut nearest: Option<(SurfacePoint, bool, Spot)> = None;
    for spot in probe.spots() {
        let is_corner = !probe.is_between(&spot);
        if is_corner && is_taken(work, |point, _| is_at_obstacle(point, span, at), &spot, radius) {
            continue;
        }
        let (found, passed) = look_at(&spot)?;
        if is_corner && found.distance < radius {
            add(work, spot, found, passed)?;
        } else if !is_corner && nearest.is_none_or(|(other, ..)| found.distance < other.distance) {
            nearest = Some((found, passed, spot));
        }
    }
    // What is rigid needs no places between but the one that is nearest.
    if let Some((mut found, passed, Spot { at: mut place, .. })) = nearest {
        if !passed {
            place = probe.slide(&place, f64::INFINITY, true, |x| Ok(Some(ground(obstacle, x)?)))?;
            found = look(&grown, &probe.ended(&place))?;
        }
        let spot = Spot { at: place, fixed: None };
        let taken = is_taken(work, |point, _| is_at_obstacle(point, span, at), &spot, radius);
        let alone = !work.points.iter().any(|point| is_at_obstacle(point, span, at));
        let distance = |x: &Vector3<f64>| Ok(Some(look(&grown, x)?.distance));
        let near = found.distance < radius && !taken;
        if near && (alone || !passed && is_summit(probe, &spot, found.distance, distance)?) {
            add(work, spot, found, passed)?;
        }
    }
    Ok(penetrates)
}

/// As [`detect_at_obstacle`], at a body, with the places between corners that penetrate, one for
/// each site, and with both sides of a groove in which a place lies that stays.
fn detect_at_body<P: Member>(
    group: &Group<'_, P>,
    work: &mut Touching,
    (index, span): (usize, usize),
    member: usize,
    is_first: bool,
) -> Result<bool, StepError> {
    let (probe, view) = (&group.probes[index], group.view(member));
    let radius = probe.config().radius;
    let Some([start, end]) = group.shapes(member) else { return Ok(false) };
    let within = reach(radius, end.size);
    let look_at = |spot: &Spot| {
        let [from, to] = [probe.begun(&spot.at), probe.ended(&spot.at)];
        let swept = is_far(probe, spot)
            .then(|| end.sweep(&start.pull_back(&from), &end.pull_back(&to), radius))
            .flatten();
        match &swept {
            Some(place) => Some((end.beside(place, &to), true)),
            None => Some((end.nearest(&to, within, None)?, false)),
        }
    };
    let mut penetrates = false;
    let mut add = |work: &mut Touching, spot: Spot, near: &Near, passed: bool| {
        let from = probe.begun(&spot.at);
        let begun = start.beside(&near.place, &from);
        let mut point = at_body(&view, &start, member, &near.place, (probe, (index, span), spot), &begun);
        point.gap = begun.distance - radius;
        point.passed = passed;
        if let Some(side) = &mut point.probe {
            side.plane = plane_of(near, &probe.ended(&spot.at));
        }
        let ended = end.material(&near.place, &end.field.carriers(&near.place)).0;
        let slid = (ended - point.start) - (probe.carried(&spot.at, &near.normal) - from);
        point.anchor = point.start - from + share(point.gap, near.distance - radius) * slid;
        point.turn(&-near.normal);
        if probe.is_between(&spot) && shares_site(work, &point) {
            return;
        }
        penetrates |= near.distance < radius;
        work.points.push(point);
    };
    let mut nearest: Option<(Near, bool, Spot)> = None;
    let mut between = std::mem::take(&mut work.between);
    between.clear();
    for spot in probe.spots() {
        if is_taken(work, |point, at| is_at_body(point, at, member, index), &spot, radius) {
            continue;
        }
        let Some((near, passed)) = look_at(&spot) else { continue };
        if !probe.is_between(&spot) {
            if near.distance < 2.0 * radius {
                add(work, spot, &near, passed);
            }
            continue;
        }
        if near.distance < radius {
            between.push((near, passed, spot));
        }
        if nearest.is_none_or(|(other, ..)| near.distance < other.distance) {
            nearest = Some((near, passed, spot));
        }
    }
    if let Some((mut near, passed, Spot { at: mut place, .. })) = nearest {
        if !passed {
            let mut hint = near.place;
            place = probe.slide(&place, f64::INFINITY, true, |x| {
                Ok(found_of(end.nearest(x, within, Some(&hint)), &mut hint))
            })?;
            near = end.nearest(&probe.ended(&place), within, Some(&hint)).unwrap_or(near);
        }
        let spot = Spot { at: place, fixed: None };
        let taken = is_taken(work, |point, at| is_at_body(point, at, member, index), &spot, radius);
        let distance =
            |x: &Vector3<f64>| Ok(end.nearest(x, within, Some(&near.place)).map(|near| near.distance));
        let touches = near.distance < 2.0 * radius && !taken;
        let alone = |work: &Touching| {
            let of_both = |at: AtProbe, point| is_at_body(point, &at, member, index);
            !work.points.iter().any(|point| point.probe.is_some_and(|at| of_both(at, point)))
        };
        if touches && (if passed { alone(work) } else { is_summit(probe, &spot, near.distance, distance)? }) {
            add(work, spot, &near, passed);
        }
    }
    // A soft surface is pressed along the whole length between corners.
    for (near, passed, spot) in between.drain(..) {
        if !is_taken(work, |point, at| is_at_body(point, at, member, index), &spot, radius) {
            add(work, spot, &near, passed);
        }
    }
    // In a step no place goes so far that it meets another side that was not near at first.
    if is_first {
        for spot in probe.spots() {
            let near = beside(probe, &spot, &end, work, |point, at| is_at_body(point, at, member, index));
            if let Some(near) = near {
                add(work, spot, &near, false);
            }
        }
    }
    work.between = between;
    Ok(penetrates)
}

/// The other side of the groove in which a place of a probe lies that touches one.
fn beside(
    probe: &Probe,
    spot: &Spot,
    shape: &Shape<'_>,
    work: &Touching,
    of: impl Fn(&ContactPoint, &AtProbe) -> bool,
) -> Option<Near> {
    let sides = work.points.iter().filter_map(|point| Some((point, point.probe?)));
    let mut sides = sides.filter(|(point, at)| at.spot.fixed == spot.fixed && of(point, at));
    let (Some((point, at)), None) = (sides.next(), sides.next()) else { return None };
    if point.passed {
        return None;
    }
    let center = probe.ended(&spot.at);
    let reach = 2.0 * probe.config().radius;
    let near = shape.nearest_of(&center, &Side::Beside(at.plane[1]), reach, at.last.as_ref())?;
    is_groove(probe, spot, &at.plane, &plane_of(&near, &center)).then_some(near)
}
