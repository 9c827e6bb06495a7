//! Sample validation: a sample must be finite, plausible and alive. The velocity is estimated from
//! the positions.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::{DeviceInfo, Fault, Sample, clamp_magnitude};

/// Highest plausible speed of a hand, m/s. A higher speed is a jump of the measurement or an
/// instability of the device's filter.
const FASTEST: f64 = 10.0;
/// Time that a new position must hold before it is accepted, s.
const ACCEPT_AFTER: f64 = 0.02;
/// Time without a change of the measurement counter after which the device counts as frozen, s.
const FROZEN_COUNT: f64 = 0.05;
/// Time of bit-equal positions under a force after which a device without a counter counts as
/// frozen, s.
const FROZEN_BITS: f64 = 0.5;
/// Largest distance of a sample from the fitted line, in steps of the encoder. Rounding alone makes
/// 0.5.
const TOLERANCE: f64 = 0.6;
/// Maximum number of samples for the velocity estimate.
pub(crate) const WINDOW: usize = 16;

/// A validated sample.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Believed {
    pub(crate) position: Vector3<f64>,
    pub(crate) velocity: Vector3<f64>,
    pub(crate) orientation: UnitQuaternion<f64>,
    pub(crate) buttons: u32,
    pub(crate) fault: Option<Fault>,
    /// Whether the position was taken over from a new position. The displacement since the last
    /// tick is then meaningless.
    pub(crate) jumped: bool,
    /// Whether the measurement jumped and not the hand. The tool must then not follow the position.
    pub(crate) shifted: bool,
}

#[derive(Debug, Clone)]
pub(crate) struct SampleValidation {
    resolution: f64,
    frozen_force: f64,
    last: Option<(Vector3<f64>, UnitQuaternion<f64>)>,
    /// Whether the next sample is accepted at any position.
    fresh: bool,
    raw: Option<Vector3<f64>>,
    settling: f64,
    same: f64,
    last_sample: Option<Sample>,
    window: [(f64, Vector3<f64>); WINDOW],
    filled: usize,
    head: usize,
    buttons: u32,
    /// Buttons that have been seen open since the device appeared. Other buttons may be stuck.
    trusted: u32,
}

impl SampleValidation {
    pub(crate) fn new(info: &DeviceInfo) -> Self {
        Self {
            resolution: info.resolution,
            frozen_force: 0.05 * info.peak_force,
            last: None,
            fresh: true,
            raw: None,
            settling: 0.0,
            same: 0.0,
            last_sample: None,
            window: [(0.0, Vector3::zeros()); WINDOW],
            filled: 0,
            head: 0,
            buttons: 0,
            trusted: 0,
        }
    }

    /// Resets the state after a loss of the device. Only the last position and orientation stay
    /// until there is a sample, and every button must be seen open again.
    pub(crate) fn forget(&mut self) {
        self.fresh = true;
        self.raw = None;
        self.filled = 0;
        self.same = 0.0;
        self.last_sample = None;
        self.buttons = 0;
        self.trusted = 0;
    }

    /// Returns the last pose with a fault, for a period without a valid sample.
    pub(crate) fn hold(&mut self, fault: Fault) -> Believed {
        let (position, orientation) = self.last.unwrap_or((Vector3::zeros(), UnitQuaternion::identity()));
        self.filled = 0;
        Believed {
            position,
            velocity: Vector3::zeros(),
            orientation,
            buttons: self.buttons,
            fault: Some(fault),
            jumped: false,
            shifted: false,
        }
    }

