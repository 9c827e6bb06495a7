//! A simulated device with a hand on it, which serves to measure stability.

use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering},
};

use nalgebra::Vector3;
use pliant_modal::{Coefficients, Integrator};

use crate::{DeviceInfo, Fault, HandModel, HapticDevice, InfoError, Sample, Scheduler, Wrench};

/// Properties of a virtual device.
#[derive(Debug, Clone, PartialEq)]
pub struct VirtualConfig {
    /// Name of the device. Default: "virtual".
    pub name: &'static str,
    /// Apparent mass at the tool, kg. Default: 0.2.
    pub mass: f64,
    /// Viscous damping, N s/m. Default: 0.5.
    pub damping: f64,
    /// Coulomb friction, N. Default: 0.
    pub friction: f64,
    /// Step of the position measurement, m. With 0 the measurement is exact. Default: 0.
    pub resolution: f64,
    /// Maximum force, N. Larger forces are cut, as in real motors. Default: 10.
    pub peak_force: f64,
    /// Maximum permanent force, N. Default: 3.
    pub continuous_force: f64,
    /// Maximum stiffness as a maker would state it, N/m. Default: infinite.
    pub max_stiffness: f64,
    /// Maximum damping as a maker would state it, N s/m. Default: infinite.
    pub max_damping: f64,
    /// Delay from a command to the force beyond the hold, in whole periods, at most 63. Default: 0.
    pub delay_periods: usize,
    /// Length of a period that the declared delay assumes, s. Default: 0.001.
    pub period: f64,
    /// Integration rate, Hz, at least 20,000. Default: 20,000.
    pub integration_rate: f64,
}

impl Default for VirtualConfig {
    fn default() -> Self {
        Self {
            name: "virtual",
            mass: 0.2,
            damping: 0.5,
            friction: 0.0,
            resolution: 0.0,
            peak_force: 10.0,
            continuous_force: 3.0,
            max_stiffness: f64::INFINITY,
            max_damping: f64::INFINITY,
            delay_periods: 0,
            period: 1e-3,
            integration_rate: 20_000.0,
        }
    }
}

impl VirtualConfig {
    /// Properties like a 3D Systems Touch: 3.3 N, 400 N/m, 4 N s/m. Mass, damping, friction and
    /// encoder are estimates.
    pub fn touch() -> Self {
        Self {
            name: "virtual Touch",
            mass: 0.045,
            damping: 0.3,
            friction: 0.26,
            resolution: 55e-6,
            peak_force: 3.3,
            continuous_force: 0.88,
            max_stiffness: 400.0,
            max_damping: 4.0,
            ..Self::default()
        }
    }

    /// Properties like a PHANTOM Omni: 3.3 N, 700 N/m, 5 N s/m. The rest is estimated.
    pub fn omni() -> Self {
        Self { name: "virtual Omni", max_stiffness: 700.0, max_damping: 5.0, ..Self::touch() }
    }

    /// Properties like a PHANTOM Premium 1.5: 8.5 N, 800 N/m, 5 N s/m. The rest is estimated.
    pub fn premium() -> Self {
        Self {
            name: "virtual Premium 1.5",
            mass: 0.075,
            damping: 0.2,
            friction: 0.04,
            resolution: 30e-6,
            peak_force: 8.5,
            continuous_force: 1.4,
            max_stiffness: 800.0,
            max_damping: 5.0,
            ..Self::default()
        }
    }

    /// Properties like an omega.3: 12 N, 5000 N/m, 30 N s/m. The rest is estimated.
    pub fn omega3() -> Self {
        Self {
            name: "virtual omega.3",
            mass: 0.2,
            damping: 1.5,
            friction: 0.1,
            resolution: 10e-6,
            peak_force: 12.0,
            continuous_force: 12.0,
            max_stiffness: 5000.0,
            max_damping: 30.0,
            ..Self::default()
        }
    }

