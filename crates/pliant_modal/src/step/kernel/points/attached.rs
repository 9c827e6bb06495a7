//! Patches that are attached to points.

use nalgebra::{Matrix3, Vector3};

use super::super::{
    Kernel,
    group::{Group, Member},
};
use super::{RECOVERED, RECOVERY_SPEED, rigid};
use crate::{
    HeldPatch,
    contact::{AtAttachment, AtRigid, AttachedTo, ContactPoint, Touched, Touching},
    step::{State, Tangent},
};

/// Position of a patch, m, and its derivative by the six numbers, world axes.
fn material(kernel: &Kernel, patch: &HeldPatch, state: &State) -> (Vector3<f64>, Tangent) {
    let (moved, tangent) =
        crate::step::tangent(&patch.rows().reduce(&state.q, kernel.warps()), kernel.warps());
    let turn = *state.frame.rotation().to_rotation_matrix().matrix();
    (state.frame.to_world(patch.rest() + moved), turn * tangent)
}

/// Sets up the attachments of all members. Returns whether there are any.
pub(in super::super) fn begin_attached<P: Member>(group: &Group<'_, P>, work: &mut Touching) -> bool {
    let first = work.points.len();
    for member in 0..group.len() {
        let view = group.view(member);
        let (kernel, before) = (view.kernel, &view.kernel.before);
        for (index, attachment) in view.contacts.attachments.iter().enumerate() {
            let patch = &*attachment.patch;
            if patch.modes() != kernel.modes() {
                continue;
            }
            let zero = Vector3::zeros();
            let (start, carried, rigid) = match attachment.to {
                AttachedTo::World { point, velocity } => {
                    (Vector3::from(point), group.h * Vector3::from(velocity), None)
                }
                AttachedTo::Rigid { key, point } => {
                    let Some([rigid, span]) = rigid::find(group, key) else { continue };
                    let (start, free) = group.rigids[rigid].path(&point.into(), group.h);
                    let carried = free - start;
                    let side = AtRigid { rigid, span, middle: start, arm: zero, carried, anchor: start };
                    (start, carried, Some(side))
                }
            };
            let mut point = ContactPoint::new(member, index, Touched::Attachment(index), 0.0);
            (point.start, point.tangent) = material(kernel, patch, before);
            point.comply(kernel.patch_compliance(patch, &before.frame, &before.q));
            (point.carried, point.anchor, point.rigid) = (carried, start + carried, rigid);
            (point.before, point.pushed, point.force) =
                (attachment.force, attachment.force, attachment.force);
            point.stored_before = point.stored(&attachment.force);
            let apart = point.start + point.dent(&attachment.force) - start;
            // With its dent, the surface is where the point is. The dent under the force of the
            // step before calms what turns fast, and half of it is enough. Far apart, each has its
            // own arm.
            let near = apart.norm() <= FAR * kernel.model.size();
            let both = if point.rigid.is_some() { 0.5 * (start + point.start) } else { start };
            let middle = if near { both } else { point.start };
            if let Some(far) = &mut point.rigid {
                far.middle = if near { both } else { start };
            }
            point.arm = middle - Vector3::from(before.frame.center());
            point.attached =
                Some(AtAttachment { index, start, apart, left: zero, middle, turns: [1.0; 2], rub: zero });
            work.points.push(point);
        }
    }
    share_torques(group, &mut work.points[first..]);
    work.points.len() > first
}

/// Largest `h^2 k / I` with which an attached body turns freely in a step.
const STIFF: f64 = 2.0;

/// Distance of a patch from its point beyond which both are not taken for one place, as a share of
/// the body's size.
const FAR: f64 = 0.1;

/// Share of the relative turn that the friction takes in a step.
const CALM: f64 = 0.5;

/// Largest inverse inertia of a body about an axis, 1/(kg m^2).
fn turns_easily(kernel: &Kernel) -> f64 {
    let inertia = Matrix3::from_fn(|i, j| kernel.model.inertia()[i][j]);
    inertia.try_inverse().map_or(0.0, |inverse| inverse.symmetric_eigenvalues().max())
}

/// Share of a torque that turns a body of this inverse inertia (1/(kg m^2), world axes) in a step,
/// under pulls (N) at arms (m).
fn share(inverse: &Matrix3<f64>, pulls: impl Iterator<Item = (f64, Vector3<f64>)> + Clone, h: f64) -> f64 {
    let own = inverse.symmetric_eigen();
    let axes = own.eigenvectors.column_iter().zip(&own.eigenvalues);
    let times = axes.map(|(axis, light)| {
        let stiff: f64 = pulls.clone().map(|(pull, arm)| pull * arm.cross(&axis).norm()).sum();
        h * h * light * stiff / STIFF
    });
    let most = times.fold(0.0, f64::max);
    if most > 1.0 { 1.0 / most } else { 1.0 }
}

