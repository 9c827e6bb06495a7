//! Energy at the port between loop and hand: counted exactly, and kept from being made out of nothing.

use nalgebra::Vector3;

/// Settings of [`Passivity`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassivityConfig {
    /// Energy that may leave before any has come in, J, in each engagement (from no force to the next time that there is none). Default: 0.005.
    pub tank: f64,
    /// Most damping that the controller adds, N s/m. Default: 5.
    pub max_damping: f64,
    /// After a fade: power at which the energy is given back that a spring gained while it was not felt, W; 0 never gives it back. A hand that rests
    /// would otherwise feel less than the body pulls for as long as it rests. Default: 0.01.
    pub repay: f64,
}

impl Default for PassivityConfig {
    fn default() -> Self {
        Self { tank: 0.005, max_damping: 5.0, repay: 0.01 }
    }
}

impl PassivityConfig {
    pub(crate) fn is_valid(&self) -> bool {
        [self.tank, self.max_damping, self.repay].iter().all(|x| x.is_finite() && *x >= 0.0)
    }
}

/// Energies at the port, J.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Port {
    /// What may still be given to the hand.
    pub available: f64,
    /// What the hand has put in since the loop began: sum of all `-F dx` that are positive.
    pub taken: f64,
    /// What the hand has been given since: sum of all `F dx` that are positive.
    pub given: f64,
    /// What others have put in since, net.
    pub supplied: f64,
    /// What has been given back after fades: never more than springs had gained in them, never more than the tank holds at a time, and no faster than
    /// [`PassivityConfig::repay`].
    pub repaid: f64,
    /// Force times displacement that the controller has held back or damped away, for diagnosis.
    pub dissipated: f64,
}

/// Time-domain passivity observer and controller (Hannaford and Ryu 2002).
///
/// A held force does exactly the work `F[k-1] . (x[k] - x[k-1])`, so energy is counted without approximation (Stramigioli et al. 2005):
/// `E[k] = E[k-1] - F[k-1] . (x[k] - x[k-1])`. What has been absorbed counts only as far as springs and body can store it: a hand that dragged
/// through honey for a minute has nothing to its credit.
///
/// Two remedies. [`dissipate`](Self::dissipate) answers what has leaked out (sampling, delay, a coarse encoder) with damping, as much as pays it back and
/// no more than the device closes. [`restrain`](Self::restrain) is the hard bound: the force is cut so that what is
/// available is not overdrawn, even while the force still needs its slew limit's time to go away.
#[derive(Debug, Clone, Copy)]
pub struct Passivity {
    config: PassivityConfig,
    port: Port,
    /// What would be available had nothing leaked, J.
    full: f64,
    /// What is missing although nothing has leaked: springs that were stretched while they could not be felt.
    forgiven: f64,
}

impl Passivity {
    /// With a full tank.
    pub fn new(config: PassivityConfig) -> Self {
        Self {
            config,
            port: Port { available: config.tank, ..Port::default() },
            full: config.tank,
            forgiven: 0.0,
        }
    }

    /// Energies so far.
    pub fn port(&self) -> Port {
        self.port
    }

    /// Counts the work of the `force` (N) held while the hand `moved` (m), and what others `supplied` (J) in that time. `stored`: what springs
    /// and body could give back (J), the least that it could be if that is known only in part (`partial`); then everything absorbed counts. Not `holding` anything, the tank is filled up: the next grab begins anew.
    pub fn observe(
        &mut self,
        force: &Vector3<f64>,
        moved: &Vector3<f64>,
        supplied: f64,
        stored: f64,
        partial: bool,
        holding: bool,
    ) {
        let given = force.dot(moved);
        if !(given.is_finite() && supplied.is_finite() && stored.is_finite()) {
            return;
        }
        self.port.given += given.max(0.0);
        self.port.taken += (-given).max(0.0);
        self.port.supplied += supplied;
        // What springs and body hold now can have come from nowhere but the hand, the tank or others: anything less available has leaked.
        self.full = if holding { self.config.tank + stored.max(0.0) } else { self.config.tank };
        let balance = self.port.available - given + supplied;
        self.port.available = match (holding, partial) {
            (false, _) => self.full,
            (true, true) => balance,
            (true, false) => balance.min(self.full),
        };
    }

    /// Nothing is felt now: what comes next is a new engagement, and begins with a full tank.
    pub fn refill(&mut self) {
        self.port.available = self.port.available.max(self.config.tank);
    }

    /// What is missing now has not leaked: a spring was stretched while a fade or a ramp kept it from being felt. It is not to be damped away; it
    /// is not available either.
    pub fn forgive(&mut self) {
        self.forgiven = (self.full - self.port.available).max(0.0);
    }

    /// A fade is over and `dt` (s) has passed: some of what was [forgiven](Self::forgive) is available again, until the tank is full.
    pub fn repay(&mut self, dt: f64) {
        let room = (self.config.tank - self.port.available).min(self.forgiven);
        let back = (self.config.repay * dt).min(room);
        if back > 0.0 {
            self.port.available += back;
            self.port.repaid += back;
            self.forgiven -= back;
        }
    }

    /// The damping force (N) that pays back what has leaked, at `velocity` (m/s) over `dt` (s).
    pub fn dissipate(&mut self, velocity: &Vector3<f64>, dt: f64) -> Vector3<f64> {
        let gap = self.full - self.port.available;
        self.forgiven = self.forgiven.min(gap).max(0.0);
        let missing = gap - self.forgiven;
        let v2 = velocity.norm_squared();
        if missing <= 0.0 || v2 * dt <= 0.0 || !v2.is_finite() {
            return Vector3::zeros();
        }
        let damping = (missing / (v2 * dt)).min(self.config.max_damping);
        self.port.dissipated += damping * v2 * dt;
        -velocity * damping
    }

    /// The force (N), cut so that what is available covers the work that it can do before it is gone again; its direction is kept.
    ///
    /// Held for `dt` and then taken down at the slew limit `S` (N/s), a force `f` has the impulse `I = f dt + f^2 / (2 S)`; on a handle of mass `M` that
    /// already moves along it at `v` it does at most the work `v I + I^2 / (2 M)`. `M` is the device's alone: a hand on it only makes that less.
    pub fn restrain(
        &mut self,
        force: &Vector3<f64>,
        velocity: &Vector3<f64>,
        dt: f64,
        slew: f64,
        mass: f64,
    ) -> Vector3<f64> {
        let size = force.norm();
        if size <= 0.0 {
            return *force;
        }
        let speed = velocity.dot(&(force / size));
        let energy = self.port.available.max(0.0);
        // The root of I^2 / (2 M) + v I = E, without the cancellation of a fast handle.
        let root = speed.hypot((2.0 * energy / mass).sqrt());
        let impulse = if speed > 0.0 { 2.0 * energy / (root + speed) } else { mass * (root - speed) };
        if impulse == f64::INFINITY {
            return *force;
        }
        let most = if slew.is_finite() {
            // The root of f^2 / (2 S) + f dt = I.
            2.0 * impulse / (dt + (dt * dt + 2.0 * impulse / slew).sqrt())
        } else {
            impulse / dt
        };
        if size <= most {
            return *force;
        }
        self.port.dissipated += (size - most) * speed.max(0.0) * dt;
        force * (most / size)
    }
}
