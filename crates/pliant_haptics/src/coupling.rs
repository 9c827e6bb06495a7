//! The spring between the hand and the body: how stiff it may be on this device at this rate.

use crate::DeviceInfo;

/// What is wanted of the coupling, and how much room to leave.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CouplingConfig {
    /// Stiffness between the hand and the body, N/m in device space. Default: infinite, as stiff as the device closes.
    pub stiffness: f64,
    /// Damping of the same, N s/m. Default: 0.5.
    pub damping: f64,
    /// Part of the theoretical limit that is used, 0 to 1. Default: 0.7.
    pub headroom: f64,
}

impl Default for CouplingConfig {
    fn default() -> Self {
        Self { stiffness: f64::INFINITY, damping: 0.5, headroom: 0.7 }
    }
}

/// Which of the limits was the tightest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum CouplingLimit {
    /// None: it is as wanted.
    None,
    /// Damping against the delay of hold and device, `K < (b + B) / (T/2 + d)`.
    Rate,
    /// Damping against the round trip to the simulation.
    RoundTrip,
    /// What the maker says.
    Device,
}

/// The coupling in force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coupling {
    /// N/m, device space.
    pub stiffness: f64,
    /// N s/m, device space.
    pub damping: f64,
    /// What was wanted, N/m and N s/m.
    pub wanted: [f64; 2],
    /// What limited the stiffness.
    pub stiffness_limit: CouplingLimit,
    /// What limited the damping.
    pub damping_limit: CouplingLimit,
}

impl Coupling {
    /// The stiffest coupling not above what is wanted that `device` closes at `rate` (Hz) with `delay` (s) beyond the device's own, to a body that
    /// answers after `round_trip` (s).
    ///
    /// The limit of a sampled spring with delay, `K < (b + B) / (T/2 + d)` (`2 b / T` when `B = d = 0`); that of a virtual damper whose
    /// velocity is measured, a third of `M / lag` (see [`stable_damping`](crate::stable_damping)); and the
    /// maker's own numbers. A body far away that follows the hand entirely is a spring to where the hand was: `M x'' + (b + B) x' + K (x - x(t - t_r)) = 0`
    /// is stable for any `t_r` if the delayed part is nowhere larger than the rest (small gain), `K < (b + B)^2 / M`, or as a spring with that
    /// much delay; the larger of the two counts. Numbers that are not finite or not in their range count as the default.
    pub fn clamp(
        config: &CouplingConfig,
        device: &DeviceInfo,
        rate: f64,
        delay: f64,
        round_trip: f64,
    ) -> Self {
        let default = CouplingConfig::default();
        let or = |value: f64, ok: bool, other: f64| if ok { value } else { other };
        let headroom = or(config.headroom, config.headroom > 0.0 && config.headroom <= 1.0, default.headroom);
        let wanted = or(config.stiffness, config.stiffness > 0.0, default.stiffness);
        let wanted_damping =
            or(config.damping, config.damping.is_finite() && config.damping >= 0.0, default.damping);
        let lag = 0.5 / rate + device.delay + delay.max(0.0);

        let limits = [
            (crate::safety::stable_damping(device, rate, delay), CouplingLimit::Rate),
            (headroom * device.max_damping, CouplingLimit::Device),
        ];
        let (damping, damping_limit) = tightest(wanted_damping, &limits);
        let calming = device.damping + damping;
        let far = if round_trip > 0.0 {
            (calming / (lag + round_trip)).max(calming * calming / device.mass)
        } else {
            f64::INFINITY
        };
        let limits = [
            (headroom * calming / lag, CouplingLimit::Rate),
            (headroom * far, CouplingLimit::RoundTrip),
            (headroom * device.max_stiffness, CouplingLimit::Device),
        ];
        let (stiffness, stiffness_limit) = tightest(wanted, &limits);
        Self { stiffness, damping, wanted: [wanted, wanted_damping], stiffness_limit, damping_limit }
    }

