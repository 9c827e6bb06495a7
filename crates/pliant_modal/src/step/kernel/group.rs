//! The step of bodies that touch obstacles and each other.
//!
//! The step of each body is computed under the contact forces of the step before. The laws of all
//! contacts are solved together on the linearized responses of the bodies, and the steps are
//! computed again under the new forces. Where a body bends or turns within the step, this is
//! repeated. Bodies at rest compute one step.

mod guard;
mod record;

use nalgebra::Vector3;

use guard::gained;

use super::{
    Kernel, points,
    touch::{RowsOfSide, take},
};
use crate::{
    Probe, Rigid, StepError,
    contact::{ContactReport, ContactSites, Contacts, Shape, Sixes, Touching},
    step::{Hand, Load, State, StepReport},
};

/// Largest number of times that a step is computed again with new forces, without hands or rigid
/// bodies and with them.
const ROUNDS: [usize; 2] = [3, 6];

/// Distance below which sites count as candidates, as a share of the body's size.
const BAND: f64 = 2e-3;

/// Tolerances of the laws, as shares of the body's size: that with which forces of the step before
/// are taken as they are, and that with which a step is not computed again.
const STILL: f64 = 1e-12;
const ENOUGH: f64 = 1e-6;

/// Violation of the laws beyond which the end of a step does not say where its forces act, as a
/// share of the size, with rigid bodies and without them, and the number of rounds without it.
const FAR: [f64; 2] = [1e-3, 1e-5];
const BEGINNINGS: usize = 1;

/// Way that the forces on a free body that hold each other would move it in a step if they had one
/// direction, as a share of its size, from which on it is pressed.
const PRESSED: f64 = 0.1;

/// Way of a body's sites up to which it is not found where they are, as a share of its size.
const SLACK: f64 = 1e-3;

/// What a step changes of a body.
pub(crate) struct Parts<'a> {
    pub(crate) kernel: &'a mut Kernel,
    pub(crate) state: &'a mut State,
    pub(crate) hands: &'a mut [Hand],
    pub(crate) load: Load<'a>,
    pub(crate) contacts: &'a mut Contacts,
    pub(crate) report: &'a mut StepReport,
}

/// What a step reads of a body.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    pub(crate) kernel: &'a Kernel,
    pub(crate) state: &'a State,
    pub(crate) hands: &'a [Hand],
    pub(crate) load: Load<'a>,
    pub(crate) contacts: &'a Contacts,
}

/// A body in a group.
pub(crate) trait Member {
    /// What a step changes.
    fn parts(&mut self) -> Parts<'_>;
    /// What a step reads.
    fn view(&self) -> View<'_>;
}

impl<'a> View<'a> {
    /// Whether the frame moves.
    pub(super) fn moves(&self) -> bool {
        self.kernel.model.is_free() && self.load.frame.is_none()
    }

    pub(super) fn sites(&self) -> Option<&'a ContactSites> {
        self.contacts.places.as_deref()
    }
}

/// Some members of a slice, which are stepped together.
pub(super) struct Group<'a, P> {
    pub(super) all: &'a mut [P],
    /// Indices of the members.
    pub(super) who: &'a [usize],
    /// Pairs of members that may touch.
    pub(super) pairs: &'a [[u32; 2]],
    /// The six numbers of the sites of each member, at the beginning and at the end of the step.
    /// Empty for a body alone.
    pub(super) sixes: &'a mut [[Sixes; 2]],
    /// All probes, and the indices of those that touch the members.
    pub(super) probes: &'a mut [Probe],
    pub(super) held: &'a [usize],
    /// All rigid bodies, and the indices of those that may touch the members.
    pub(super) rigids: &'a mut [Rigid],
    pub(super) pushed: &'a [usize],
    /// Size of the smallest member, m.
    pub(super) size: f64,
    pub(super) h: f64,
}

/// What is stepped with the members of a group.
pub(crate) struct Others<'a> {
    /// All probes, and the indices of those that touch the members. They have begun their step.
    pub(crate) probes: &'a mut [Probe],
    pub(crate) held: &'a [usize],
    /// All rigid bodies, and the indices of those that may touch the members.
    pub(crate) rigids: &'a mut [Rigid],
    pub(crate) pushed: &'a [usize],
    /// Length of the step, s.
    pub(crate) h: f64,
}

