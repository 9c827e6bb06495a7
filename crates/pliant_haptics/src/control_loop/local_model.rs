//! The local model that the simulation publishes once per step. It holds everything that the device
//! loop needs to close the spring at device rate until the next local model update.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use pliant_modal::{Body, GrabId, State, StepError};

use crate::Coupling;

/// Maximum number of grabs that one tool holds at once.
pub const MAX_CONTACTS: usize = 4;

/// One grab as the loop sees it: a spring from a point of the tool to the *proxy*, the position of
/// the held patch.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ToolContact {
    /// Key of the grab, unique for as long as the grab lasts. A contact with another key is another
    /// grab, and its force rises by a ramp.
    pub key: u64,
    /// Offset of the held point from the tool point, in tool axes, m of the world.
    pub offset: [f64; 3],
    /// Position of the patch when the model was written, m, world axes.
    pub proxy: [f64; 3],
    /// Velocity of the patch, m/s, world axes.
    pub velocity: [f64; 3],
    /// Stiffness of the spring from the proxy to the hand, N/m, world axes, symmetric: residual
    /// flexibility of the patch and coupling in series.
    pub stiffness: [[f64; 3]; 3],
    /// Damping of the spring from the proxy to the hand, N s/m.
    pub damping: f64,
    /// The body's reaction in the step that this contact comes from, N, world axes.
    pub reaction: [f64; 3],
}

/// Maximum number of planes that a tool touches at once.
pub const MAX_PLANES: usize = 16;

/// A plane that a place of the tool touches or is near: the surface of a body or of an obstacle.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TouchPlane {
    /// Key of what is touched. Several places of a tool may touch the same.
    pub key: u64,
    /// The place of the tool: the center of the sphere that touches there, m of the world from the
    /// tool point, axes of the tool. Zero of a ball.
    pub spot: [f64; 3],
    /// A point of the surface, m, world axes. The dent is not in it.
    pub point: [f64; 3],
    /// Outward normal, unit length, world axes.
    pub normal: [f64; 3],
    /// Velocity of the surface, m/s, world axes.
    pub velocity: [f64; 3],
    /// Compliance of the dent, m/N, world axes, symmetric.
    pub compliance: [[f64; 3]; 3],
    /// Coefficient of friction, 0 or more.
    pub friction: f64,
}

/// The ball with which a tool touches, or the rounding of its shape.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TouchBall {
    /// Radius, m of the world.
    pub radius: f64,
    /// Stiffness of the spring from the tool to what touches, N/m of the world. With 0 it touches
    /// nothing.
    pub stiffness: f64,
    /// The length whose square times the stiffness resists a turn, m of the world
    /// ([`Probe::lever`](pliant_modal::Probe::lever)). Zero of a ball, which does not turn.
    pub lever: f64,
    /// Relaxation time of the damper beside the spring, s.
    pub relaxation: f64,
}

/// The local model of one simulation step. It is overwritten in place once per step, so that
/// neither side allocates.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LocalModel {
    /// Number of the simulation step, from 1. A model with 0 has never been written.
    pub tick: u64,
    /// Time on the loop's clock of the tick whose tool position was the newest target of the step,
    /// s.
    pub stamp: f64,
    /// Simulated time that one step covers, s.
    pub period: f64,
    /// Real time between two local model updates as far as the simulation knows it, s. It is 0 if
    /// unknown.
    pub interval: f64,
    /// The contacts. The first `count` are in use.
    pub contacts: [ToolContact; MAX_CONTACTS],
    /// Number of grabs that the tool holds.
    pub count: usize,
    /// The tool's ball or rounding, and the planes that it may touch. The first `plane_count` are
    /// in use.
    pub ball: TouchBall,
    /// See [`ball`](Self::ball).
    pub planes: [TouchPlane; MAX_PLANES],
    /// Number of planes.
    pub plane_count: usize,
    /// Energy that the body could give back, elastic and kinetic, J.
    pub stored: f64,
    /// Whether `stored` is only a lower bound. Of a body that is stepped elsewhere, only the shape
    /// is known.
    pub partial: bool,
    /// Net energy that others (other hands, gravity) have put into the body so far, J.
    pub supplied: f64,
    /// Targets of the other hands on the body, m, in the body's world.
    pub others: Vec<(GrabId, [f64; 3])>,
    /// The body's state, for a loop that steps the body itself. It is empty if there is no state.
    pub state: State,
}