/// Finds the shares of the torques that turn the bodies.
///
/// Pulls `F` at arms `r` hold a body that turns about an axis `n` by the stiffness
/// `k = sum |F| |r x n|` at most. A force that acts at the beginning of the step is stable with it
/// up to `h^2 k / I = 4`, with the inertia `I`. A small body between heavy ones counts as one of as
/// much more inertia (M. Tournier et al., *Stable constrained dynamics*, 2015): a share of the
/// torque turns it.
fn share_torques<P: Member>(group: &Group<'_, P>, points: &mut [ContactPoint]) {
    let h = group.h;
    for number in 0..points.len() {
        let (member, rigid) = (points[number].member, points[number].rigid.map(|far| far.rigid));
        let pull = |point: &ContactPoint| {
            let all = &group.view(point.member).contacts.attachments;
            point.attached.and_then(|at| all.get(at.index)).map_or(0.0, |own| own.largest)
        };
        let view = group.view(member);
        let inertia = view.kernel.before.frame.inertia(&view.kernel.model);
        let of_member = points.iter().filter(|point| point.member == member);
        let own = of_member.map(|point| (pull(point), point.arm));
        let own = if view.moves() { share(&inertia.try_inverse().unwrap_or_default(), own, h) } else { 1.0 };
        let other = rigid.map_or(1.0, |index| {
            let rigid = &group.rigids[index];
            let of_rigid = points.iter().filter(|point| point.rigid.is_some_and(|far| far.rigid == index));
            let pulls = of_rigid.map(|point| (pull(point), point.start - Vector3::from(rigid.center)));
            share(&rigid.inertia(), pulls, h)
        });
        if let Some(at) = &mut points[number].attached {
            at.turns = [own, other];
        }
    }
}

/// Calms rigid bodies that would turn too fast for the step, by friction against the bodies that
/// they are attached to. It keeps the angular momentum.
pub(in super::super) fn rub<P: Member>(group: &mut Group<'_, P>, work: &mut Touching) {
    for number in 0..work.points.len() {
        let point = &work.points[number];
        let (Some(at), Some(far)) = (point.attached, point.rigid) else { continue };
        let view = group.view(point.member);
        if at.turns[1] >= 1.0 || !view.moves() {
            continue;
        }
        let rigid = &group.rigids[far.rigid];
        let of_rigid = |point: &&ContactPoint| point.rigid.is_some_and(|at| at.rigid == far.rigid);
        let calmed = work.points.iter().filter(of_rigid).filter_map(|point| point.attached);
        let calmed: Vector3<f64> = calmed.map(|at| at.rub).sum();
        let [_, turns] = rigid.after(group.h);
        let turns = turns + rigid.spun(&calmed, group.h);
        let about = turns - view.state.frame.angular_velocity(&view.kernel.model);
        // As much as turns both alike.
        let light = rigid.turns_easily() + turns_easily(view.kernel);
        let change = -CALM * (1.0 - at.turns[1]) / light * about;
        if !(light > 0.0 && change.iter().all(|x| x.is_finite())) {
            continue;
        }
        let member = point.member;
        if let Some(at) = &mut work.points[number].attached {
            at.rub = change / group.h;
        }
        group.parts(member).state.frame.shift(Vector3::zeros(), -change);
    }
}

/// Takes the distance of a patch from its point at the end of the computed step. The force acts
/// where the patch is at the beginning: as in SHAKE (J. P. Ryckaert, G. Ciccotti and H. J. C.
/// Berendsen 1977), which keeps the energy of rigid bodies for long times.
pub(super) fn linearize_attached<P: Member>(
    group: &Group<'_, P>,
    point: &mut ContactPoint,
    mut at: AtAttachment,
    recovers: bool,
    settles: bool,
) {
    let view = group.view(point.member);
    let (kernel, state) = (view.kernel, view.state);
    let Some(attachment) = view.contacts.attachments.get(at.index) else { return };
    if let (Some(far), AttachedTo::Rigid { point: local, .. }) = (&point.rigid, attachment.to) {
        point.carried = group.rigids[far.rigid].end(&local.into(), group.h) - at.start;
    }
    point.anchor = at.start + point.carried;
    let (end, tangent) = material(kernel, &attachment.patch, state);
    (point.end, point.place) = (end, end);
    point.comply(kernel.patch_compliance(&attachment.patch, &state.frame, &state.q));
    let (length, most) = (at.apart.norm(), RECOVERY_SPEED * kernel.model.size() * group.h);
    let back = if recovers && length > 0.0 { RECOVERED.min(most / length) } else { 0.0 };
    at.left = (1.0 - back) * at.apart;
    point.off = end - point.anchor - at.left;
    point.attached = Some(at);
    if settles {
        let begun = point.tangent;
        point.mean.get_or_insert_with(|| 0.5 * (begun + tangent));
    }
}
