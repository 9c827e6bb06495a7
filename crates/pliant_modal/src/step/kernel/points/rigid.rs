//! Rigid bodies of another engine in a step: how they give way, and what holds them.

use nalgebra::{Matrix3, Vector3};

use super::super::group::{Group, Member};
use crate::{
    Rigid,
    contact::{AtRigid, AtSupport, ContactPoint, ObstacleShape, Pushed, Touched, Touching},
};

/// Compliance of a place where two rigid bodies touch, as a share of how far the force moves the
/// lighter one in a step. It keeps the laws solvable where more places than needed touch.
const SOFT: f64 = 1e-4;

/// The rigid body of a key: its index and its span.
pub(super) fn find<P: Member>(group: &Group<'_, P>, key: [u64; 2]) -> Option<[usize; 2]> {
    let first = group.len() + group.held.len();
    let number = group.pushed.iter().position(|&rigid| group.rigids[rigid].key == key)?;
    Some([group.pushed[number], first + number])
}

/// The obstacle where the forces of the step have moved it.
pub(super) fn pushed<'a, P: Member>(group: &'a Group<'_, P>, shape: &'a dyn ObstacleShape) -> Pushed<'a> {
    let found = shape.rigid().and_then(|key| find(group, key));
    Pushed { shape, by: found.map(|[rigid, _]| &group.rigids[rigid]), h: group.h }
}

/// The side of a point at the rigid body of an obstacle. The point has the way of the surface and
/// its anchor.
pub(super) fn side<P: Member>(
    group: &Group<'_, P>,
    shape: &dyn ObstacleShape,
    point: &ContactPoint,
    carried: Vector3<f64>,
) -> Option<AtRigid> {
    let [rigid, span] = find(group, shape.rigid()?)?;
    let middle = point.start + 0.5 * point.carried;
    let (arm, anchor) = (Vector3::zeros(), point.anchor - point.carried);
    Some(AtRigid { rigid, span, middle, arm, carried, anchor })
}

/// Adds the places where the rigid bodies touch others of their engine, once a body touches one.
/// They begin with the forces of `work.supports`, by rigid bodies and places, if these are there.
pub(in super::super) fn support<P: Member>(group: &Group<'_, P>, work: &mut Touching, with_forces: bool) {
    let touched = work.points.iter().any(|point| point.rigid.is_some());
    if !touched || work.points.iter().any(|point| point.support.is_some()) {
        return;
    }
    let first = group.len() + group.held.len();
    let mut begun = 0;
    for (number, &index) in group.pushed.iter().enumerate() {
        let rigid = &group.rigids[index];
        let forces = begun..begun + rigid.supports.len();
        begun = forces.end;
        for (at, support) in rigid.supports.iter().enumerate().filter(|(_, support)| support.is_sound()) {
            let mut point = ContactPoint::new(first + number, at, Touched::Obstacle(index), support.friction);
            point.support = Some(AtSupport { rigid: index, support: at, arm: Vector3::zeros() });
            let place = Vector3::from(support.point);
            let other = support.other.and_then(|key| find(group, key));
            let mut light = rigid.lightness(&place);
            point.rigid = other.map(|[rigid, span]| {
                light = light.max(group.rigids[rigid].lightness(&place));
                let zero = Vector3::zeros();
                AtRigid { rigid, span, middle: place, arm: zero, carried: zero, anchor: place }
            });
            // Forces at this place move neither, and without compliance the law would be singular.
            if !(light > 0.0 && light.is_finite()) {
                continue;
            }
            (point.start, point.place, point.gap) = (place, place, support.gap);
            point.compliance = Matrix3::identity() * (SOFT * group.h * group.h * light);
            point.turn(&Vector3::from(support.normal));
            if let Some(force) = work.supports.get(forces.start + at).filter(|_| with_forces) {
                point.pushed[0] = *force;
                point.force = point.pushed;
            }
            work.points.push(point);
        }
    }
}

/// Takes the forces with which the engine of the rigid bodies holds them at the beginning of the
/// step, so that one that is lighter than what it carries does not fly away from the forces of the
/// step before.
pub(in super::super) fn begin_supports<P: Member>(group: &mut Group<'_, P>, work: &mut Touching) {
    work.supports.clear();
    for &index in group.pushed {
        for support in &mut group.rigids[index].supports {
            let force = std::mem::take(&mut support.force);
            work.supports.push(if force > 0.0 && force.is_finite() { force } else { 0.0 });
        }
    }
}

