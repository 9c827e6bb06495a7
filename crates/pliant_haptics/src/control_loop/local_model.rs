//! What the simulation tells the device loop once a step: enough to close the spring at device rate until the next word.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use pliant_modal::{Body, GrabId, State, StepError};

use crate::Coupling;

/// Most grabs that one tool holds at once.
pub const MAX_CONTACTS: usize = 4;

/// One grab as the loop sees it: a spring from a point of the tool to the *proxy*, the place where the held patch is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Contact {
    /// Tells the grab from others, for as long as it lasts: one of another key is another, and comes by a ramp.
    pub key: u64,
    /// The held point from the tool point, in tool axes, m of the world.
    pub offset: [f64; 3],
    /// Where the patch was when the model was written, m, world axes.
    pub proxy: [f64; 3],
    /// How fast it moved, m/s, world axes.
    pub velocity: [f64; 3],
    /// Stiffness of the spring from proxy to hand, N/m, world axes: residual flexibility of the patch and coupling in series, symmetric.
    pub stiffness: [[f64; 3]; 3],
    /// Damping of the same, N s/m.
    pub damping: f64,
    /// The body's reaction in the step that this comes from, N, world axes.
    pub reaction: [f64; 3],
}

/// The simulation's word. Overwritten in place once a step: neither side allocates.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LocalModel {
    /// Counts the simulation's steps from 1; 0 has never been written.
    pub tick: u64,
    /// Which hand the simulation had seen: the time, on the loop's clock, of the tick whose tool position was the newest target, s.
    pub stamp: f64,
    /// Time that a step of the simulation covers, s.
    pub period: f64,
    /// Real time between two words, as far as the simulation knows it, s; 0 where it does not.
    pub interval: f64,
    /// The first `count` are in use.
    pub contacts: [Contact; MAX_CONTACTS],
    /// Number of grabs that the tool holds.
    pub count: usize,
    /// Energy that the body could give back, J: elastic and kinetic.
    pub stored: f64,
    /// `stored` is the least that it could be: of a body elsewhere only the shape is known.
    pub partial: bool,
    /// Energy that others (other hands, gravity) have put into the body so far, J, net.
    pub supplied: f64,
    /// Where the other hands on the body are, m, the body's world.
    pub others: Vec<(GrabId, [f64; 3])>,
    /// The body's state, for a loop that steps it itself. Empty: there is none.
    pub state: State,
}

impl LocalModel {
    /// The contacts in use.
    pub fn contacts(&self) -> &[Contact] {
        &self.contacts[..self.count.min(MAX_CONTACTS)]
    }

    /// Room for the state of `body`, so that the first write allocates nothing either.
    pub fn sized_for(body: &Body) -> Self {
        let others = Vec::with_capacity(Body::MAX_GRABS);
        Self { others, state: body.state().clone(), ..Self::default() }
    }

    /// No number in it is NaN or infinite.
    pub fn is_finite(&self) -> bool {
        let scalars = [self.stamp, self.period, self.interval, self.stored, self.supplied];
        scalars.iter().all(|x| x.is_finite())
            && self.contacts().iter().all(|c| {
                let vectors = [c.offset, c.proxy, c.velocity, c.reaction];
                c.damping.is_finite()
                    && vectors.iter().flatten().chain(c.stiffness.iter().flatten()).all(|x| x.is_finite())
            })
    }
}

/// A grab of the tool: which one, and where on the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldGrab {
    /// Tells this grab from others, on whatever body, for as long as it lasts.
    pub key: u64,
    /// The grab on the body.
    pub id: GrabId,
    /// The held point from the tool point, tool axes, m of the world.
    pub offset: [f64; 3],
}

/// A grab on a body that is stepped elsewhere: what was published of it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PublishedGrab {
    /// Tells this grab from others, for as long as it lasts.
    pub key: u64,
    /// The held point from the tool point, tool axes, m of the world.
    pub offset: [f64; 3],
    /// Where the held patch is, m, world axes.
    pub point: [f64; 3],
    /// The reaction, N, world axes.
    pub force: [f64; 3],
    /// Stiffness of the spring from patch to hand, N/m, world axes: what whoever steps the body ties the patch with, the patch's residual flexibility and
    /// the coupling in series.
    pub stiffness: [[f64; 3]; 3],
}