    /// Whether anything had to give.
    pub fn is_clamped(&self) -> bool {
        self.stiffness_limit != CouplingLimit::None || self.damping_limit != CouplingLimit::None
    }

    /// How a grab on the body is to be configured so that body and loop hold the same spring; `force_scale` and `motion_scale` are the
    /// tool's: a spring of `K` in the world feels like `motion_scale^2 force_scale K` in the hand.
    pub fn grab_config(&self, motion_scale: f64, force_scale: f64) -> pliant_modal::GrabConfig {
        let felt = motion_scale * motion_scale * force_scale;
        let stiffness = self.stiffness / felt;
        let ok = stiffness.is_finite() && stiffness > 0.0;
        pliant_modal::GrabConfig {
            stiffness: ok.then_some(stiffness),
            relaxation: if self.stiffness.is_finite() && self.stiffness > 0.0 {
                self.damping / self.stiffness
            } else {
                0.0
            },
        }
    }
}

impl std::fmt::Display for Coupling {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let why = |limit| match limit {
            CouplingLimit::None => "as wanted",
            CouplingLimit::Rate => "clamped by rate and delay",
            CouplingLimit::RoundTrip => "clamped by the round trip to the simulation",
            CouplingLimit::Device => "clamped by the device",
        };
        write!(
            f,
            "stiffness {:.0} N/m ({}, {:.0} wanted), damping {:.2} N s/m ({}, {:.2} wanted)",
            self.stiffness,
            why(self.stiffness_limit),
            self.wanted[0],
            self.damping,
            why(self.damping_limit),
            self.wanted[1],
        )
    }
}

fn tightest(wanted: f64, limits: &[(f64, CouplingLimit)]) -> (f64, CouplingLimit) {
    limits
        .iter()
        .fold((wanted, CouplingLimit::None), |best, &limit| if limit.0 < best.0 { limit } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::VirtualConfig;

    #[test]
    fn the_limits_are_the_known_ones() {
        let device = VirtualConfig { mass: 0.2, damping: 0.5, ..VirtualConfig::default() }.info();
        let open = CouplingConfig { stiffness: 1e9, damping: 0.0, headroom: 1.0 };
        // 2 b / T of the reference: m = 0.2 kg, b = 0.5 N s/m, T = 1 ms give 1000 N/m.
        let c = Coupling::clamp(&open, &device, 1000.0, 0.0, 0.0);
        assert!((c.stiffness - 1000.0).abs() < 1e-9, "{c}");
        assert_eq!(c.stiffness_limit, CouplingLimit::Rate);
        // (b + B) / (T/2 + d) with B = 0.5, d = 4.5 ms: 1 / 5 ms.
        let c = Coupling::clamp(&CouplingConfig { damping: 0.5, ..open }, &device, 1000.0, 4.5e-3, 0.0);
        assert!((c.stiffness - 200.0).abs() < 1e-9, "{c}");
        // The maker's word counts where it is the tighter one.
        let touch = VirtualConfig::touch().info();
        let c = Coupling::clamp(
            &CouplingConfig { headroom: 1.0, damping: 1.0, ..open },
            &touch,
            8000.0,
            0.0,
            0.0,
        );
        assert_eq!((c.stiffness, c.stiffness_limit), (400.0, CouplingLimit::Device));
        // Nothing to clamp.
        let c = Coupling::clamp(
            &CouplingConfig { stiffness: 50.0, damping: 0.1, headroom: 0.7 },
            &touch,
            1000.0,
            0.0,
            0.0,
        );
        assert!(!c.is_clamped(), "{c}");
        // Nonsense is the default, not a crash.
        let c = Coupling::clamp(
            &CouplingConfig { stiffness: f64::NAN, damping: -1.0, headroom: 9.0 },
            &touch,
            1000.0,
            0.0,
            0.0,
        );
        assert!(c.stiffness.is_finite() && c.damping.is_finite());
    }
}
