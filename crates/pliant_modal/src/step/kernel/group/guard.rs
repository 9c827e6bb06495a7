//! What keeps a step with contacts from adding energy, and from letting bodies through each other.

use nalgebra::{Matrix3, Vector3};

use super::{Group, Member, Parts, View};
use crate::{
    contact::{ContactPoint, Touching},
    step::{
        Frame, Load, State,
        kernel::{Kernel, points},
    },
};

/// Violation of the laws beyond which bodies that have passed through each other are stopped, as a
/// share of the size.
const TORN: f64 = 0.05;

/// Share of the kinetic and elastic energy that a step may gain of what contacts have lost before.
const GIVEN_BACK: f64 = 1e-2;

impl<P: Member> Group<'_, P> {
    /// Takes the energy that the step has gained from the velocities. Returns whether it had any.
    ///
    /// The work of the contacts is right to second order in the way of a step. Bodies that turn or
    /// bend far within one step may still gain. Hands and loads do work of their own, and a
    /// material that relaxes stores energy that is not counted here: such steps are not checked.
    pub(super) fn cap_energy(&mut self, work: &mut Touching) -> bool {
        if !work.points.iter().any(ContactPoint::acts) {
            return false;
        }
        let (mut moving, mut gained, mut scale, mut lost, mut slow) = (0.0, 0.0, 0.0, 0.0, 0.0);
        // A probe does the work of a hand.
        if work.points.iter().any(|point| point.probe.is_some() && point.acts()) {
            return false;
        }
        // A rigid body keeps what it has been given, whatever becomes of the members.
        let fixed = |point: &ContactPoint| point.far.is_none() && point.rigid.is_none();
        let mut grounded = work.points.iter().any(|point| fixed(point) && point.acts());
        for member in 0..self.len() {
            let View { kernel, state, hands, load, contacts } = self.view(member);
            let other = Load { modal: load.modal, ..Load::default() } != load;
            let loaded = other || load.modal.iter().any(|load| *load != 0.0);
            if loaded || !hands.is_empty() || kernel.modes.is_viscous() || !state.is_finite() {
                return false;
            }
            grounded |= !kernel.model.is_free();
            let at_rest = |state: &State| kernel.elastic_energy(state) + kernel.potential_energy(state);
            let (now, before) = (kernel.kinetic_energy(state), kernel.kinetic_energy(&kernel.before));
            moving += now;
            gained += now - before + at_rest(state) - at_rest(&kernel.before);
            scale += now + before;
            scale += kernel.elastic_energy(state) + kernel.elastic_energy(&kernel.before);
            lost += contacts.lost;
            let speed = points::RECOVERY_SPEED * kernel.model.size();
            let gravity = Vector3::from(kernel.settings.gravity).norm();
            slow += kernel.model.mass() * speed * (0.5 * speed + gravity * self.h);
        }
        let mut recovered = 0.0;
        for point in &work.points {
            let force = point.world_force();
            let (now, before) = (point.stored(&force), point.stored_before);
            scale += now + before;
            gained += now - before;
            // What pushes a body out that was set into something.
            let out = point.recovery();
            if point.far.is_none() {
                // What the obstacles supply.
                gained -= force.dot(&point.carried) + out;
            } else {
                recovered += out;
            }
        }
        // Between bodies it may cost what moves them at the speed of the recovery against gravity,
        // and what was lost before pays for it first.
        let recovered = recovered.min(slow);
        gained -= recovered;
        lost -= recovered.min(lost).max(0.0);
        // A step may take back a little of what the steps before have lost: a rolling ball loses
        // and gains in turn, and would slow down if only the gains were taken.
        let allowed = lost.min(GIVEN_BACK * scale);
        let mut lost = lost - gained.min(allowed);
        if self.len() == 1 {
            lost = lost.min(scale);
        }
        let lost = lost / self.len() as f64;
        let gained = gained - allowed;
        // Bodies that touch nothing else keep their common momentum.
        let common = if grounded { Common::default() } else { Common::of(self, &|_| true) };
        moving -= common.energy;
        for member in 0..self.len() {
            self.parts(member).contacts.lost = lost;
        }
        if gained > moving && gained > 1e-3 * scale {
            // The velocities cannot pay for it. The bodies stop where the step began.
            let (count, taken) = (self.len() as f64, self.stop(|_| true, grounded));
            for member in 0..self.len() {
                self.parts(member).contacts.lost += (taken + allowed) / count;
            }
            // What stopped the members stops a rigid body too, which would fall through them.
            work.points.retain(|point| grounded && point.rigid.is_some());
            true
        } else if gained > 1e-12 * scale && moving > 0.0 {
            let left = (1.0 - gained / moving).max(0.0).sqrt();
            for member in 0..self.len() {
                let Parts { kernel, state, .. } = self.parts(member);
                common.slow(kernel, state, left);
            }
            true
        } else {
            false
        }
    }

    /// Puts some members back to where the step began, with nothing but the rigid motion that has
    /// their common momentum, or without any motion if they touch the ground. Returns the kinetic
    /// energy that they lose, J.
    fn stop(&mut self, stops: impl Fn(usize) -> bool, grounded: bool) -> f64 {
        let mut before = 0.0;
        for member in (0..self.len()).filter(|&member| stops(member)) {
            let Parts { kernel, state, hands, contacts, .. } = self.parts(member);
            state.clone_from(&kernel.before);
            contacts.restore(hands);
            before += kernel.kinetic_energy(state);
        }
        // The rigid motion with a momentum never has more energy than the bodies that have it.
        let common = if grounded { Common::default() } else { Common::of(self, &stops) };
        for member in (0..self.len()).filter(|&member| stops(member)) {
            let Parts { kernel, state, .. } = self.parts(member);
            common.slow(kernel, state, 0.0);
            before -= kernel.kinetic_energy(state);
        }
        before
    }

    /// Stops the members that would pass through each other, because the laws could not be solved
    /// for a hard impulse. Returns whether there are any.
    pub(super) fn stop_torn(&mut self, work: &mut Touching) -> bool {
        let torn = |point: &ContactPoint| {
            point.far.as_ref().filter(|far| far.passed && point.violation() > TORN * self.size).is_some()
        };
        if !work.points.iter().any(torn) {
            return false;
        }
        let mut marks = std::mem::take(&mut work.marks);
        marks.clear();
        marks.resize(self.len(), 0);
        let mut grounded = false;
        for point in work.points.iter().filter(|point| torn(point)) {
            for member in [Some(point.member), point.far.map(|far| far.member)].into_iter().flatten() {
                marks[member] = 1;
                grounded |= !self.view(member).kernel.model.is_free();
            }
        }
        self.stop(|member| marks[member] == 1, grounded);
        let stopped = |point: &ContactPoint| {
            marks[point.member] == 1 || point.far.is_some_and(|far| marks[far.member] == 1)
        };
        work.points.retain(|point| !stopped(point));
        work.marks = marks;
        true
    }
}