/// Writes [`LocalModel`]s from a body: keeps what it needs of the step before.
#[derive(Debug, Clone, Default)]
pub struct ModelWriter {
    tick: u64,
    proxies: [Option<(u64, Vector3<f64>)>; MAX_CONTACTS],
    points: [Option<(u64, Vector3<f64>)>; MAX_CONTACTS],
    /// Of bodies elsewhere: what they stored when the first word of them was written, J, and the work of the tool's grabs on them since.
    stored: Option<f64>,
    worked: f64,
    targets: Vec<(GrabId, Vector3<f64>)>,
    /// Potential energy of the body in gravity, J, as of the last word.
    potential: Option<(f64, [f64; 3])>,
    supplied: f64,
}

impl ModelWriter {
    /// A writer that has seen no step yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Writes what the loop needs to know of `body` after a step, into `out`.
    ///
    /// `held`: the tool's grabs, the first [`MAX_CONTACTS`] count. `scale`: the body's lengths and forces times this are the world's.
    /// `stamp`: the [`Tick::now`](crate::Tick::now) of the tool position that the step had for a target. The proxy is where the solver has the patch, so at the target of the step the spring gives exactly the
    /// reaction: `C lambda = target - proxy`.
    ///
    /// # Errors
    /// A grab that is not on the body; `out` then has no contacts, and the loop lets go gently.
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
        out.count = 0;
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
            // The damper in world space: the coupling's relaxation time is the same on both sides of the tool's scale.
            let relaxation = if coupling.stiffness > 0.0 && coupling.stiffness.is_finite() {
                coupling.damping / coupling.stiffness
            } else {
                0.0
            };
            out.contacts[i] = Contact {
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

    /// Writes the same from published forces alone, for a body that somebody else steps.
    ///
    /// `relaxation`: of the coupling's damper, s; `stored`: elastic energy of the bodies as they are shown, J of the world; `period`: time between two
    /// words, s. A stiffness that is not finite is none. What others have put in is the most that the bodies ever stored beyond the work of these
    /// grabs: that much it was at least.
    pub fn write_forces(
        &mut self,
        felt: &[PublishedGrab],
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
        out.count = felt.len().min(MAX_CONTACTS);
        let before = self.points;
        self.points = [None; MAX_CONTACTS];
        for (i, grab) in felt.iter().take(MAX_CONTACTS).enumerate() {
            let point = Vector3::from(grab.point);
            let last = before.iter().flatten().find(|(key, _)| *key == grab.key).map(|(_, p)| *p);
            let moved = last.map_or_else(Vector3::zeros, |p| point - p);
            self.worked -= Vector3::from(grab.force).dot(&moved);
            let velocity = moved / period;
            let k = grab.stiffness;
            let k = if k.iter().flatten().all(|x| x.is_finite()) { k } else { [[0.0; 3]; 3] };
            out.contacts[i] = Contact {
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
        // The sum from the beginning, not of the gains: what swings between speed and shape is not put in twice.
        let before = *self.stored.get_or_insert_with(|| {
            self.worked = 0.0;
            stored - self.supplied
        });
        self.supplied = self.supplied.max(stored - before - self.worked);
        out.partial = true;
        out.others.clear();
        (out.stored, out.supplied) = (stored, self.supplied);
    }

    /// Work that other hands and gravity did in the last step, J of the body.
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
        // Of an anchored body too: it bends under its own weight as a hand lifts and lowers it.
        let (potential, gravity) = (body.potential_energy(), body.config().settings.gravity);
        // Gravity that changes is nobody's work here: what it makes of the height is counted from now on.
        if let Some((before, under)) = self.potential
            && under == gravity
        {
            work += before - potential;
        }
        self.potential = Some((potential, gravity));
        Ok(work)
    }
}