/// Takes the gap of a place where rigid bodies touch at the end of the computed step. A force moves
/// it exactly as the rows say.
pub(super) fn linearize_support<P: Member>(group: &Group<'_, P>, point: &mut ContactPoint, at: AtSupport) {
    let rigid = &group.rigids[at.rigid];
    let Some(support) = rigid.supports.get(at.support) else { return };
    let far = match point.rigid {
        Some(far) => group.rigids[far.rigid].displacement(&point.start, group.h),
        None => group.h * Vector3::from(support.velocity),
    };
    let way = point.axes * (rigid.displacement(&point.start, group.h) - far);
    // What penetrates already is the other engine's to push out.
    point.off = Vector3::new(support.gap.max(0.0) + way[0], way[1], way[2]);
}

/// Sets the arms of the contacts at rigid bodies, so that no angular momentum is lost.
pub(in super::super) fn set_arms<P: Member>(group: &Group<'_, P>, point: &mut ContactPoint, weight: f64) {
    let middle = point.rigid.map_or(point.place, |far| far.middle);
    if let Some(far) = &mut point.rigid {
        far.arm = middle - group.rigids[far.rigid].pivot(weight, group.h);
    }
    if let Some(at) = point.attached {
        point.arm = at.middle - group.view(point.member).kernel.pivot(weight);
        return;
    }
    match &mut point.support {
        Some(at) => at.arm = middle - group.rigids[at.rigid].pivot(weight, group.h),
        None if point.rigid.is_some() => {
            point.arm = middle - group.view(point.member).kernel.pivot(weight);
        }
        None => {}
    }
}

/// Sum of the forces of the points on a rigid body, and their torque about its center.
fn sum(points: &[ContactPoint], index: usize) -> [Vector3<f64>; 2] {
    let (mut force, mut torque) = (Vector3::zeros(), Vector3::zeros());
    for point in points {
        let near = point.support.filter(|at| at.rigid == index).map(|at| (1.0, at.arm));
        let share = point.attached.map_or(1.0, |at| at.turns[1]);
        let far = point.rigid.filter(|at| at.rigid == index).map(|at| (-1.0, share * at.arm));
        for (sign, arm) in near.into_iter().chain(far) {
            let pull = sign * point.world_force();
            force += pull;
            torque += arm.cross(&pull);
        }
        if let Some(at) = point.attached.filter(|_| far.is_some()) {
            torque += at.rub;
        }
    }
    [force, torque]
}

/// Moves the rigid bodies under the forces of the points.
pub(in super::super) fn respond<P>(group: &mut Group<'_, P>, work: &Touching, weight: f64) {
    for &index in group.pushed {
        let [force, torque] = sum(&work.points, index);
        let holds = |point: &ContactPoint| {
            let near = point.support.is_some_and(|at| at.rigid == index);
            let far = point.support.is_some() && point.rigid.is_some_and(|at| at.rigid == index);
            (near || far) && point.pushed[0] > 0.0
        };
        group.rigids[index].is_held = work.points.iter().any(holds);
        group.rigids[index].respond(&force, &torque, weight, group.h);
    }
}

/// Writes the rows of the rigid bodies.
pub(in super::super) fn fill_rows(rigids: &[Rigid], work: &mut Touching, h: f64) {
    for (point, sides) in work.points.iter().zip(&work.sides) {
        let near = point.support.map(|at| (at.rigid, at.arm, point.axes, sides[0]));
        let share = point.attached.map_or(1.0, |at| at.turns[1].sqrt());
        let far = point.rigid.map(|at| (at.rigid, share * at.arm, -point.axes, sides[1]));
        for (rigid, arm, axes, side) in near.into_iter().chain(far) {
            if let Some(side) = side {
                rigids[rigid].fill_rows(&axes, &arm, h, &mut work.rows[side.rows..][..18]);
            }
        }
    }
}

/// Takes the places where rigid bodies touch each other from the points, and writes their forces.
pub(in super::super) fn take_supports<P>(group: &mut Group<'_, P>, work: &mut Touching) {
    work.points.retain(|point| {
        let Some(at) = point.support else { return true };
        if let Some(support) = group.rigids[at.rigid].supports.get_mut(at.support) {
            support.force = point.pushed[0].max(0.0);
        }
        false
    });
}

/// Writes what the contacts have done to the rigid bodies. Without a force the weight is that of
/// no contact.
pub(in super::super) fn write_forces<P>(group: &mut Group<'_, P>, work: &Touching) {
    for &index in group.pushed {
        let [force, torque] = sum(&work.points, index);
        let rigid = &mut group.rigids[index];
        if force.iter().chain(&torque).all(|x| x.is_finite()) {
            (rigid.force, rigid.torque) = (force.into(), torque.into());
        }
    }
}