/// Violation of an attachment beyond which it lets go for a step, as a share of the size.
const TORN_OFF: f64 = 1e-2;

/// Energy that what is attached may gain in a step, as a share of what moves and is stored.
const GAINED: f64 = 0.02;

/// Share of the energy of a recovery against gravity that a step may supply to draw together what
/// is apart.
const DRAWN: f64 = 0.1;

impl<P: Member> Group<'_, P> {
    /// Whether the laws of the attachments could not be solved, or what is attached would gain
    /// more energy than it may. Where hands or loads act, the energy does not count.
    pub(super) fn tears(&self, work: &Touching) -> bool {
        let mut attached = work.points.iter().filter(|point| point.attached.is_some()).peekable();
        if attached.peek().is_none() {
            return false;
        }
        // Comparisons with no number are false, and such a step is torn.
        if !attached.all(|point| point.violation() <= TORN_OFF * self.size) {
            return true;
        }
        let (mut gained, mut scale, mut slow) = (0.0, 0.0, 0.0);
        for member in 0..self.len() {
            let View { kernel, state, hands, load, .. } = self.view(member);
            let other = Load { modal: load.modal, ..Load::default() } != load;
            let loaded = other || load.modal.iter().any(|load| *load != 0.0);
            if loaded || !hands.is_empty() || kernel.modes.is_viscous() {
                return false;
            }
            let before = &kernel.before;
            let moving = [kernel.kinetic_energy(before), kernel.kinetic_energy(state)];
            let bent = [kernel.elastic_energy(before), kernel.elastic_energy(state)];
            gained += moving[1] - moving[0] + bent[1] - bent[0];
            gained += kernel.potential_energy(state) - kernel.potential_energy(before);
            scale += moving.iter().chain(&bent).sum::<f64>();
            let own = work.points.iter().find(|point| point.member == member);
            let share = own.and_then(|point| point.attached).map_or(1.0, |at| at.turns[0]);
            if share < 1.0 && kernel.model.is_free() {
                // A body that a share of a torque turns counts with as much more inertia.
                let turning = |state: &State| {
                    let spin = Vector3::from(state.frame.spin());
                    0.5 * spin.dot(&state.frame.angular_velocity(&kernel.model))
                };
                gained += (1.0 / share - 1.0) * (turning(state) - turning(before));
            }
            let gravity = Vector3::from(kernel.settings.gravity).norm();
            slow += slowly(kernel.model.mass(), gravity, [self.size, self.h]);
        }
        for &index in self.pushed {
            let rigid = &self.rigids[index];
            let own = work.points.iter().find(|point| point.rigid.is_some_and(|at| at.rigid == index));
            let share = own.and_then(|point| point.attached).map_or(1.0, |at| at.turns[1]);
            let [change, moving] = rigid.gain(share, self.h);
            gained += change;
            scale += moving;
            slow += slowly(rigid.mass(), Vector3::from(rigid.acceleration).norm(), [self.size, self.h]);
        }
        let mut recovered = 0.0;
        for point in &work.points {
            let force = point.world_force();
            gained += point.stored(&force) - point.stored_before;
            scale += point.stored(&force) + point.stored_before;
            recovered += point.recovery();
            if point.far.is_none() && point.rigid.is_none() {
                gained -= force.dot(&point.carried);
            }
        }
        gained -= recovered.min(DRAWN * slow);
        let calm = gained <= GAINED * scale;
        !calm
    }
}