    /// Returns the properties as the device reports them.
    pub fn info(&self) -> DeviceInfo {
        DeviceInfo {
            name: self.name.into(),
            serial: String::new(),
            peak_force: self.peak_force,
            continuous_force: self.continuous_force,
            peak_torque: 0.0,
            force_axes: [true; 3],
            torque_axes: [false; 3],
            max_stiffness: self.max_stiffness,
            max_damping: self.max_damping,
            damping: self.damping,
            friction: self.friction,
            mass: self.mass,
            resolution: self.resolution,
            delay: self.delay_periods as f64 * self.period,
            workspace: [[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]],
            buttons: 32,
            simulated: true,
        }
    }
}

/// Moves the hand of a [`VirtualDevice`] from another thread and simulates failures of the device.
#[derive(Debug, Clone, Default)]
pub struct VirtualHandle {
    shared: Arc<VirtualShared>,
}

#[derive(Debug, Default)]
struct VirtualShared {
    target: [AtomicU64; 3],
    buttons: AtomicU32,
    gone: AtomicBool,
    frozen: AtomicBool,
}

impl VirtualHandle {
    /// Sets the target of the arm, m, device axes. A target that is not finite is refused.
    pub fn set_target(&self, target: [f64; 3]) {
        if target.iter().all(|x| x.is_finite()) {
            for (cell, x) in self.shared.target.iter().zip(target) {
                cell.store(x.to_bits(), Ordering::Relaxed);
            }
        }
    }

    /// Returns the target of the arm, m, device axes.
    pub fn target(&self) -> [f64; 3] {
        std::array::from_fn(|i| f64::from_bits(self.shared.target[i].load(Ordering::Relaxed)))
    }

    /// Presses exactly these buttons (bits).
    pub fn set_buttons(&self, buttons: u32) {
        self.shared.buttons.store(buttons, Ordering::Relaxed);
    }

    /// Unplugs the device or plugs it in again.
    pub fn set_gone(&self, gone: bool) {
        self.shared.gone.store(gone, Ordering::Relaxed);
    }

    /// Freezes the measurement while the device keeps moving.
    pub fn set_frozen(&self, frozen: bool) {
        self.shared.frozen.store(frozen, Ordering::Relaxed);
    }
}

/// A simulated device with a hand: `(M + m) x'' = F + f - b x' + B (v0 - x') + K (x0 - x)`, with
/// the friction `f` and the held force `F`.
///
/// The motion is integrated in closed form between the substeps (20 kHz or more). Without friction,
/// the integration therefore neither loses nor gains energy, and any instability comes from the
/// loop.
#[derive(Debug)]
pub struct VirtualDevice {
    config: VirtualConfig,
    hand: HandModel,
    handle: VirtualHandle,
    position: Vector3<f64>,
    velocity: Vector3<f64>,
    last_target: Option<Vector3<f64>>,
    coefficients: Option<(f64, Coefficients)>,
    /// Commands that have not reached the motors yet.
    line: [Vector3<f64>; 64],
    head: usize,
    force: Vector3<f64>,
    work: f64,
    sequence: u64,
    displayed: Vector3<f64>,
}

impl VirtualDevice {
    /// Creates a device at rest in the center of its workspace.
    ///
    /// # Errors
    /// Returns an error if a number of the device or the hand is out of range.
    pub fn new(config: VirtualConfig, hand: HandModel) -> Result<Self, InfoError> {
        config.info().check()?;
        if !(config.integration_rate.is_finite() && config.integration_rate >= 20_000.0) {
            let (what, expected) = ("integration_rate", "20 kHz or more");
            return Err(InfoError { what, expected, got: config.integration_rate });
        }
        if config.delay_periods > 63 {
            let got = config.delay_periods as f64;
            return Err(InfoError { what: "delay_periods", expected: "at most 63", got });
        }
        if !hand.is_valid() {
            return Err(InfoError { what: "hand", expected: "finite, 0 or more", got: hand.mass });
        }
        let zero = Vector3::zeros();
        Ok(Self {
            config,
            hand,
            handle: VirtualHandle::default(),
            position: zero,
            velocity: zero,
            last_target: None,
            coefficients: None,
            line: [zero; 64],
            head: 0,
            force: zero,
            work: 0.0,
            sequence: 0,
            displayed: zero,
        })
    }