impl LocalModel {
    /// Returns the contacts in use.
    pub fn contacts(&self) -> &[ToolContact] {
        &self.contacts[..self.count.min(MAX_CONTACTS)]
    }

    /// Returns the planes in use.
    pub fn planes(&self) -> &[TouchPlane] {
        &self.planes[..self.plane_count.min(MAX_PLANES)]
    }

    /// Creates a model with room for the state of `body`, so that the first write does not allocate
    /// either.
    pub fn sized_for(body: &Body) -> Self {
        let others = Vec::with_capacity(Body::MAX_GRABS);
        Self { others, state: body.state().clone(), ..Self::default() }
    }

    /// Returns whether no scalar and no contact in use contains a NaN or an infinity.
    pub fn is_finite(&self) -> bool {
        let scalars = [self.stamp, self.period, self.interval, self.stored, self.supplied];
        let ball = [self.ball.radius, self.ball.stiffness, self.ball.relaxation, self.ball.lever];
        scalars.iter().chain(&ball).all(|x| x.is_finite())
            && self.planes().iter().all(|p| {
                let vectors = [p.point, p.normal, p.velocity, p.spot];
                let upright = (Vector3::from(p.normal).norm() - 1.0).abs() < 1e-6;
                upright
                    && p.friction >= 0.0
                    && p.friction.is_finite()
                    && vectors.iter().flatten().chain(p.compliance.iter().flatten()).all(|x| x.is_finite())
            })
            && self.contacts().iter().all(|c| {
                let vectors = [c.offset, c.proxy, c.velocity, c.reaction];
                c.damping.is_finite()
                    && vectors.iter().flatten().chain(c.stiffness.iter().flatten()).all(|x| x.is_finite())
            })
    }
}

/// A grab of the tool, with its position on the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldGrab {
    /// Key of the grab, unique among the grabs on all bodies for as long as the grab lasts.
    pub key: u64,
    /// The grab on the body.
    pub id: GrabId,
    /// Offset of the held point from the tool point, tool axes, m of the world.
    pub offset: [f64; 3],
}

/// The published quantities of a grab on a body that is stepped elsewhere.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PublishedGrab {
    /// Key of the grab, unique for as long as the grab lasts.
    pub key: u64,
    /// Offset of the held point from the tool point, tool axes, m of the world.
    pub offset: [f64; 3],
    /// Position of the held patch, m, world axes.
    pub point: [f64; 3],
    /// The reaction, N, world axes.
    pub force: [f64; 3],
    /// Stiffness of the spring from the patch to the hand, N/m, world axes. The side that steps the
    /// body uses this spring: the patch's residual flexibility and the coupling in series.
    pub stiffness: [[f64; 3]; 3],
}

/// Writes [`LocalModel`]s from a body and keeps the values of the previous step that it needs.
#[derive(Debug, Clone, Default)]
pub struct ModelWriter {
    tick: u64,
    proxies: [Option<(u64, Vector3<f64>)>; MAX_CONTACTS],
    points: [Option<(u64, Vector3<f64>)>; MAX_CONTACTS],
    /// For bodies that are stepped elsewhere: `stored` is the energy that they stored at the first
    /// update, less the energy supplied before that, J. `worked` is the work of the tool's grabs on
    /// them since then, J.
    stored: Option<f64>,
    worked: f64,
    targets: Vec<(GrabId, Vector3<f64>)>,
    /// Potential energy of the body in gravity at the last update, J, and the gravity of that
    /// update.
    potential: Option<(f64, [f64; 3])>,
    supplied: f64,
}