/// Energy that moves a mass (kg) at the speed of the recovery against gravity (m/s^2) in a step, J.
fn slowly(mass: f64, gravity: f64, [size, h]: [f64; 2]) -> f64 {
    let speed = points::RECOVERY_SPEED * size;
    mass * speed * (0.5 * speed + gravity * h)
}

/// Whether the contacts did more work on the bodies than they are allowed to.
pub(super) fn gained(work: &Touching, recovers: bool) -> bool {
    let (mut done, mut allowed, mut scale) = (0.0, 0.0, 0.0f64);
    // An attachment takes as much as it gives, and what is amiss of its law has either sign.
    for point in work.points.iter().filter(|point| point.attached.is_none()) {
        let force = point.world_force();
        let along = force.dot(&(point.end - point.start - point.carried)) + point.rolled(&force);
        // A dent that turns with the site is no work of the contact.
        let (stored, before) = (point.stored(&force), point.stored(&point.before));
        done += along + stored - before;
        scale += along.abs() + stored + before;
        if recovers {
            allowed += point.recovery();
        }
    }
    done > 1.5 * allowed + 1e-9 * scale
}

/// The rigid motion that has the momentum of all members.
#[derive(Debug, Clone, Copy, Default)]
struct Common {
    center: Vector3<f64>,
    velocity: Vector3<f64>,
    spin: Vector3<f64>,
    /// Kinetic energy, J.
    energy: f64,
}

impl Common {
    pub(super) fn of<P: Member>(group: &Group<'_, P>, counts: &impl Fn(usize) -> bool) -> Self {
        let (mut mass, mut center, mut linear) = (0.0, Vector3::zeros(), Vector3::zeros());
        for member in (0..group.len()).filter(|&member| counts(member)) {
            let View { kernel, state, .. } = group.view(member);
            let own = kernel.model.mass();
            mass += own;
            center += own * Vector3::from(state.frame.center());
            linear += own * Vector3::from(state.frame.velocity());
        }
        let (center, velocity) = (center / mass, linear / mass);
        let (mut inertia, mut angular) = (Matrix3::zeros(), Vector3::zeros());
        for member in (0..group.len()).filter(|&member| counts(member)) {
            let View { kernel, state, .. } = group.view(member);
            let arm = Vector3::from(state.frame.center()) - center;
            let momentum = kernel.model.mass() * (Vector3::from(state.frame.velocity()) - velocity);
            angular += Vector3::from(state.frame.spin()) + arm.cross(&momentum);
            let outer = Matrix3::identity() * arm.norm_squared() - arm * arm.transpose();
            inertia += state.frame.inertia(&kernel.model) + kernel.model.mass() * outer;
        }
        let spin = inertia.try_inverse().map_or_else(Vector3::zeros, |inverse| inverse * angular);
        let energy = 0.5 * mass * velocity.norm_squared() + 0.5 * spin.dot(&angular);
        Self { center, velocity, spin, energy }
    }

    /// Multiplies all motion of a body besides this one.
    fn slow(&self, kernel: &Kernel, state: &mut State, left: f64) {
        state.v.iter_mut().for_each(|v| *v *= left);
        if kernel.model.is_free() {
            let frame: &mut Frame = &mut state.frame;
            let arm = Vector3::from(frame.center()) - self.center;
            let velocity = self.velocity + self.spin.cross(&arm);
            let spin = frame.inertia(&kernel.model) * self.spin;
            frame.slow_to(&velocity, &spin, left);
        }
    }
}