    /// Returns the handle that moves the hand while the loop owns the device.
    pub fn handle(&self) -> VirtualHandle {
        self.handle.clone()
    }

    /// Returns the true position of the handle, m.
    pub fn position(&self) -> [f64; 3] {
        self.position.into()
    }

    /// Returns the true velocity of the handle, m/s.
    pub fn velocity(&self) -> [f64; 3] {
        self.velocity.into()
    }

    /// Returns the force of the motors in the last period, N.
    pub fn force(&self) -> [f64; 3] {
        self.force.into()
    }

    /// Returns the work that the motors have done on the hand, J. The value is exact because the
    /// force is constant within a period.
    pub fn work(&self) -> f64 {
        self.work
    }

    /// Returns the kinetic energy of handle and hand, J.
    pub fn kinetic_energy(&self) -> f64 {
        0.5 * (self.config.mass + self.hand.mass) * self.velocity.norm_squared()
    }

    /// Sets the position and the velocity of the handle.
    pub fn place(&mut self, position: [f64; 3], velocity: [f64; 3]) {
        self.position = position.into();
        self.velocity = velocity.into();
    }

    /// Returns the measured position, rounded to the encoder's step.
    fn measured(&self) -> Vector3<f64> {
        let step = self.config.resolution;
        if step > 0.0 { self.position.map(|x| (x / step).round() * step) } else { self.position }
    }

    /// Holds `force` (N) for `dt` (s).
    pub fn advance(&mut self, force: [f64; 3], dt: f64) {
        if !(dt.is_finite() && dt > 0.0) {
            return;
        }
        // A longer standstill, such as a night in the debugger, is not worth integrating.
        let dt = dt.min(1.0);
        let command = Vector3::from(force).map(|x| if x.is_finite() { x } else { 0.0 });
        self.head = (self.head + 1) % self.line.len();
        self.line[self.head] = command;
        let at = (self.head + self.line.len() - self.config.delay_periods) % self.line.len();
        self.force = crate::clamp_magnitude(&self.line[at], self.config.peak_force);

        let target = Vector3::from(self.handle.target());
        let from = self.last_target.unwrap_or(target);
        self.last_target = Some(target);
        // With only held forces, the closed form needs no substeps.
        let exact =
            self.config.friction == 0.0 && (target == from || self.hand.stiffness + self.hand.damping == 0.0);
        let steps = if exact { 1.0 } else { (dt * self.config.integration_rate).ceil().max(1.0) };
        let h = dt / steps;
        let mass = self.config.mass + self.hand.mass;
        let coefficients = match &self.coefficients {
            Some((length, c)) if *length == h => *c,
            _ => {
                let omega = (self.hand.stiffness / mass).sqrt();
                let damping = (self.config.damping + self.hand.damping) / mass;
                // `new` has checked that the numbers are finite and not negative.
                let Ok(c) = Coefficients::new(Integrator::Exact, omega, damping, h) else { return };
                self.coefficients = Some((h, c));
                c
            }
        };
        let arm_speed = (target - from) / dt;
        let start = self.position;
        let steps = steps as usize;
        for k in 0..steps {
            // The arm moves evenly within the period.
            let arm = from + (target - from) * ((k as f64 + 0.5) / steps as f64);
            let push = (self.force + self.hand.stiffness * arm + self.hand.damping * arm_speed) / mass;
            let before = (self.position, self.velocity);
            for i in 0..3 {
                let [x, v, _] = coefficients.step([before.0[i], before.1[i], 0.0], 0.0, push[i]);
                self.position[i] = x;
                self.velocity[i] = v;
            }
            if self.config.friction > 0.0 {
                // Coulomb friction reduces the speed by at most f h / M, and does not reverse it.
                let most = self.config.friction * h / mass;
                let speed = self.velocity.norm();
                let lost = if speed > most { self.velocity * (most / speed) } else { self.velocity };
                self.velocity -= lost;
                self.position -= lost * (0.5 * h);
            }
        }
        self.work += self.force.dot(&(self.position - start));
    }

