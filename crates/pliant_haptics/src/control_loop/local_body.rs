//! The modal local model: the loop steps a copy of the held body itself, at device rate.
//!
//! The proxy model knows only one spring, to a position that moves at the simulation's rate, and
//! extrapolates between two local model updates. Here the loop has a copy of the body with the
//! tool's grabs, and steps the copy with the hand's position at device rate. Each local model
//! update corrects the copy: the past state of the copy at the time of the update is compared with
//! the update. The difference evolves as free vibration up to the present, and a part of it is then
//! removed from the present copy.

use nalgebra::Vector3;
use pliant_modal::{Body, Coefficients, Frame, GrabId, Integrator, State, StepError};

use crate::{HeldGrab, LocalModel, MAX_CONTACTS, control_loop::tool::Tool};

/// Time span for which the copy stores its past states, s.
const MEMORY: f64 = 0.3;
/// Time constant in which a difference from the simulation is corrected, s.
const CORRECTION: f64 = 0.03;
/// Bound of the correction with delay: the age of the update divided by this ratio is the least
/// time constant. The product of delay and correction rate must stay well below 1.
const PATIENCE: f64 = 0.3;

/// A copy of a body for the loop. The simulation side creates it, because creation allocates. The
/// loop steps it.
#[derive(Debug, Clone)]
pub struct ModalLocal {
    body: Body,
    held: [Option<HeldGrab>; MAX_CONTACTS],
    scale: f64,
    period: f64,
    /// Ring of past modal coordinates, `q` then `v` in each slot.
    past: Vec<f64>,
    frames: Vec<(f64, Frame)>,
    head: usize,
    /// The last local model update: its tick and its time of arrival.
    received_tick: u64,
    received_at: f64,
    scratch: State,
}

impl ModalLocal {
    /// Creates a copy of `body` with the tool's grabs on it, for a loop of `rate` Hz. `scale` is in
    /// world meters per meter of the body.
    ///
    /// # Errors
    /// Returns an error if the rate is not positive, or if a grab is not on the body.
    pub fn new(body: &Body, held: &[HeldGrab], scale: f64, rate: f64) -> Result<Self, StepError> {
        let period = 1.0 / rate;
        let mut copy = body.clone();
        copy.reconfigure(pliant_modal::BodyConfig { step: period, ..body.config().clone() })?;
        let mut grabs = [None; MAX_CONTACTS];
        for (slot, grab) in grabs.iter_mut().zip(held) {
            copy.grab_position(grab.id)?;
            *slot = Some(*grab);
        }
        let slots = (MEMORY / period).ceil() as usize;
        let modes = copy.mode_count();
        Ok(Self {
            past: vec![0.0; slots * 2 * modes],
            frames: vec![(f64::NEG_INFINITY, *copy.frame()); slots],
            scratch: copy.state().clone(),
            body: copy,
            held: grabs,
            scale,
            period,
            head: 0,
            received_tick: 0,
            received_at: 0.0,
        })
    }

    /// Steps the copy with the tool at its present pose. Returns `false` if the copy could not be
    /// stepped, or if the update is about none of its grabs, and so about another body. The proxy
    /// model must then serve.
    pub(crate) fn advance(&mut self, now: f64, steps: usize, tool: &Tool, model: &LocalModel) -> bool {
        let contacts = model.contacts();
        if !contacts.is_empty() && contacts.iter().all(|contact| self.grab(contact.key).is_none()) {
            return false;
        }
        if model.tick != self.received_tick {
            (self.received_tick, self.received_at) = (model.tick, now);
            if !self.correct(model) {
                return false;
            }
        }
        // The remote hands on the body move to their targets over one simulation step. A target
        // that jumped within one short step of the loop would make its damper pull many times too
        // hard.
        let left = self.received_at + model.period - now;
        let passed = steps as f64 * self.period;
        let share = if left > passed { passed / left } else { 1.0 };
        for &(id, target) in &model.others {
            let Ok(from) = self.body.target(id).map(Vector3::from) else { continue };
            let target = from + share * (Vector3::from(target) - from);
            self.body.set_target(id, target.into()).ok();
        }
        for grab in self.held.iter().flatten() {
            let target = (tool.position + tool.orientation * Vector3::from(grab.offset)) / self.scale;
            if !tool.is_clutched() && self.body.set_target(grab.id, target.into()).is_err() {
                return false;
            }
        }
        for _ in 0..steps {
            if self.body.step().is_err() {
                return false;
            }
        }
        self.remember(now);
        true
    }

