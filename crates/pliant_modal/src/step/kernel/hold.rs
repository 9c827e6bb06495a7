//! The hands of a step: all their forces in one solve, implicitly.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::{Kernel, Solving, StepReport};
use crate::{
    HeldShapes,
    step::{
        Frame, Hand, Hold, RigidMotion, State, StepSettings, constraint::ViscoelasticPatch,
        elastic::RoundTangent, patch::tangent, predicted_frame::PredictedFrame,
    },
};

/// Compliance of a hand with these shapes of held patches, turned with its patch at the coordinates
/// `q`.
fn turned(
    creep: &ViscoelasticPatch,
    shapes: Option<&Arc<HeldShapes>>,
    hand: &Hand,
    q: &[f64],
) -> Matrix3<f64> {
    let own = shapes.and_then(|shapes| shapes.residual(&hand.patch));
    let turn = hand.patch.rotation(q);
    turn * creep.compliance(hand, own.unwrap_or_else(|| hand.patch.residual())) * turn.transpose()
}

impl Kernel {
    /// Where a state has the point of a patch that the hand holds under the force of the last step,
    /// as a displacement from rest, m, body axes. The hand's own spring counts too.
    pub(crate) fn hand_point(&self, hand: &Hand, state: &State) -> Vector3<f64> {
        let own = self.held_shapes().map(|shapes| shapes.displacement(&hand.patch, &state.s));
        let modal = hand.patch.displacement(&state.q, self.warps());
        let force = state.frame.rotation().inverse() * hand.mean;
        modal + own.unwrap_or_default() + self.compliance(hand, &state.q) * force
    }

    /// Compliance of a hand within one step besides the modes, 3x3, m/N, body axes.
    ///
    /// It is the residual flexibility of the patch plus the compliance of the hand's own spring.
    /// Where the material is viscoelastic, the residual flexibility is multiplied by
    /// [`Relaxation::creep`](crate::Relaxation::creep) of one step. With reduced elasticity it
    /// turns with the patch at the coordinates `q`.
    pub fn compliance(&self, hand: &Hand, q: &[f64]) -> Matrix3<f64> {
        if self.elastic.is_some() {
            turned(&self.creep, self.held_shapes(), hand, q)
        } else {
            self.creep.compliance(hand, hand.patch.residual())
        }
    }

    /// Returns the viscoelastic state of a hand's patch after one step under a force `pull`
    /// (N, body axes).
    pub fn viscoelastic_after(&self, hand: &Hand, pull: Vector3<f64>) -> Vector3<f64> {
        self.creep.step(hand, &pull)
    }