/// Performs one step of the members `who`, which have the same step length. `pairs` has those that
/// may touch each other, as indices into `who`.
///
/// # Errors
/// Returns the error of an obstacle, or [`StepError::Diverged`] if the result of one member would
/// not be finite. All members then stay as they were.
pub(crate) fn step<P: Member>(
    all: &mut [P],
    who: &[usize],
    pairs: &[[u32; 2]],
    sixes: &mut [[Sixes; 2]],
    Others { probes, held, rigids, pushed, h }: Others<'_>,
    work: &mut Touching,
) -> Result<(), StepError> {
    let size = f64::INFINITY;
    let mut group = Group { all, who, pairs, sixes, probes, held, rigids, pushed, size, h };
    for &probe in held {
        let probe = &mut group.probes[probe];
        probe.contacts.clear();
        group.size = group.size.min(2.0 * probe.config().radius);
    }
    for member in 0..who.len() {
        let parts = group.parts(member);
        parts.kernel.before.clone_from(parts.state);
        parts.contacts.save(parts.hands);
        parts.contacts.list.clear();
        parts.contacts.report = ContactReport::default();
        let (size, h) = (parts.kernel.model.size(), parts.kernel.h);
        group.size = group.size.min(size);
        group.h = h;
    }
    let stepped = group.step(work).and_then(|()| group.check());
    if let Err(error) = stepped {
        for member in 0..who.len() {
            let parts = group.parts(member);
            parts.state.clone_from(&parts.kernel.before);
            parts.contacts.restore(parts.hands);
            parts.contacts.list.clear();
            parts.contacts.report = ContactReport::default();
        }
        held.iter().for_each(|&probe| group.probes[probe].forget());
        pushed.iter().for_each(|&rigid| group.rigids[rigid].forget());
        return Err(error);
    }
    Ok(())
}