    pub(crate) fn take(&mut self, now: f64, dt: f64, sample: &Sample, force: f64) -> Believed {
        let numbers =
            sample.position.iter().chain(&sample.orientation).chain(sample.velocity.iter().flatten());
        let [x, y, z, w] = sample.orientation;
        let length = (x * x + y * y + z * z + w * w).sqrt();
        if !numbers.into_iter().all(|v| v.is_finite()) || length < 0.5 {
            return self.hold(Fault::NotFinite);
        }
        let raw = Vector3::from(sample.position);
        let orientation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let reach = FASTEST * dt + 4.0 * self.resolution;

        let (mut jumped, mut shifted) = (false, false);
        if let (Some((believed, _)), false) = (self.last, self.fresh) {
            let leap = (raw - believed).norm();
            if leap > reach {
                let steady = self.raw.is_some_and(|r| (raw - r).norm() <= reach);
                self.settling = if steady { self.settling + dt } else { 0.0 };
                self.raw = Some(raw);
                if self.settling < ACCEPT_AFTER {
                    return self.hold(Fault::Jump(leap));
                }
                (jumped, shifted) = (true, true);
                self.filled = 0;
            }
        } else {
            jumped = true;
        }
        self.settling = 0.0;
        self.fresh = false;
        self.raw = Some(raw);
        self.last = Some((raw, orientation));

        self.trusted |= !sample.buttons;
        self.buttons = sample.buttons & self.trusted;

        let frozen = self.frozen(dt, sample, force);
        self.note(now, raw);
        let reported = sample.velocity.map(Vector3::from);
        // The largest component is tested because the square of a number like 1e200 is not finite,
        // and such a number must not pass.
        let wild = reported.map(|v| v.amax()).filter(|speed| *speed > FASTEST);
        let velocity = match reported {
            Some(v) if wild.is_none() => v,
            _ => clamp_magnitude(&self.estimate(now, raw), FASTEST),
        };
        Believed {
            position: raw,
            velocity,
            orientation,
            buttons: self.buttons,
            fault: frozen.or(wild.map(Fault::TooFast)),
            jumped,
            shifted,
        }
    }

    fn frozen(&mut self, dt: f64, sample: &Sample, force: f64) -> Option<Fault> {
        let same = self.last_sample.is_some_and(|last| match (last.sequence, sample.sequence) {
            (Some(a), Some(b)) => a == b,
            _ => last == *sample && force > self.frozen_force,
        });
        self.same = if same { self.same + dt } else { 0.0 };
        let limit = if sample.sequence.is_some() { FROZEN_COUNT } else { FROZEN_BITS };
        self.last_sample = Some(*sample);
        (self.same >= limit).then_some(Fault::Frozen(self.same))
    }

    /// Stores a position and its time for [`estimate`](Self::estimate).
    fn note(&mut self, now: f64, position: Vector3<f64>) {
        self.head = (self.head + 1) % WINDOW;
        self.window[self.head] = (now, position);
        self.filled = (self.filled + 1).min(WINDOW);
    }