impl ModelWriter {
    /// Creates a writer that has not seen a step yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Writes the local model of `body` after a step into `out`.
    ///
    /// - `held`: the tool's grabs, of which the first [`MAX_CONTACTS`] count.
    /// - `scale`: factor from the body's lengths and forces to those of the world.
    /// - `stamp`: the [`LoopTick::now`](crate::LoopTick::now) of the tool position that was the
    ///   target of the step.
    ///
    /// The proxy is the position of the patch in the solver. At the target of the step, the spring
    /// therefore gives exactly the reaction: `C lambda = target - proxy`.
    ///
    /// # Errors
    /// Returns an error if a grab is not on the body. `out` then has only the contacts before this
    /// grab.
    pub fn write(
        &mut self,
        body: &Body,
        held: &[HeldGrab],
        coupling: &Coupling,
        scale: f64,
        stamp: f64,
        out: &mut LocalModel,
    ) -> Result<(), StepError> {
        self.tick += 1;
        out.tick = self.tick;
        out.stamp = stamp;
        out.period = body.config().step;
        (out.count, out.plane_count) = (0, 0);
        out.stored = body.energy() * scale * scale;
        out.partial = false;
        self.stored = None;
        self.supplied += self.work_of_others(body, held)? * scale * scale;
        out.supplied = self.supplied;
        out.state.clone_from(body.state());
        out.others.clear();
        for id in body.grabs().filter(|id| held.iter().all(|held| held.id != *id)) {
            out.others.push((id, body.target(id)?));
        }

        let [x, y, z, w] = body.frame().orientation();
        let turn =
            *UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix().matrix();
        let mut proxies = [None; MAX_CONTACTS];
        for (i, grab) in held.iter().take(MAX_CONTACTS).enumerate() {
            let proxy = Vector3::from(body.grab_position(grab.id)?) * scale;
            let before = self.proxies.iter().flatten().find(|(key, _)| *key == grab.key).map(|(_, p)| *p);
            let velocity = before.map_or_else(Vector3::zeros, |p| (proxy - p) / out.period);
            let compliance = body.compliance(grab.id)?;
            let compliance = Matrix3::from_fn(|r, c| compliance[r][c]);
            let stiffness = turn * compliance.try_inverse().unwrap_or_else(Matrix3::zeros) * turn.transpose();
            let stiffness = 0.5 * (stiffness + stiffness.transpose());
            let reaction = Vector3::from(body.reaction(grab.id)?) * scale;
            // The damper acts in world space. The relaxation time of the coupling is the same on
            // both sides of the tool's scale.
            let relaxation = if coupling.stiffness > 0.0 && coupling.stiffness.is_finite() {
                coupling.damping / coupling.stiffness
            } else {
                0.0
            };
            out.contacts[i] = ToolContact {
                key: grab.key,
                offset: grab.offset,
                proxy: proxy.into(),
                velocity: velocity.into(),
                stiffness: std::array::from_fn(|r| std::array::from_fn(|c| stiffness[(r, c)])),
                damping: relaxation * stiffness.trace() / 3.0,
                reaction: reaction.into(),
            };
            out.count = i + 1;
            proxies[i] = Some((grab.key, proxy));
        }
        self.proxies = proxies;
        Ok(())
    }

    /// Writes what a tool that holds nothing touches. `stored` is the energy of the touched bodies,
    /// J of the world, and `period` the time of a step, s. Planes beyond [`MAX_PLANES`] are left
    /// out.
    pub fn write_touch(
        &mut self,
        ball: TouchBall,
        planes: impl Iterator<Item = TouchPlane>,
        stored: f64,
        period: f64,
        stamp: f64,
        out: &mut LocalModel,
    ) {
        self.tick += 1;
        (out.tick, out.stamp, out.period) = (self.tick, stamp, period);
        (out.count, out.plane_count, out.ball) = (0, 0, ball);
        for (slot, plane) in out.planes.iter_mut().zip(planes) {
            *slot = plane;
            out.plane_count += 1;
        }
        (self.proxies, self.points) = ([None; MAX_CONTACTS], [None; MAX_CONTACTS]);
        (self.stored, self.potential) = (None, None);
        out.stored = if stored.is_finite() { stored.max(0.0) } else { 0.0 };
        (out.partial, out.supplied) = (false, self.supplied);
        out.others.clear();
    }