    /// Solves for the forces of all hands and adds their effect to the state.
    ///
    /// `weight` is the force of gravity and loads on a free body (N, world axes), if nothing else
    /// acts on its frame.
    pub(super) fn hold(
        &mut self,
        state: &mut State,
        hands: &mut [Hand],
        mut rigid: Option<RigidMotion>,
        weight: Option<Vector3<f64>>,
    ) -> StepReport {
        self.prepare(hands);
        self.begin(state, hands);
        let most = StepSettings::MAX_CORRECTIONS;
        let (warp, curved) = (self.warps(), self.warps() || self.elastic.is_some());
        let rounds = if curved { self.settings.corrections.clamp(1, most) } else { 1 };
        let mut report = StepReport::default();
        let mut place = PredictedFrame::unheld(state.frame);
        let (mut round, mut tangent_of) = (0, RoundTangent::First);
        loop {
            self.linearize(hands, tangent_of);
            let center = Vector3::from(self.model.center_of_mass());
            for (solving, hand) in self.solving.iter_mut().zip(hands.iter()) {
                // Each round linearizes where the previous round ended.
                (solving.at, solving.tangent) = tangent(&solving.from, warp);
                solving.arm = hand.patch.rest() + solving.at - center;
                // The forces of the previous round change axes here. In the first round these are
                // the forces of the previous step, in world axes.
                solving.pull = place.axes * solving.pull;
            }
            if let Some(rigid) = &mut rigid {
                rigid.tighten(&self.model, self.solving.iter().map(|s| (s.arm, s.pull)));
            }
            report.regularized = self.solve(&state.frame, hands, &place, rigid.as_ref());
            round += 1;
            let mut last = round >= rounds;
            if let Some(elastic) = &mut self.elastic {
                let patches = hands.iter().map(|hand| &*hand.patch);
                let far = elastic.finish_round(patches.zip(self.solving.iter().map(|s| s.pull)));
                report.projected = elastic.raised();
                // A tangent serves two rounds, unless the first went far. Such a step goes on.
                let keep = !far && tangent_of != RoundTangent::Kept;
                tangent_of = if keep { RoundTangent::Kept } else { RoundTangent::New };
                last &= !far || round >= most;
            }
            if last {
                break;
            }
            if self.elastic.is_none() {
                for (i, solving) in self.solving.iter_mut().enumerate() {
                    solving.from = solving.free + self.responses.answer(i, &self.forces);
                }
            }
            if let Some(rigid) = &rigid {
                place = place.moved(&state.frame, &self.model, rigid, self.total(&place));
            }
        }
        self.pulls.fill(0.0);
        for (hand, forces) in hands.iter().zip(&self.forces) {
            hand.patch.rows().spread(forces, warp, &mut self.pulls);
        }
        let [force, torque] = self.total(&place);
        let unheld = state.frame;
        if let Some(rigid) = &rigid {
            rigid.apply(&mut state.frame, &self.model, force, torque + place.slack(rigid));
        }
        if let Some(elastic) = &mut self.elastic {
            let shapes = elastic.shapes();
            // What a hand stores in its spring and in the residual flexibility of its patch, J.
            // That turns with the patch, and must not give back more than it got.
            let stored = |hand: &Hand, q: &[f64], force: &Vector3<f64>| {
                0.5 * force.dot(&(turned(&self.creep, shapes, hand, q) * force))
            };
            let back = self.before.frame.rotation().inverse();
            let released = |hand: &Hand, solving: &Solving| {
                stored(hand, &self.before.q, &(back * hand.mean))
                    - stored(hand, elastic.coordinates(), &solving.pull)
            };
            let both = || hands.iter().zip(&self.solving);
            // The work of a hand by the way of its target. Just after it has taken hold, its target
            // has no way.
            let led = |(hand, solving): (&Hand, &Solving)| match hand.hold {
                Hold::Target { velocity, .. } if hand.mean != Vector3::zeros() => {
                    let way = self.h * solving.pull.dot(&(place.back * velocity));
                    Some(way + released(hand, solving))
                }
                _ => None,
            };
            let on_shape =
                |hand: &Hand, solving: &Solving| solving.pull.dot(&elastic.patch_displacement(&hand.patch));
            let supplied = match (&rigid, weight) {
                // What moves the frame of a free body does not deform it. The way of the frame that
                // the hands cause is one in the load, too.
                (Some(rigid), Some(weight)) if both().all(|(hand, solving)| solving.is_plain(hand)) => {
                    let gained = |frame: &Frame| frame.kinetic_energy(&self.model);
                    let carried = gained(&state.frame) - gained(&unheld) - weight.dot(&rigid.way(force));
                    both().map(led).sum::<Option<f64>>().map(|supplied| supplied - carried)
                }
                _ => None,
            };
            let supplied = supplied.unwrap_or_else(|| {
                let work = |(hand, solving)| match led((hand, solving)) {
                    Some(work) if !self.model.is_free() => work,
                    _ => on_shape(hand, solving),
                };
                both().map(work).sum()
            });
            elastic.finish(&self.before, supplied, &mut self.force, state);
        } else {
            self.modes.respond(&self.pulls, state);
            for (f, pull) in self.force.iter_mut().zip(&self.pulls) {
                *f += pull;
            }
        }
        for (hand, solving) in hands.iter_mut().zip(&self.solving) {
            hand.viscoelastic = self.creep.step(hand, &solving.pull);
            // The solve uses body axes, and hands use world axes.
            let mean = place.turn * solving.pull;
            hand.pull = mean + solving.beyond * (mean - hand.mean);
            hand.mean = mean;
        }
        report
    }

    /// Initializes the rounds of a step: the patch positions, and those after the step without
    /// hands.
    fn begin(&mut self, state: &mut State, hands: &[Hand]) {
        let warp = self.warps();
        let beyond = self.settings.extrapolation(&self.model, state.modes(), hands.len());
        if let Some(elastic) = &mut self.elastic {
            let relaxed = hands.iter().map(|hand| (&*hand.patch, self.creep.relaxed_force(hand)));
            elastic.begin(&self.before, &self.modes, &self.force, relaxed, state);
        }
        self.solving.clear();
        for hand in hands {
            let mut solving = Solving {
                free: hand.patch.rows().reduce(&state.q, warp),
                from: hand.patch.rows().reduce(&self.before.q, warp),
                compliance: self.creep.compliance(hand, hand.patch.residual()),
                beyond,
                pull: hand.mean,
                ..Solving::default()
            };
            if let Hold::Target { target, velocity, config } = hand.hold {
                solving.target = target;
                // Targets may teleport, and their velocity is then meaningless.
                solving.lead = (config.relaxation * velocity).cap_magnitude(2.0 * self.model.size());
                solving.creep_displacement = match &self.elastic {
                    Some(elastic) => {
                        let turn = hand.patch.rotation(&self.before.q);
                        let own = elastic.shapes().and_then(|shapes| shapes.residual(&hand.patch));
                        let own = own.unwrap_or_else(|| hand.patch.residual());
                        self.creep.creep_of(hand, &(turn * own * turn.transpose()))
                    }
                    None => self.creep.creep_displacement(&hand.viscoelastic),
                };
                solving.relaxation = config.relaxation;
                solving.speed = (solving.free - solving.from) / self.h;
            }
            self.solving.push(solving);
        }
    }