    /// Returns the number of a grab in the body, if the copy has it. Updates and copies reach the
    /// loop on two ways, so an update may tell of other grabs.
    fn grab(&self, key: u64) -> Option<GrabId> {
        self.held.iter().flatten().find(|grab| grab.key == key).map(|grab| grab.id)
    }

    /// Returns whether the copy has all grabs of an update.
    pub(crate) fn has_all(&self, model: &LocalModel) -> bool {
        model.contacts().iter().all(|contact| self.grab(contact.key).is_some())
    }

    /// Returns the reaction of a grab, N, and the position of its patch in the copy, m, world axes.
    /// It is `None` for a grab that the copy does not have.
    pub(crate) fn reaction(&self, key: u64) -> Option<[Vector3<f64>; 2]> {
        let id = self.grab(key)?;
        let (reaction, proxy) = (self.body.reaction(id).ok()?, self.body.grab_position(id).ok()?);
        Some([reaction, proxy].map(|x| Vector3::from(x) * self.scale))
    }

    /// Returns the energy that the copy could give back, J of the world.
    pub(crate) fn energy(&self) -> f64 {
        self.body.energy() * self.scale * self.scale
    }

    fn slots(&self) -> usize {
        self.frames.len()
    }

    fn remember(&mut self, now: f64) {
        self.head = (self.head + 1) % self.slots();
        let modes = self.body.mode_count();
        let slot = &mut self.past[self.head * 2 * modes..][..2 * modes];
        slot[..modes].copy_from_slice(self.body.q());
        slot[modes..].copy_from_slice(self.body.v());
        self.frames[self.head] = (now, *self.body.frame());
    }

    /// Returns the slot whose time is nearest to `time`, if the ring covers that time. After missed
    /// periods there are fewer slots than periods.
    fn remembered(&self, time: f64) -> Option<usize> {
        let slots = self.slots();
        let mut newer = None;
        for at in (0..slots).map(|back| (self.head + slots - back) % slots) {
            let off = time - self.frames[at].0;
            // The slot has not been written yet, or `time` is not finite.
            if !off.is_finite() {
                return None;
            }
            if off < 0.0 {
                newer = Some((at, -off));
                continue;
            }
            return match newer {
                Some((at, ahead)) if ahead < off => Some(at),
                None if off > self.period => None,
                _ => Some(at),
            };
        }
        None
    }

    /// Corrects the copy by the simulation's state at the time of its stamp.
    fn correct(&mut self, model: &LocalModel) -> bool {
        let modes = self.body.mode_count();
        if model.state.q.len() != modes || model.state.v.len() != modes {
            return false;
        }
        // If the ring has no slot for that time, the update is older than the copy, or it is the
        // first. The copy then takes the whole state.
        let Some(at) = self.remembered(model.stamp) else {
            return self.body.set_state(&model.state).is_ok();
        };
        // The effect of a correction shows only after the delay. A correction that is faster than
        // the delay is applied twice.
        let age = self.frames[self.head].0 - self.frames[at].0;
        let gain = 1.0 - (-model.period.max(0.0) / CORRECTION.max(age / PATIENCE)).exp();
        self.scratch.q.copy_from_slice(self.body.q());
        self.scratch.v.copy_from_slice(self.body.v());
        self.scratch.a.copy_from_slice(self.body.a());
        self.scratch.f.copy_from_slice(&self.body.state().f);
        // The columns of held patches have no motion of their own to correct.
        self.scratch.s.clone_from(&self.body.state().s);
        // The viscoelastic state changes slowly, so it is corrected without regard to the age of
        // the update.
        self.scratch.z.clone_from(&self.body.state().z);
        for (z, received) in self.scratch.z.iter_mut().zip(&model.state.z) {
            *z += gain * (received - *z);
        }
        let then = &self.past[at * 2 * modes..][..2 * modes];
        for i in 0..modes {
            let (eq, ev) = (model.state.q[i] - then[i], model.state.v[i] - then[modes + i]);
            // Since then, the difference has evolved as a mode that nothing holds.
            let (omega, damping) = (self.body.omega()[i], self.body.damping()[i]);
            let [eq, ev, _] = match Coefficients::new(Integrator::Exact, omega, damping, age.max(self.period))
            {
                Ok(swing) if at != self.head => swing.step([eq, ev, 0.0], 0.0, 0.0),
                _ => [eq, ev, 0.0],
            };
            self.scratch.q[i] += gain * eq;
            self.scratch.v[i] += gain * ev;
        }
        if self.body.model().is_free() {
            match self.corrected_frame(&self.frames[at].1, &model.state.frame, gain) {
                Ok(frame) => self.scratch.frame = frame,
                Err(_) => return false,
            }
        } else {
            self.scratch.frame = model.state.frame;
        }
        self.body.set_state(&self.scratch).is_ok()
    }

