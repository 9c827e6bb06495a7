//! Passivity control: exact accounting of the energy at the port between the loop and the hand.

use nalgebra::Vector3;

/// Settings of [`Passivity`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassivityConfig {
    /// Energy that may leave before any has come in, J, for each engagement (from one moment
    /// without force to the next). Default: 0.005.
    pub tank: f64,
    /// Maximum damping that the controller adds, N s/m. Default: 5.
    pub max_damping: f64,
    /// Power at which energy is repaid after a fade, W. A spring that is stretched during a fade
    /// gains energy that the hand has not put in. A hand at rest would otherwise feel less than the
    /// body's force for as long as the hand rests. With 0 the energy is never repaid. Default:
    /// 0.01.
    pub repay: f64,
}

impl Default for PassivityConfig {
    fn default() -> Self {
        Self { tank: 0.005, max_damping: 5.0, repay: 0.01 }
    }
}

/// Energies at the port, J.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Port {
    /// Energy that may still be given to the hand.
    pub available: f64,
    /// Energy that the hand has put in since the loop began: the sum of all positive `-F dx`.
    pub taken: f64,
    /// Energy that the hand has received since the loop began: the sum of all positive `F dx`.
    pub given: f64,
    /// Net energy that other participants have put in since the loop began.
    pub supplied: f64,
    /// Energy repaid after fades. It is never more than the springs gained during the fades, never
    /// more than the tank holds at a time, and not faster than [`PassivityConfig::repay`].
    pub repaid: f64,
    /// Force times displacement that the controller has held back or damped away, for diagnosis.
    pub dissipated: f64,
}

/// Time-domain passivity observer and controller (Hannaford and Ryu 2002).
///
/// A held force does exactly the work `F[k-1] . (x[k] - x[k-1])`, so the energy is counted without
/// approximation (Stramigioli et al. 2005): `E[k] = E[k-1] - F[k-1] . (x[k] - x[k-1])`. Absorbed
/// energy counts only as far as the springs and the body can store it. Energy that the hand spends
/// against viscous drag is therefore not credited.
///
/// The controller has two remedies. [`dissipate`](Self::dissipate) damps leaked energy away (from
/// sampling, delay or a coarse encoder), with at most the damping that the device renders stably.
/// [`restrain`](Self::restrain) is the hard bound: it cuts the force so that the available energy
/// is not overdrawn, even while the force still needs time to fall at its slew limit.
#[derive(Debug, Clone, Copy)]
pub struct Passivity {
    config: PassivityConfig,
    port: Port,
    /// Energy that would be available if nothing had leaked, J.
    full: f64,
    /// Energy that is missing although nothing has leaked, J. Springs that were stretched while the
    /// hand could not feel them account for it.
    forgiven: f64,
}

impl Passivity {
    /// Creates the state with a full tank.
    pub fn new(config: PassivityConfig) -> Self {
        Self {
            config,
            port: Port { available: config.tank, ..Port::default() },
            full: config.tank,
            forgiven: 0.0,
        }
    }

    /// Returns the energies so far.
    pub fn port(&self) -> Port {
        self.port
    }

    /// Counts the work of the `force` (N) that was held while the hand `moved` (m), and the energy
    /// that others `supplied` (J) in that time.
    ///
    /// `stored` is the energy that the springs and the body could give back (J). If `partial` is
    /// set, `stored` is only a lower bound and all absorbed energy counts. While `holding` is
    /// `false`, the tank is refilled, so that the next grab starts with a full tank.
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
        // The energy stored in the springs and the body can only come from the hand, the tank or
        // others. If less is available, the difference has leaked.
        self.full = if holding { self.config.tank + stored.max(0.0) } else { self.config.tank };
        let balance = self.port.available - given + supplied;
        self.port.available = match (holding, partial) {
            (false, _) => self.full,
            (true, true) => balance,
            (true, false) => balance.min(self.full),
        };
    }

    /// Fills the tank for a new engagement. Call this method while the gain is zero.
    pub fn refill(&mut self) {
        self.port.available = self.port.available.max(self.config.tank);
    }

    /// Marks the missing energy as not leaked, because a fade or a ramp kept the hand from feeling
    /// a stretched spring. The energy is not to be damped away, but it is not available either.
    pub fn forgive(&mut self) {
        self.forgiven = (self.full - self.port.available).max(0.0);
    }

    /// Repays energy after a fade, for a time step of `dt` (s). A part of the
    /// [forgiven](Self::forgive) energy becomes available again, until the tank is full.
    pub fn repay(&mut self, dt: f64) {
        let room = (self.config.tank - self.port.available).min(self.forgiven);
        let back = (self.config.repay * dt).min(room);
        if back > 0.0 {
            self.port.available += back;
            self.port.repaid += back;
            self.forgiven -= back;
        }
    }

    /// Returns the damping force (N) that recovers leaked energy, at `velocity` (m/s) over `dt`
    /// (s).
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

    /// Returns the force (N), cut so that the available energy covers its work until it can be
    /// taken away. The direction is kept.
    ///
    /// A force `f` that is held for `dt` and then reduced at the slew limit `S` (N/s) has the
    /// impulse `I = f dt + f^2 / (2 S)`. On a handle of mass `M` that already moves along the force
    /// at `v`, the force does at most the work `v I + I^2 / (2 M)`. `M` is the mass of the device
    /// alone. A hand on the device only reduces the work.
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
        // This is the root of `I^2 / (2 M) + v I = E`, written without the cancellation of a fast
        // handle.
        let root = speed.hypot((2.0 * energy / mass).sqrt());
        let impulse = if speed > 0.0 { 2.0 * energy / (root + speed) } else { mass * (root - speed) };
        if impulse == f64::INFINITY {
            return *force;
        }
        let most = if slew.is_finite() {
            // This is the root of `f^2 / (2 S) + f dt = I`.
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