    /// Linearizes the elasticity at the present coordinates, with the hands' places and responses
    /// on that tangent. Linear elasticity has no need of it.
    ///
    /// Every second round keeps the tangent of the round before, and only its force is new.
    fn linearize(&mut self, hands: &[Hand], tangent: RoundTangent) {
        let Some(elastic) = &mut self.elastic else { return };
        elastic.linearize(tangent);
        for (i, (solving, hand)) in self.solving.iter_mut().zip(hands).enumerate() {
            solving.free = elastic.without_hands(&hand.patch);
            solving.from = solving.free;
            if solving.relaxation > 0.0 {
                solving.speed = (solving.free - elastic.at_beginning(&hand.patch)) / self.h;
            }
            if tangent != RoundTangent::Kept {
                solving.compliance = turned(&self.creep, elastic.shapes(), hand, elastic.coordinates());
                elastic.add_hand(&hand.patch);
                for j in 0..=i {
                    self.responses.set(i, j, &elastic.response(i, j));
                }
            }
        }
    }

    /// Solves one round for the forces on the tangent, for a frame in `place`. `unheld` is the
    /// frame without hands. Returns the number of linearly dependent directions.
    fn solve(
        &mut self,
        unheld: &Frame,
        hands: &[Hand],
        place: &PredictedFrame,
        rigid: Option<&RigidMotion>,
    ) -> usize {
        let relaxations = || self.solving.iter().map(|s| s.relaxation);
        let first = relaxations().next().unwrap_or(0.0);
        self.system.clear(3 * hands.len(), relaxations().all(|r| r == first));
        let right = self.system.right().as_chunks_mut::<3>().0;
        for ((hand, solving), right) in hands.iter().zip(&mut self.solving).zip(right) {
            // Projects the step without hands onto the tangent plane.
            let along = solving.at + solving.tangent * (solving.free - solving.from);
            let gap = match hand.hold {
                // A hand at this position with this force leaves the patch at the measured
                // displacement.
                Hold::Measured(there) => there + solving.compliance * (place.back * hand.pull) - along,
                Hold::Target { config, .. } => {
                    let ahead = hand.patch.rest() + along;
                    let mut gap = solving.target
                        - place.unheld_position(&self.model, rigid, ahead)
                        - place.turn * solving.creep_displacement;
                    // Targets may teleport. No hand pulls harder than from one length of the body
                    // away, in the direction of its target. Such a force is not smooth and cannot
                    // be extrapolated.
                    if gap.norm() > self.model.size() {
                        gap = gap.cap_magnitude(self.model.size());
                        solving.beyond = 0.0;
                        solving.is_capped = true;
                    }
                    if config.relaxation > 0.0 {
                        let frame =
                            rigid.map_or_else(Vector3::zeros, |_| unheld.velocity_at(&self.model, ahead));
                        // The mean velocity of the step, along the tangent on which the force
                        // acts: what a damper takes from the modes is then never less than zero,
                        // whatever they do within the step.
                        let speed = place.turn * (solving.tangent * solving.speed) + frame;
                        gap += solving.lead - config.relaxation * speed;
                    }
                    place.back * gap
                }
            };
            // The compliance responds to the force at the end of the step,
            // `(1 + x) F - x F_before`.
            let gap = gap + solving.beyond * (solving.compliance * (place.back * hand.mean));
            right.copy_from_slice(gap.as_slice());
        }
        for (i, a) in self.solving.iter().enumerate() {
            for (j, b) in self.solving[..=i].iter().enumerate() {
                let mut position = a.tangent * self.responses.at(i, j) * b.tangent.transpose();
                if let Some(rigid) = rigid {
                    position += self.h * rigid.velocity_response(&a.arm, &b.arm);
                }
                let velocity = position / self.h;
                if i == j {
                    position += (1.0 + a.beyond) * a.compliance;
                }
                for x in 0..3 {
                    for y in 0..3 {
                        // The relaxation time of a damper scales the rows of its own hand.
                        let (row, column) = (3 * i + x, 3 * j + y);
                        let (position, velocity) = (position[(x, y)], velocity[(x, y)]);
                        self.system.set(row, column, position + a.relaxation * velocity);
                        if i != j {
                            self.system.set(column, row, position + b.relaxation * velocity);
                        }
                    }
                }
            }
        }
        let lost = self.system.solve();
        self.forces.clear();
        for (solving, pull) in self.solving.iter_mut().zip(self.system.right().as_chunks::<3>().0) {
            solving.pull = Vector3::from(*pull);
            self.forces.push(solving.tangent.tr_mul(&solving.pull));
        }
        lost
    }

    /// Returns the total force (N) and torque about the center of mass (N m) of the hands, world
    /// axes.
    fn total(&self, place: &PredictedFrame) -> [Vector3<f64>; 2] {
        self.solving.iter().fold([Vector3::zeros(); 2], |[force, torque], solving| {
            let pull = place.turn * solving.pull;
            [force + pull, torque + (place.turn * solving.arm).cross(&pull)]
        })
    }
}