    fn sample(&mut self) -> Sample {
        if !self.handle.shared.frozen.load(Ordering::Relaxed) {
            self.sequence += 1;
            self.displayed = self.measured();
        }
        Sample {
            position: self.displayed.into(),
            buttons: self.handle.shared.buttons.load(Ordering::Relaxed),
            sequence: Some(self.sequence),
            ..Sample::default()
        }
    }
}

impl HapticDevice for VirtualDevice {
    fn info(&self) -> DeviceInfo {
        self.config.info()
    }

    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        let period = scheduler.wait();
        if self.handle.shared.gone.load(Ordering::Relaxed) {
            self.advance([0.0; 3], period.dt);
            return Err(Fault::Gone);
        }
        self.advance(wrench.force, period.dt);
        Ok(self.sample())
    }

    fn safe_stop(&mut self) {
        self.line = [Vector3::zeros(); 64];
        self.force = Vector3::zeros();
    }

    fn reopen(&mut self) -> Result<(), Fault> {
        if self.handle.shared.gone.load(Ordering::Relaxed) { Err(Fault::Gone) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn energy_is_exact() {
        // Without damping, friction and a hand, the energy from the motors is the kinetic energy of
        // the handle.
        let mut device =
            VirtualDevice::new(VirtualConfig { damping: 0.0, ..VirtualConfig::default() }, HandModel::NONE)
                .unwrap();
        for k in 0..2000 {
            let t = f64::from(k) * 1e-3;
            device.advance([(17.0 * t).sin(), 0.3, -(5.0 * t).cos()], 1e-3);
        }
        let (work, kinetic) = (device.work(), device.kinetic_energy());
        assert!((work - kinetic).abs() < 1e-9 * kinetic, "{work} and {kinetic}");
    }

    #[test]
    fn hand_settles_where_it_should() {
        let mut device = VirtualDevice::new(VirtualConfig::default(), HandModel::FIRM).unwrap();
        device.handle().set_target([0.01, 0.0, 0.0]);
        for _ in 0..2000 {
            device.advance([1.0, 0.0, 0.0], 1e-3);
        }
        // The position is x0 + F / K = 10 mm + 2 mm.
        assert!((device.position()[0] - 0.012).abs() < 1e-9, "{:?}", device.position());
        // Friction holds against a force that is smaller.
        let config = VirtualConfig { friction: 0.3, ..VirtualConfig::default() };
        let mut device = VirtualDevice::new(config, HandModel::NONE).unwrap();
        for _ in 0..100 {
            device.advance([0.29, 0.0, 0.0], 1e-3);
        }
        assert!(device.position()[0].abs() < 1e-6, "{:?}", device.position());
    }

    #[test]
    fn encoder_rounds_and_nonsense_is_refused() {
        let config = VirtualConfig { resolution: 50e-6, ..VirtualConfig::default() };
        let mut device = VirtualDevice::new(config.clone(), HandModel::NONE).unwrap();
        device.place([1.13e-4, -0.6e-4, 0.0], [0.0; 3]);
        let p = device.sample().position;
        assert!((p[0] - 1e-4).abs() < 1e-12 && (p[1] + 5e-5).abs() < 1e-12, "{p:?}");
        device.advance([f64::NAN, f64::INFINITY, 0.0], 1e-3);
        device.handle().set_target([f64::NAN, 0.0, 0.0]);
        device.advance([0.0; 3], f64::NAN);
        assert!(device.position().iter().all(|x| x.is_finite()));
        for bad in [
            VirtualConfig { mass: 0.0, ..config.clone() },
            VirtualConfig { damping: f64::NAN, ..config.clone() },
            VirtualConfig { integration_rate: 1000.0, ..config.clone() },
            VirtualConfig { delay_periods: 64, ..config },
        ] {
            assert!(VirtualDevice::new(bad, HandModel::NONE).is_err());
        }
    }
}