    /// Returns the time of a slot, for tests.
    #[cfg(test)]
    fn time_of(&self, slot: usize) -> f64 {
        self.frames[slot].0
    }

    fn corrected_frame(&self, then: &Frame, received: &Frame, gain: f64) -> Result<Frame, StepError> {
        let now = self.body.frame();
        let toward = |now: [f64; 3], received: [f64; 3], then: [f64; 3]| -> [f64; 3] {
            std::array::from_fn(|i| now[i] + gain * (received[i] - then[i]))
        };
        let (a, b, c) = (now.orientation(), received.orientation(), then.orientation());
        // The sign puts both quaternions in the same hemisphere. For these small differences, the
        // sum is as accurate as the product.
        let sign = if (0..4).map(|i| b[i] * c[i]).sum::<f64>() < 0.0 { -1.0 } else { 1.0 };
        let orientation = std::array::from_fn(|i| a[i] + gain * (sign * b[i] - c[i]));
        Frame::from_motion(
            self.body.model(),
            toward(now.center(), received.center(), then.center()),
            orientation,
            toward(now.velocity(), received.velocity(), then.velocity()),
            toward(now.spin(), received.spin(), then.spin()),
        )
    }
}

#[cfg(test)]
mod tests {
    use std::{path::Path, sync::Arc};

    use pliant_modal::{BodyConfig, GrabConfig, ModalModel, Patch, StepSettings};

    use super::*;
    use crate::control_loop::held_patches::{HeldPatches, When};
    use crate::{Coupling, CouplingLimit, ToolMap, control_loop::local_model::ModelWriter};

    fn pip(gravity: [f64; 3]) -> Body {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
        let model = Arc::new(ModalModel::read(path).unwrap());
        Body::new(model, BodyConfig::from(StepSettings { gravity, ..Default::default() })).unwrap()
    }

    fn coupling() -> Coupling {
        let limit = CouplingLimit::None;
        let [stiffness, damping] = [400.0, 4.0];
        let wanted = [stiffness, damping];
        Coupling { stiffness, damping, wanted, stiffness_limit: limit, damping_limit: limit }
    }

    fn grab(body: &mut Body, vertex: u32) -> pliant_modal::GrabId {
        let patch = Patch::around(body.model().surface(), vertex, 0.02).unwrap();
        body.grab(&patch, GrabConfig::default()).unwrap()
    }

    #[test]
    fn a_model_is_about_its_time_whatever_periods_were_missed() {
        let mut copy = ModalLocal::new(&pip([0.0; 3]), &[], 1.0, 1000.0).unwrap();
        let model = LocalModel::default();
        // Every third call takes four periods at once.
        let mut now = 0.0;
        for k in 0..120 {
            let steps = if k % 3 == 0 { 4 } else { 1 };
            now += f64::from(steps) * 1e-3;
            assert!(copy.advance(now, steps as usize, &Tool::new(ToolMap::default()), &model));
        }
        for back in [0.0, 0.013, 0.050, 0.1, 0.2] {
            let slot = copy.remembered(now - back).unwrap();
            // Two slots are up to four periods apart.
            assert!((copy.time_of(slot) - (now - back)).abs() <= 2.001e-3, "{back} s ago");
        }
        assert_eq!(copy.remembered(now + 0.01), None, "the future");
        assert_eq!(copy.remembered(now - 10.0), None, "long ago");
    }

