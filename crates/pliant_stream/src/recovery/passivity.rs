//! The passivity guard: fading corrections must not add more energy to the visual body than it has
//! lost.
//!
//! The visual state is the confirmed state plus a fading offset. While the offset fades, the visual
//! body gains or loses energy that no hand supplied. This energy is the change of the excess
//!
//! ```text
//! X(s) = E(hidden + s offset) - E(hidden) = s (v . o_v + sum omega^2 q o_q) + s^2 (o_v . o_v + sum omega^2 o_q^2) / 2
//! ```
//!
//! Here `hidden` is the confirmed state.
//!
//! An energy tank holds what the body has dissipated, `h sum c v^2` per tick, up to a small share
//! of the largest energy seen. A growing excess is paid from the tank, and a shrinking excess is
//! paid into it. If the tank does not suffice, the guard cuts the offset to the largest `s` that
//! the tank can pay for. (Time-domain passivity after Hannaford and Ryu 2002, with the correction
//! as the port.)

use pliant_modal::Relaxation;

use crate::state::State;

/// Capacity of the tank as a share of the largest energy that the body has had.
const TANK: f64 = 0.05;

/// Limits the energy that fading corrections may add to the visual body.
#[derive(Debug, Clone)]
pub struct PassivityGuard {
    stiffness: Vec<f64>,
    damping: Vec<f64>,
    /// If the body relaxes: the share of the stiffness that relaxes, and the rate of relaxation,
    /// 1/s.
    relaxing: (f64, f64),
    h: f64,
    level: f64,
    largest: f64,
    excess: f64,
    injected: f64,
    dissipated: f64,
    cuts: u64,
}

impl PassivityGuard {
    /// Creates a guard for modes of stiffness `omega^2` and damping `c` (1/s), stepped by `h` (s).
    pub fn new(omega: &[f64], damping: &[f64], h: f64) -> Self {
        Self {
            stiffness: omega.iter().map(|w| w * w).collect(),
            damping: damping.to_vec(),
            relaxing: (0.0, 0.0),
            h,
            level: 0.0,
            largest: 0.0,
            excess: 0.0,
            injected: 0.0,
            dissipated: 0.0,
            cuts: 0,
        }
    }

    /// Adds the viscoelastic state of a body that relaxes to the energy and the losses.
    pub fn relaxing(mut self, relaxation: Option<Relaxation>) -> Self {
        self.relaxing = relaxation.map_or((0.0, 0.0), |r| (r.ratio, 1.0 / r.time));
        self
    }

    /// Kinetic and elastic energy of a modal state, J. Includes both springs of a mode that
    /// relaxes.
    pub fn energy(&self, state: &State) -> f64 {
        let modes = state.q.iter().zip(&state.v).zip(&self.stiffness);
        let elastic = 0.5 * modes.map(|((q, v), k)| v * v + k * q * q).sum::<f64>();
        if state.z.is_empty() {
            return elastic;
        }
        let flown = state.q.iter().zip(&state.z).zip(&self.stiffness);
        elastic + 0.5 * self.relaxing.0 * flown.map(|((q, z), k)| k * z * (z - 2.0 * q)).sum::<f64>()
    }

    /// Energy that the body loses in one step, J.
    fn lost(&self, state: &State) -> f64 {
        let viscous: f64 = self.damping.iter().zip(&state.v).map(|(c, v)| c * v * v).sum();
        let (ratio, rate) = self.relaxing;
        let branches = state.q.iter().zip(&state.z).zip(&self.stiffness);
        let relaxing: f64 = branches.map(|((q, z), k)| k * (q - z) * (q - z)).sum();
        self.h * (viscous + ratio * rate * relaxing)
    }

    /// Notes that a correction moved the confirmed state under the visual state. The correction
    /// itself adds no energy, so the guard only recomputes the excess.
    pub fn corrected(&mut self, confirmed: &State, visual: &State) {
        self.excess = self.energy(visual) - self.energy(confirmed);
    }