    /// Estimates the velocity with first-order adaptive windowing (Janabi-Sharifi, Hayward and Chen
    /// 2000).
    ///
    /// For each axis, the method uses the longest window over which a straight line explains every
    /// sample to within its rounding. The noise is low at slow motion, and there is no lag at fast
    /// motion.
    fn estimate(&self, now: f64, position: Vector3<f64>) -> Vector3<f64> {
        let at = |back: usize| self.window[(self.head + WINDOW - back) % WINDOW];
        Vector3::from_fn(|axis, _| {
            let mut best = 0.0;
            for n in 1..self.filled {
                let (t0, p0) = at(n);
                if now - t0 <= 0.0 {
                    break;
                }
                let slope = (position[axis] - p0[axis]) / (now - t0);
                let explained = (1..n).all(|k| {
                    let (t, p) = at(k);
                    (position[axis] - slope * (now - t) - p[axis]).abs() <= TOLERANCE * self.resolution
                });
                if !explained {
                    break;
                }
                best = slope;
            }
            best
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::VirtualConfig;

    fn validation(resolution: f64) -> SampleValidation {
        SampleValidation::new(&VirtualConfig { resolution, ..VirtualConfig::default() }.info())
    }

    #[test]
    fn velocity_of_a_coarse_encoder_is_usable() {
        // At 0.1 m/s with a 50 um encoder at 1 kHz, plain differences give 0.1, 0.15 or 0.05 m/s. A
        // slow 5 mm/s gives 0 or 50 mm/s.
        for speed in [0.1, 0.033, 0.005] {
            let mut validation = validation(50e-6);
            let (mut worst, mut sum, mut plain, mut last) = (0.0f64, 0.0, 0.0, 0.0);
            for k in 0..1050 {
                let t = f64::from(k) * 1e-3;
                let x = (speed * t / 50e-6).round() * 50e-6;
                let b = validation.take(t, 1e-3, &Sample::at([x, 0.0, 0.0]), 0.0);
                if k >= 50 {
                    worst = worst.max((b.velocity.x - speed).abs());
                    sum += (b.velocity.x - speed).powi(2);
                    plain += ((x - last) / 1e-3 - speed).powi(2);
                }
                last = x;
            }
            // The estimate is never off by more than one encoder step over two periods. Its squared
            // error is at most 0.3 of that of plain differences.
            assert!(worst <= 50e-6 / 2e-3 + 1e-9, "{speed}: off by {worst}");
            assert!(sum <= 0.3 * plain, "{speed}: {sum} of {plain}");
        }
        // Without encoder steps the estimate is the plain difference, with no lag beyond half a
        // period.
        let mut fine = validation(0.0);
        let mut last = 0.0;
        for k in 0..50 {
            let t = f64::from(k) * 1e-3;
            last = fine.take(t, 1e-3, &Sample::at([t * t, 0.0, 0.0]), 0.0).velocity.x;
        }
        assert!((last - (0.049 + 0.048)).abs() < 1e-9, "{last}");
    }

    #[test]
    fn nonsense_is_not_believed() {
        let mut validation = validation(0.0);
        let good = Sample::at([0.01, 0.02, 0.03]);
        assert!(validation.take(0.0, 1e-3, &good, 0.0).fault.is_none());
        for bad in [
            Sample::at([f64::NAN, 0.0, 0.0]),
            Sample { orientation: [0.0; 4], ..good },
            Sample { velocity: Some([f64::INFINITY, 0.0, 0.0]), ..good },
        ] {
            let b = validation.take(0.001, 1e-3, &bad, 0.0);
            assert_eq!(b.fault, Some(Fault::NotFinite));
            assert_eq!(b.position, Vector3::from(good.position));
        }
        // A leap of 1 m in 1 ms is refused until the new position has held for 20 ms. The position
        // is then taken over as a jump.
        let far = Sample::at([1.01, 0.02, 0.03]);
        let mut refused = 0;
        let b = loop {
            let b = validation.take(0.002, 1e-3, &far, 0.0);
            if b.fault.is_none() {
                break b;
            }
            assert!(matches!(b.fault, Some(Fault::Jump(d)) if (d - 1.0).abs() < 1e-12));
            assert_eq!(b.position, Vector3::from(good.position));
            refused += 1;
        };
        assert_eq!(refused, 20);
        assert!(b.jumped);
    }

    #[test]
    fn a_velocity_that_no_hand_has_is_estimated_instead() {
        let mut validation = validation(0.0);
        let at = |k: u32| f64::from(k) * 1e-3;
        let told = |k: u32, v| Sample { velocity: Some(v), ..Sample::at([0.1 * at(k), 0.0, 0.0]) };
        for k in 0..20 {
            let b = validation.take(at(k), 1e-3, &told(k, [0.1, 0.0, 0.0]), 0.0);
            assert_eq!((b.fault, b.velocity.x), (None, 0.1));
        }
        for (k, wild) in [(20, 1e200), (21, -f64::MAX), (22, 10.5)] {
            let b = validation.take(at(k), 1e-3, &told(k, [0.0, wild, 0.0]), 0.0);
            assert_eq!(b.fault, Some(Fault::TooFast(f64::abs(wild))));
            assert!((b.velocity - Vector3::new(0.1, 0.0, 0.0)).norm() < 1e-9, "{}", b.velocity);
        }
        assert_eq!(validation.take(at(23), 1e-3, &told(23, [0.1, 0.0, 0.0]), 0.0).fault, None);
    }

    #[test]
    fn frozen_and_stuck() {
        let mut validation = validation(0.0);
        let stuck = Sample { buttons: 0b11, ..Sample::default() };
        // These buttons were down before the device appeared. They count only after they have been
        // seen open.
        assert_eq!(validation.take(0.0, 1e-3, &stuck, 0.0).buttons, 0);
        assert_eq!(validation.take(0.0, 1e-3, &Sample { buttons: 0b10, ..stuck }, 0.0).buttons, 0);
        assert_eq!(validation.take(0.0, 1e-3, &stuck, 0.0).buttons, 0b01);
        // A hand at rest without force is no fault. Under force it is a fault after half a second.
        for _ in 0..2000 {
            assert!(validation.take(0.0, 1e-3, &stuck, 0.0).fault.is_none());
        }
        let fault = (0..501).find_map(|_| validation.take(0.0, 1e-3, &stuck, 1.0).fault);
        assert!(matches!(fault, Some(Fault::Frozen(t)) if t > 0.49), "{fault:?}");
        // With a counter, a hand at rest differs from a dead device, and the fault comes sooner.
        let mut counted = SampleValidation::new(&VirtualConfig::default().info());
        for k in 0..2000 {
            assert!(counted.take(0.0, 1e-3, &Sample { sequence: Some(k), ..stuck }, 1.0).fault.is_none());
        }
        let dead = Sample { sequence: Some(7), ..stuck };
        let n = (0..100).position(|_| counted.take(0.0, 1e-3, &dead, 0.0).fault.is_some()).unwrap();
        assert!((50..=51).contains(&n), "{n}");
    }
}