impl<P: Member> Group<'_, P> {
    pub(super) fn parts(&mut self, member: usize) -> Parts<'_> {
        self.all[self.who[member]].parts()
    }

    pub(super) fn view(&self, member: usize) -> View<'_> {
        self.all[self.who[member]].view()
    }

    pub(super) fn len(&self) -> usize {
        self.who.len()
    }

    /// A member at the beginning and at the end of the step, as something that others touch.
    pub(super) fn shapes(&self, member: usize) -> Option<[Shape<'_>; 2]> {
        let view = self.view(member);
        let sites = view.sites()?;
        let [before, now] = self.sixes.get(member).map_or([None; 2], |sixes| sixes.each_ref().map(Some));
        let kernel = view.kernel;
        let clouds = [
            before.and_then(Sixes::cloud).map(|cloud| (cloud, 0.0)),
            now.and_then(|_| view.contacts.cloud(&view.state.q)),
        ];
        let before = kernel.shape(sites, &kernel.before, before, clouds[0]);
        Some([before, kernel.shape(sites, view.state, now, clouds[1])])
    }

    /// Finds where all sites of a member are at the beginning of the step.
    pub(super) fn place_start(&mut self, member: usize) {
        let view = self.all[self.who[member]].view();
        let (Some(sites), Some([before, _])) = (view.sites(), self.sixes.get_mut(member)) else { return };
        let kernel = view.kernel;
        before.place_all(sites, sites.field(&kernel.model), &kernel.before.q, kernel.warps());
    }

    /// Finds where all sites of a member are, and adds their way since the last look. A bound
    /// serves for small ways.
    pub(super) fn follow_sites(&mut self, member: usize) {
        let Parts { kernel, state, contacts, .. } = self.parts(member);
        let Some(sites) = contacts.places.clone() else { return };
        let (bent, size) = (&mut contacts.bent, kernel.model.size());
        let known = bent.q.len() == state.q.len() && bent.cloud.sites.len() == sites.sites.len();
        let way = if known { sites.travel_bound(&bent.q, &state.q) } else { f64::INFINITY };
        let near = bent.slack + way <= SLACK * size;
        if near {
            bent.slack += way;
            bent.way += way;
        } else {
            let mut now = std::mem::take(&mut bent.spare);
            sites.place(sites.field(&kernel.model), &state.q, kernel.warps(), &mut now);
            // A body that was not known has gone farther than any clearance.
            let way = now.way(&bent.cloud);
            bent.way += bent.slack + if way.is_finite() { way } else { 1e3 * size };
            bent.slack = 0.0;
            bent.spare = std::mem::replace(&mut bent.cloud, now);
        }
        bent.q.clone_from(&state.q);
    }

    /// Checks that the result is finite.
    fn check(&self) -> Result<(), StepError> {
        for member in 0..self.len() {
            let View { state, hands, .. } = self.view(member);
            let sound = |hand: &Hand| {
                hand.pull.iter().chain(&hand.mean).chain(&hand.viscoelastic).all(|x| x.is_finite())
            };
            let reaction = (!hands.iter().all(sound)).then_some("a reaction");
            if let Some(what) = state.non_finite().or(reaction) {
                return Err(StepError::Diverged { what });
            }
        }
        let sound = self.held.iter().all(|&index| self.probes[index].is_finite());
        if sound { Ok(()) } else { Err(StepError::Diverged { what: "a probe" }) }
    }

    fn step(&mut self, work: &mut Touching) -> Result<(), StepError> {
        work.points.clear();
        work.sweeps = 0;
        let (mut most_sites, touched) = (0, !self.held.is_empty());
        for member in 0..self.len() {
            let alone = self.len() == 1;
            let Parts { kernel, contacts, .. } = self.parts(member);
            if alone && !touched && contacts.are_none() {
                contacts.memory.clear();
                self.advance(work, 0.5);
                return Ok(());
            }
            if contacts.places.is_none() || contacts.modes != kernel.modes.count() {
                kernel.prepare_contacts(contacts)?;
            }
            let sites = contacts.sites();
            most_sites = most_sites.max(sites);
            if let Some(sixes) = self.sixes.get_mut(member) {
                sixes.iter_mut().for_each(|sixes| sixes.prepare(sites));
            }
        }
        work.marks.clear();
        work.marks.resize(most_sites, 0);
        work.stamp = 0;
        // A contact that goes on keeps its weight.
        let held = |view: View<'_>| (!view.contacts.memory.is_empty()).then_some(view.contacts.theta);
        let mut theta = (0..self.len()).filter_map(|member| held(self.view(member))).reduce(f64::max);
        points::begin(self, work)?;
        points::begin_probes(self, work)?;
        if points::begin_attached(self, work) {
            // The way of a frame that is held at a point is stable with this weight alone, and
            // keeps the energy.
            theta = Some(1.0);
        }
        let known = work.points.len();
        points::begin_supports(self, work);
        points::support(self, work, true);
        let mut report = self.attempt(work, &mut theta, true)?;
        if !work.points.is_empty() && gained(work, true) {
            // The forces of the step before, and no others, begin the step anew.
            work.points.truncate(known);
            theta = Some(1.0);
            let rounds = report.rounds;
            points::begin(self, work)?;
            points::begin_probes(self, work)?;
            points::begin_attached(self, work);
            points::support(self, work, true);
            report = self.attempt(work, &mut theta, false)?;
            report.rounds += rounds;
            report.guarded = true;
        }
        if self.tears(work) {
            // They let go for this step, and draw again from the next one on.
            work.points.retain(|point| point.attached.is_none());
            for &index in self.pushed {
                self.rigids[index].supports.iter_mut().for_each(|support| support.force = 0.0);
            }
            points::support(self, work, true);
            let rounds = report.rounds;
            report = self.attempt(work, &mut theta, false)?;
            report.rounds += rounds;
            report.guarded = true;
        }
        report.guarded |= self.stop_torn(work);
        report.guarded |= self.cap_energy(work);
        points::drill(self, work);
        points::rub(self, work);
        report.sweeps = work.sweeps;
        self.end(work, theta.unwrap_or(0.5), &report);
        Ok(())
    }

    /// Sets the arms of the contacts between members, both to the same point.
    fn set_arms(&self, work: &mut Touching, theta: f64) {
        for point in &mut work.points {
            if let Some(far) = &mut point.far {
                point.arm = far.middle - self.view(point.member).kernel.pivot(theta);
                far.arm = far.middle - self.view(far.member).kernel.pivot(theta);
            }
            points::set_arms(self, point, theta);
        }
    }

    /// Computes the steps of all members under the forces of the points.
    fn advance(&mut self, work: &mut Touching, theta: f64) {
        self.set_arms(work, theta);
        self.sixes.iter().for_each(|[_, end]| end.forget());
        for member in 0..self.len() {
            let Parts { kernel, state, hands, load, contacts, report } = self.parts(member);
            state.clone_from(&kernel.before);
            contacts.restore(hands);
            kernel.begin_push(theta, false);
            if let Some(sites) = contacts.places.as_deref() {
                for point in &work.points {
                    let near = point.member == member;
                    let held = point.probe.as_ref().and_then(|probe| probe.first.as_ref());
                    let far = point.far.as_ref().filter(|far| far.member == member);
                    if !near && far.is_none() {
                        continue;
                    }
                    kernel.push.is_on = true;
                    let force = point.world_force();
                    if force == Vector3::zeros() {
                        continue;
                    }
                    if let Some(far) = far {
                        let tangent = far.mean.unwrap_or(far.tangent);
                        kernel.add_push(sites.patches(far.carriers.iter()), &tangent, &far.arm, &-force);
                        continue;
                    }
                    let (tangent, arm) = (point.mean.unwrap_or(point.tangent), &point.arm);
                    if let Some((_, carriers)) = held {
                        kernel.add_push(sites.patches(carriers.iter()), &tangent, arm, &force);
                    } else if let Some(at) = point.attached {
                        let patch = contacts.attachments.get(at.index).map(|own| (&*own.patch, 1.0));
                        kernel.add_push(patch.into_iter(), &tangent, &(at.turns[0] * arm), &force);
                    } else {
                        kernel.add_push(sites.patches(point.carriers()), &tangent, arm, &force);
                    }
                }
            }
            *report = kernel.advance(state, hands, &load);
            kernel.push.is_on = false;
        }
        for &index in self.held {
            let [force, torque] = points::pull_on_probe(&work.points, index);
            self.probes[index].respond(&force, &torque);
        }
        points::respond(self, work, theta);
    }

    /// Computes the step until the laws of contact hold.
    fn attempt(
        &mut self,
        work: &mut Touching,
        theta: &mut Option<f64>,
        recovers: bool,
    ) -> Result<ContactReport, StepError> {
        let hands = (0..self.len()).any(|member| !self.view(member).hands.is_empty());
        let holds = hands || !self.pushed.is_empty();
        let mut rounds = ROUNDS[usize::from(holds)];
        let mut report = ContactReport::default();
        // Forces between heavy bodies turn a light one between them far when they are not in
        // balance, as those of the step before are not. They act where the step begins until the
        // result is near. So do those on a pressed body, whose error would grow from step to step.
        let pressed = self.is_pressed(work);
        let mut settled = self.pushed.is_empty() && !pressed;
        let far = FAR[usize::from(self.pushed.is_empty())] * self.size;
        loop {
            let weight = theta.unwrap_or(0.5);
            self.advance(work, weight);
            report.rounds += 1;
            let round = report.rounds;
            if (0..self.len()).any(|member| !self.view(member).state.is_finite()) {
                work.points.clear();
                return Ok(report);
            }
            let band = if round == 1 { BAND * self.size } else { 0.0 };
            let (mut new, candidates) = points::detect(self, work, band)?;
            new |= points::detect_probes(self, work, round == 1)?;
            points::support(self, work, false);
            report.candidates += candidates;
            points::linearize(self, work, recovers, settled)?;
            report.residual = work.violation();
            let mut fresh = false;
            if !settled && (report.residual <= far || round > BEGINNINGS) {
                settled = true;
                // The next round has the forces there.
                fresh = pressed && round > 1;
                rounds += usize::from(fresh);
                points::linearize(self, work, recovers, settled)?;
            }
            let enough = if round == 1 { STILL } else { ENOUGH } * self.size;
            if work.points.is_empty() || (report.residual <= enough && !new && !fresh) || round > rounds {
                points::take_supports(self, work);
                return Ok(report);
            }
            self.set_arms(work, weight);
            self.fill_rows(work);
            work.begin_dents();
            if theta.is_none() && recovers {
                let ratio = work.rigid_share();
                // A soft contact is stepped nearly without loss. A stiff one would ring.
                *theta = Some(0.5 + 0.5 * ratio / (ratio + 16.0));
            }
            self.hold_rows(work, theta.unwrap_or(0.5));
            work.solve((1e-3 * report.residual).max(1e-13 * self.size));
            for point in &mut work.points {
                point.pushed = point.force;
            }
        }
    }

    /// Whether the forces with which the step of a free body alone begins hold each other, and
    /// would move it far if they did not.
    ///
    /// Their arms are those of a state that is computed under them. An error of the arms turns the
    /// body, and comes back in the arms of the next step, the larger the larger
    /// `h^2 sum |f| / (m size)` is.
    fn is_pressed(&self, work: &Touching) -> bool {
        if self.len() != 1 || !self.view(0).moves() {
            return false;
        }
        let (mut sum, mut all) = (0.0, Vector3::zeros());
        for point in work.points.iter().filter(|point| point.member == 0) {
            sum += point.pushed.norm();
            all += point.world_force();
        }
        let model = &self.view(0).kernel.model;
        // Forces that are not opposite to each other push the body and do not press it.
        self.h * self.h * (sum - all.norm()) > PRESSED * model.mass() * model.size()
    }

    /// Writes the rows of all points.
    fn fill_rows(&self, work: &mut Touching) {
        let bodies = (0..self.len()).map(|member| self.view(member).kernel.modes() + 6);
        let probes = self.held.iter().map(|&index| self.probes[index].width());
        let others = probes.chain(self.pushed.iter().map(|_| 6));
        work.lay_out(bodies.chain(others), self.len()..self.len() + self.held.len());
        work.lay_out_rows();
        for member in 0..self.len() {
            let view = self.view(member);
            let Some(sites) = view.sites() else { continue };
            let width = work.spans[member].width;
            let spin = view.moves().then(|| view.kernel.spin_root(&view.state.frame));
            for (point, sides) in work.points.iter().zip(&work.sides) {
                if point.member == member
                    && let Some(side) = &sides[0]
                {
                    let tangent = point.mean.unwrap_or(point.tangent);
                    let arm = point.attached.map_or(1.0, |at| at.turns[0].sqrt()) * point.arm;
                    let of = RowsOfSide { axes: point.axes, tangent, arm, spin: spin.as_ref() };
                    let rows = &mut work.rows[side.rows..][..3 * width];
                    match point.probe.as_ref().and_then(|probe| probe.first.as_ref()) {
                        Some((_, carriers)) => {
                            view.kernel.fill_rows(sites.patches(carriers.iter()), &of, rows);
                        }
                        None if point.attached.is_some() => {
                            let own = point.attached.and_then(|at| view.contacts.attachments.get(at.index));
                            view.kernel.fill_rows(own.map(|own| (&*own.patch, 1.0)).into_iter(), &of, rows);
                        }
                        None => view.kernel.fill_rows(sites.patches(point.carriers()), &of, rows),
                    }
                }
                if let (Some(far), Some(side)) = (&point.far, &sides[1])
                    && far.member == member
                {
                    let tangent = far.mean.unwrap_or(far.tangent);
                    let of = RowsOfSide { axes: -point.axes, tangent, arm: far.arm, spin: spin.as_ref() };
                    let rows = &mut work.rows[side.rows..][..3 * width];
                    view.kernel.fill_rows(sites.patches(far.carriers.iter()), &of, rows);
                }
            }
        }
        points::fill_probe_rows(self.probes, work);
        points::fill_rows(self.rigids, work, self.h);
    }

    /// Weighs the rows of the frames, and takes from all rows what the hands hold back, so that the
    /// responses are those of the held bodies.
    fn hold_rows(&self, work: &mut Touching, theta: f64) {
        let scale = theta.sqrt();
        for member in 0..self.len() {
            let view = self.view(member);
            let width = work.spans[member].width;
            let spin = view.moves().then(|| view.kernel.spin_root(&view.state.frame));
            view.kernel.held_rows(view.state, view.hands, spin.as_ref(), &mut work.held);
            for side in work.sides.iter().flatten().flatten().filter(|side| side.member == member) {
                for row in work.rows[side.rows..][..3 * width].chunks_exact_mut(width) {
                    row[width - 6..].iter_mut().for_each(|x| *x *= scale);
                    work.held.chunks_exact(width).for_each(|w| take(w, row));
                }
            }
        }
        let rigids = self.len() + self.held.len();
        for side in work.sides.iter().flatten().flatten().filter(|side| side.member >= rigids) {
            work.rows[side.rows..][..18].iter_mut().for_each(|x| *x *= scale);
        }
    }
}