    /// Advances one tick. Returns the share of the offset `visual - confirmed` that may stay, 0 to
    /// 1.
    pub fn admit(&mut self, confirmed: &State, visual: &State) -> f64 {
        let lost = self.lost(confirmed);
        self.dissipated += lost;
        self.largest = self.largest.max(self.energy(confirmed));
        let cap = TANK * self.largest;
        self.level = (self.level + lost).min(cap);
        let (mut linear, mut square) = (0.0, 0.0);
        for (k, stiffness) in self.stiffness.iter().enumerate().take(confirmed.modes()) {
            let (oq, ov) = (visual.q[k] - confirmed.q[k], visual.v[k] - confirmed.v[k]);
            let stretch = confirmed.q[k] - self.relaxing.0 * confirmed.z.get(k).copied().unwrap_or(0.0);
            linear += confirmed.v[k] * ov + stiffness * stretch * oq;
            square += 0.5 * (ov * ov + stiffness * oq * oq);
        }
        let allowed = self.excess + self.level;
        let mut share = 1.0;
        if linear + square > allowed {
            // Find the largest s in [0, 1] with square s^2 + linear s <= allowed. s = 0 (no offset)
            // always satisfies this when the current excess is not negative.
            let root = linear * linear + 4.0 * square * allowed;
            share = if square > 0.0 && root >= 0.0 {
                ((root.sqrt() - linear) / (2.0 * square)).clamp(0.0, 1.0)
            } else {
                0.0
            };
            self.cuts += 1;
        }
        let excess = share * (linear + share * square);
        let paid = excess - self.excess;
        self.injected += paid;
        self.level = (self.level - paid).clamp(0.0, cap.max(0.0));
        self.excess = excess;
        share
    }

    /// Net energy that corrections have added to the visual body so far, J.
    pub fn injected(&self) -> f64 {
        self.injected
    }

    /// Energy that the body has dissipated so far, J.
    pub fn dissipated(&self) -> f64 {
        self.dissipated
    }

    /// Capacity of the tank, J.
    pub fn tank(&self) -> f64 {
        TANK * self.largest
    }

    /// Number of times an offset was cut.
    pub fn cuts(&self) -> u64 {
        self.cuts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrections_never_put_in_more_than_was_lost_and_the_tank() {
        // Two modes oscillate. Every seventh tick brings a correction, some of them large enough to
        // shake the body apart.
        let (omega, c, h) = ([10.0, 31.0], [0.4, 1.0], 0.01);
        let mut guard = PassivityGuard::new(&omega, &c, h);
        let (mut offset_q, mut offset_v) = ([0.0; 2], [0.0; 2]);
        let mut put_in = 0.0;
        let mut last_excess = 0.0;
        for n in 0..4000 {
            let t = f64::from(n) * h;
            let confirmed = State {
                q: (0..2).map(|k| 0.1 * (omega[k] * t).sin() * (-0.05 * t).exp()).collect(),
                v: (0..2).map(|k| 0.1 * omega[k] * (omega[k] * t).cos() * (-0.05 * t).exp()).collect(),
                ..State::zero(2, false)
            };
            let with = |oq: &[f64; 2], ov: &[f64; 2]| State {
                q: (0..2).map(|k| confirmed.q[k] + oq[k]).collect(),
                v: (0..2).map(|k| confirmed.v[k] + ov[k]).collect(),
                ..State::zero(2, false)
            };
            if n % 7 == 0 {
                for k in 0..2 {
                    offset_q[k] += 0.3 * (f64::from(n) * 0.77 + k as f64).sin();
                    offset_v[k] += 5.0 * (f64::from(n) * 1.31 + k as f64).cos();
                }
                guard.corrected(&confirmed, &with(&offset_q, &offset_v));
                last_excess = guard.excess;
            }
            // The offset grows instead of fading, which the guard must stop.
            for k in 0..2 {
                offset_q[k] *= 1.05;
                offset_v[k] *= 1.05;
            }
            let share = guard.admit(&confirmed, &with(&offset_q, &offset_v));
            for k in 0..2 {
                offset_q[k] *= share;
                offset_v[k] *= share;
            }
            let visual = with(&offset_q, &offset_v);
            let excess = guard.energy(&visual) - guard.energy(&confirmed);
            put_in += excess - last_excess;
            last_excess = excess;
            assert!(
                (put_in - guard.injected()).abs() < 1e-6 * (1.0 + put_in.abs()),
                "{put_in} {}",
                guard.injected()
            );
            assert!(
                put_in <= guard.dissipated() + guard.tank() + 1e-9,
                "tick {n}: {put_in} J put in, {} J lost, tank {} J",
                guard.dissipated(),
                guard.tank()
            );
        }
        assert!(guard.cuts() > 100, "the guard must have had work to do");
    }

    #[test]
    fn a_fading_offset_at_rest_is_let_pass() {
        let mut guard = PassivityGuard::new(&[5.0], &[0.1], 0.01);
        let confirmed = State::zero(1, false);
        let at = |q: f64| State { q: vec![q], ..State::zero(1, false) };
        guard.corrected(&confirmed, &at(1.0));
        for n in 1..100 {
            assert_eq!(
                guard.admit(&confirmed, &at(1.0 - f64::from(n) * 0.01)),
                1.0,
                "losing energy needs no leave"
            );
        }
        assert_eq!(guard.cuts(), 0);
    }
}