    /// Writes the same from published forces alone, for a body that is stepped elsewhere.
    ///
    /// - `relaxation`: relaxation time of the coupling's damper, s.
    /// - `stored`: elastic energy of the bodies in their visual state, J of the world.
    /// - `period`: time between two local model updates, s.
    ///
    /// A stiffness that is not finite counts as zero. The energy supplied by others is estimated as
    /// a lower bound: the largest energy that the bodies ever stored beyond the work of these
    /// grabs.
    pub fn write_forces(
        &mut self,
        published: &[PublishedGrab],
        relaxation: f64,
        stored: f64,
        period: f64,
        stamp: f64,
        out: &mut LocalModel,
    ) {
        self.tick += 1;
        out.tick = self.tick;
        out.stamp = stamp;
        out.period = period;
        out.count = published.len().min(MAX_CONTACTS);
        out.plane_count = 0;
        let before = self.points;
        self.points = [None; MAX_CONTACTS];
        for (i, grab) in published.iter().take(MAX_CONTACTS).enumerate() {
            let point = Vector3::from(grab.point);
            let last = before.iter().flatten().find(|(key, _)| *key == grab.key).map(|(_, p)| *p);
            let moved = last.map_or_else(Vector3::zeros, |p| point - p);
            self.worked -= Vector3::from(grab.force).dot(&moved);
            let velocity = moved / period;
            let k = grab.stiffness;
            let k = if k.iter().flatten().all(|x| x.is_finite()) { k } else { [[0.0; 3]; 3] };
            out.contacts[i] = ToolContact {
                key: grab.key,
                offset: grab.offset,
                proxy: grab.point,
                velocity: velocity.into(),
                stiffness: k,
                damping: relaxation * (k[0][0] + k[1][1] + k[2][2]) / 3.0,
                reaction: grab.force,
            };
            self.points[i] = Some((grab.key, point));
        }
        let stored = if stored.is_finite() { stored.max(0.0) } else { 0.0 };
        if !self.worked.is_finite() {
            (self.worked, self.stored) = (0.0, None);
        }
        // The balance is taken from the beginning and not as a sum of gains. Energy that alternates
        // between velocity and shape would otherwise count as supplied more than once.
        let before = *self.stored.get_or_insert_with(|| {
            self.worked = 0.0;
            stored - self.supplied
        });
        self.supplied = self.supplied.max(stored - before - self.worked);
        out.partial = true;
        out.others.clear();
        (out.stored, out.supplied) = (stored, self.supplied);
    }

    /// Returns the work of other hands and gravity in the last step, J of the body.
    fn work_of_others(&mut self, body: &Body, held: &[HeldGrab]) -> Result<f64, StepError> {
        let mut work = 0.0;
        for id in body.grabs() {
            if held.iter().any(|h| h.id == id) {
                continue;
            }
            let target = Vector3::from(body.target(id)?);
            match self.targets.iter_mut().find(|(known, _)| *known == id) {
                Some((_, last)) => {
                    work -= Vector3::from(body.reaction(id)?).dot(&(target - *last));
                    *last = target;
                }
                None => self.targets.push((id, target)),
            }
        }
        self.targets.retain(|(known, _)| body.grabs().any(|id| id == *known));
        // An anchored body counts too, because it bends under its own weight when a hand lifts and
        // lowers it.
        let (potential, gravity) = (body.potential_energy(), body.config().settings.gravity);
        // A change of gravity does no work here. The potential energy counts under the new gravity
        // from this update on.
        if let Some((before, under)) = self.potential
            && under == gravity
        {
            work += before - potential;
        }
        self.potential = Some((potential, gravity));
        Ok(work)
    }
}