    #[test]
    fn the_other_hands_go_where_the_simulation_has_them() {
        let mut body = pip([0.0; 3]);
        let (own, other) = (grab(&mut body, 76), grab(&mut body, 63));
        let held = HeldGrab { key: 1, id: own, offset: [0.0; 3] };
        let mut copy = ModalLocal::new(&body, &[held], 1.0, 1000.0).unwrap();
        let [x, y, z] = body.target(other).unwrap();
        body.set_target(other, [x + 0.01, y, z]).unwrap();
        body.step().unwrap();
        let mut model = LocalModel::sized_for(&body);
        ModelWriter::new().write(&body, &[held], &coupling(), 1.0, 0.0, &mut model).unwrap();
        let ticks = (model.period * 1000.0).round() as usize;
        assert!(ticks > 10, "{} s a local model", model.period);
        let mut last = x;
        for tick in 0..ticks {
            assert!(copy.advance(tick as f64 * 1e-3, 1, &Tool::new(ToolMap::default()), &model));
            let now = copy.body.target(other).unwrap();
            let way = now[0] - last;
            assert!(way > 0.0 && way < 1.5 * 0.01 / ticks as f64, "tick {tick}: {way} m at once");
            assert_eq!([now[1], now[2]], [y, z]);
            last = now[0];
        }
        assert!((last - x - 0.01).abs() < 1e-9, "{last}, {x}");
    }

    /// Updates and copies reach the loop on two ways, so for some periods an update has other
    /// grabs than the copy has.
    #[test]
    fn a_copy_serves_only_the_grabs_that_it_has() {
        let mut body = pip([0.0; 3]);
        let (first, second) = (grab(&mut body, 76), grab(&mut body, 63));
        let [x, y, z] = body.target(first).unwrap();
        body.set_target(first, [x + 0.01, y, z]).unwrap();
        (0..600).for_each(|_| {
            body.step().unwrap();
        });
        let held = |key, id| HeldGrab { key, id, offset: body.target(id).unwrap() };
        let held = [held(1, first), held(2, second)];
        let copy = ModalLocal::new(&body, &held, 1.0, 1000.0).unwrap();
        let (mut writer, mut model) = (ModelWriter::new(), LocalModel::sized_for(&body));
        let (mut patches, tool) = (HeldPatches::new(None), Tool::new(ToolMap::default()));
        patches.set_modal(Some(Box::new(copy)));
        let mut now = 0.0;
        let mut force = |model: &LocalModel| {
            patches.take(model);
            now += 1e-3;
            patches.forces(When { now, dt: 1e-3, period: 1e-3 }, true, &tool, model).elastic
        };
        let [one, other] = [first, second].map(|id| Vector3::from(body.reaction(id).unwrap()));
        writer.write(&body, &held, &coupling(), 1.0, 0.0, &mut model).unwrap();
        let both = force(&model);
        assert!((both - one - other).norm() < 0.01 * one.norm(), "{both:?}, {one:?} and {other:?}");
        // The tool has released the first patch, and the copy still holds both.
        writer.write(&body, &held[1..], &coupling(), 1.0, 0.0, &mut model).unwrap();
        let left = force(&model);
        assert!((left - other).norm() < 0.01 * one.norm(), "{left:?} instead of {other:?}");
        // The tool has taken hold of another body with as many modes, at rest under its hand.
        let mut another = pip([0.0; 3]);
        let id = grab(&mut another, 30);
        let held = HeldGrab { key: 3, id, offset: another.target(id).unwrap() };
        another.step().unwrap();
        writer.write(&another, &[held], &coupling(), 1.0, 0.0, &mut model).unwrap();
        let strange = force(&model);
        assert!(strange.norm() < 1e-3 * one.norm(), "{strange:?} of a body that is not held");
    }

    #[test]
    fn what_gravity_gives_to_a_bent_body_is_supplied() {
        let mut body = pip([0.0, -9.81, 0.0]);
        let own = grab(&mut body, 76);
        let held = HeldGrab { key: 1, id: own, offset: [0.0; 3] };
        let (mut writer, mut model) = (ModelWriter::new(), LocalModel::sized_for(&body));
        let [x, y, z] = body.target(own).unwrap();
        let mut begun = None;
        for k in 0..240 {
            let way = 0.02 * (f64::from(k) * 0.05).sin();
            body.set_target(own, [x, y + way, z]).unwrap();
            body.step().unwrap();
            writer.write(&body, &[held], &coupling(), 1.0, 0.0, &mut model).unwrap();
            let (from, at) = *begun.get_or_insert((model.supplied, body.potential_energy()));
            let given = at - body.potential_energy();
            assert!(
                (model.supplied - from - given).abs() < 1e-12,
                "{} J of {given} J",
                model.supplied - from
            );
        }
    }
}
