//! The laws of the contacts of probes: their gaps, their springs, and what a step keeps of them.

use nalgebra::{Matrix3, Vector3};

use super::super::super::{
    group::{Group, Member},
    touch::look,
};
use super::{RECOVERY_SPEED, compliance, floor, found_of, ground, is_far, on_side, plane_of, reach, slide};
use crate::{
    Probe, ProbeContact, StepError,
    contact::{ContactPoint, ProbeMemory, Touched, Touching},
    step::Tangent,
};

/// Takes the gap of a point at a probe at the end of the computed step.
pub(in super::super) fn linearize_at_probe<P: Member>(
    group: &Group<'_, P>,
    point: &mut ContactPoint,
    recovers: bool,
) -> Result<(), StepError> {
    let Some(mut at) = point.probe else { return Ok(()) };
    let probe = &group.probes[at.probe];
    let radius = probe.config().radius;
    let far = is_far(probe, &at.spot) || point.passed;
    let distance = match &at.first {
        None => {
            let Touched::Obstacle(index) = point.other else { return Ok(()) };
            let Some(obstacle) = probe.obstacles().get(index) else { return Ok(()) };
            if !far {
                at.nearest = slide(probe, &at.spot, true, |x| Ok(Some(ground(&**obstacle, x)?)))?;
            }
            let x = probe.ended(&at.nearest.at);
            if !far {
                let found = look(&**obstacle, &x)?;
                at.plane = [x - found.distance * found.normal, found.normal];
            }
            point.compliance = probe.rigid();
            point.turn(&at.plane[1]);
            at.carried = probe.carried(&at.spot.at, &at.plane[1]);
            point.end = at.carried;
            point.floor = floor(point.gap, RECOVERY_SPEED * radius * group.h, recovers);
            at.plane[1].dot(&(x - at.plane[0])) - radius
        }
        Some((place, carriers)) => {
            let view = group.view(point.member);
            let Some([_, shape]) = group.shapes(point.member) else { return Ok(()) };
            let mut last = at.last.unwrap_or(*place);
            let within = reach(radius, shape.size);
            if !far {
                at.nearest = slide(probe, &at.spot, true, |x| {
                    Ok(found_of(shape.nearest(x, within, Some(&last)), &mut last))
                })?;
            }
            let x = probe.ended(&at.nearest.at);
            let near = if far {
                None
            } else {
                on_side((probe, &at.spot, &at.plane), &shape, &x, within, Some(&last))
            };
            let near = near.unwrap_or_else(|| shape.beside(&last, &x));
            (at.last, at.plane) = (Some(near.place), plane_of(&near, &x));
            let (end, tangent): (_, Tangent) = shape.material(place, carriers);
            point.end = end;
            at.carried = probe.carried(&at.spot.at, &near.normal);
            point.carried = at.carried - probe.begun(&at.spot.at);
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
    [_, at.arm] = probe.arms(&at.nearest.at, &at.plane[1]);
    point.place = at.plane[0];
    let from = if at.first.is_some() { at.carried } else { Vector3::zeros() };
    let offset = point.axes * (point.end - from - point.anchor);
    point.off = Vector3::new(distance - point.floor, offset[1], offset[2]);
    point.probe = Some(at);
    Ok(())
}

/// Sum of the forces of the points on a probe, N, and their torque about the tool point, N m.
pub(in super::super::super) fn pull_on_probe(points: &[ContactPoint], index: usize) -> [Vector3<f64>; 2] {
    let (mut force, mut torque) = (Vector3::zeros(), Vector3::zeros());
    for point in points {
        if let Some(at) = point.probe.as_ref().filter(|at| at.probe == index) {
            let pull = if at.first.is_some() { -point.world_force() } else { point.world_force() };
            force += pull;
            torque += at.arm.cross(&pull);
        }
    }
    [force, torque]
}

/// Writes the rows of the probes' springs. Their squares are the compliance.
pub(in super::super::super) fn fill_probe_rows(probes: &[Probe], work: &mut Touching) {
    for (point, sides) in work.points.iter().zip(&work.sides) {
        let Some(at) = &point.probe else { continue };
        // The force is on the probe at an obstacle, and against it at a body.
        let (side, sign) = if at.first.is_some() { (sides[1], -1.0) } else { (sides[0], 1.0) };
        let Some(side) = side else { continue };
        let probe = &probes[at.probe];
        let (root, turning) = (sign * probe.compliance.sqrt(), sign * probe.turning().sqrt());
        let width = probe.width();
        for axis in 0..3 {
            let along = point.axes.row(axis).transpose();
            let row = &mut work.rows[side.rows + width * axis..][..width];
            row.iter_mut().zip(&along).for_each(|(x, axis)| *x = root * axis);
            let turn = at.arm.cross(&along);
            row.iter_mut().skip(3).zip(&turn).for_each(|(x, axis)| *x = turning * axis);
        }
    }
}

/// What the next step and users need of a contact of a probe. `None` for a memory of a contact
/// without force.
pub(in super::super::super) fn keep_at_probe<P: Member>(
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
    // The next step holds the material of the place of the probe that is nearest now.
    let probe = &group.probes[at.probe];
    let (x, spot) = (probe.ended(&at.nearest.at), at.nearest);
    let (other, on_probe, velocity, compliance, memory) = match &at.first {
        None => {
            let anchor = if sliding { x + dent } else { point.anchor + (x - at.carried) };
            let memory =
                ProbeMemory { other: point.other, force, anchor, spot, place: None, plane: at.plane };
            (point.other, force, point.carried / h, Matrix3::zeros(), memory)
        }
        Some((place, carriers)) => {
            let view = group.view(point.member);
            let [start, end] = group.shapes(point.member)?;
            let mut anchor = if sliding { point.end - x + dent } else { point.anchor - (x - at.carried) };
            // It holds the material of the body that is nearest now, too.
            let next = at.last.unwrap_or(*place);
            let of = end.field.carriers(&next);
            anchor += end.material(&next, &of).0 - end.material(place, carriers).0;
            let other = Touched::Body(view.contacts.key);
            let memory = ProbeMemory { other, force, anchor, spot, place: Some(next), plane: at.plane };
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
        spot: spot.at.into(),
        force: on_probe.into(),
        sliding: pushes && sliding,
    };
    Some((at.probe, contact, pushes.then_some(memory)))
}
