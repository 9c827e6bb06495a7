//! Extrapolation of the proxy between two local model updates: with its velocity and without a
//! visible jump.

use nalgebra::Vector3;

use crate::{LocalModel, ToolContact};

/// Longest time that a proxy is extrapolated with its last velocity, and longest time that a
/// correction takes, s.
const LONGEST: f64 = 0.05;

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ProxyExtrapolation {
    tick: u64,
    /// The last local model update: position of the proxy, m, and its velocity, m/s.
    received: Vector3<f64>,
    speed: Vector3<f64>,
    /// Time of arrival of the update on the loop's clock, s.
    since: f64,
    /// Offset of the shown position from the received one at that time, m.
    offset: Vector3<f64>,
    /// Time between updates, s. A game may run two or four steps per frame, so that several updates
    /// arrive as one.
    interval: f64,
}

impl ProxyExtrapolation {
    /// Returns the present position (m) and velocity (m/s) of the proxy.
    ///
    /// The received position is extrapolated as `p + v t` for at most one update interval. The
    /// shown position adds the offset at the last update, and this offset decays to zero over one
    /// update interval. This period of `dt` seconds already counts as a part of the decay. With an
    /// update in every period the offset is zero, and the proxy is at its received position.
    pub(crate) fn advance(
        &mut self,
        now: f64,
        dt: f64,
        model: &LocalModel,
        contact: &ToolContact,
    ) -> (Vector3<f64>, Vector3<f64>) {
        if self.tick != model.tick {
            let fresh = self.tick == 0;
            let would = self.displayed(now, dt);
            let period = if model.period.is_finite() { model.period.clamp(0.0, LONGEST) } else { 0.0 };
            // A longer interval counts at once, and a shorter one gradually.
            let waited = if fresh { period } else { (now - self.since).clamp(0.0, LONGEST) };
            self.interval = period.max(waited.max(self.interval + 0.1 * (waited - self.interval)));
            (self.received, self.speed) = (contact.proxy.into(), contact.velocity.into());
            self.offset = if fresh { Vector3::zeros() } else { would - self.received };
            (self.tick, self.since) = (model.tick, now);
        }
        let mut velocity = if self.age(now) < self.interval { self.speed } else { Vector3::zeros() };
        // A correction that is spread over less than two periods is a step and not a motion. The
        // damper must not see it.
        if self.left(now, dt) > 0.0 && self.interval > 2.0 * dt {
            velocity -= self.offset / self.interval;
        }
        (self.displayed(now, dt), velocity)
    }

    fn age(&self, now: f64) -> f64 {
        (now - self.since).max(0.0)
    }

    /// Returns the part of the offset that remains at the end of this period.
    fn left(&self, now: f64, dt: f64) -> f64 {
        if self.interval > 0.0 { (1.0 - (self.age(now) + dt) / self.interval).max(0.0) } else { 0.0 }
    }

    fn displayed(&self, now: f64, dt: f64) -> Vector3<f64> {
        self.received + self.speed * self.age(now).min(self.interval) + self.offset * self.left(now, dt)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shown_proxy_is_continuous_and_arrives() {
        let mut extrapolation = ProxyExtrapolation::default();
        let mut model = LocalModel { tick: 1, period: 0.025, count: 1, ..LocalModel::default() };
        let mut last = None::<f64>;
        let mut now = 0.0;
        for tick in 1..=8u64 {
            model.tick = tick;
            // The proxy jumps by 1 cm with each update and is sent without a velocity.
            model.contacts[0].proxy = [0.01 * tick as f64, 0.0, 0.0];
            for _ in 0..25 {
                let (p, _) = extrapolation.advance(now, 1e-3, &model, &model.contacts[0].clone());
                if let Some(last) = last {
                    // The proxy moves by 1 cm over the 25 periods between two updates.
                    assert!((p.x - last).abs() < 0.01 / 25.0 + 1e-12, "{} after {last}", p.x);
                }
                last = Some(p.x);
                now += 1e-3;
            }
        }
        for _ in 0..30 {
            now += 1e-3;
            last = Some(extrapolation.advance(now, 1e-3, &model, &model.contacts[0].clone()).0.x);
        }
        assert!((last.unwrap() - 0.08).abs() < 1e-12, "at rest where it was told to be: {last:?}");
    }
    #[test]
    fn an_update_every_period_is_taken_as_it_is() {
        // The simulation is as fast as the loop, or faster. The proxy moves at 0.1 m/s, and the
        // updates contain this velocity.
        for period in [1e-3, 0.5e-3] {
            let mut extrapolation = ProxyExtrapolation::default();
            let mut model = LocalModel { period, count: 1, ..LocalModel::default() };
            for tick in 1..=100u64 {
                let now = tick as f64 * 1e-3;
                model.tick = tick;
                model.contacts[0].proxy = [0.1 * now, 0.0, 0.0];
                model.contacts[0].velocity = [0.1, 0.0, 0.0];
                let (p, v) = extrapolation.advance(now, 1e-3, &model, &model.contacts[0].clone());
                assert!((p.x - 0.1 * now).abs() < 1e-12 && (v.x - 0.1).abs() < 1e-12, "{p} {v} at {now}");
            }
        }
    }

    #[test]
    fn updates_in_bursts_are_extrapolated_from_burst_to_burst() {
        // The simulation runs 120 steps per second and publishes 30 times per second. A proxy at
        // 0.1 m/s must move evenly, and not for only 8 ms of every 33 ms.
        let mut extrapolation = ProxyExtrapolation::default();
        let mut model = LocalModel { period: 1.0 / 120.0, count: 1, ..LocalModel::default() };
        let (mut last, mut worst) = (0.0, 0.0f64);
        for k in 0..1000u32 {
            let now = f64::from(k) * 1e-3;
            let burst = (now * 30.0).floor();
            model.tick = 1 + 4 * burst as u64;
            model.contacts[0].proxy = [0.1 * burst / 30.0, 0.0, 0.0];
            model.contacts[0].velocity = [0.1, 0.0, 0.0];
            let (p, _) = extrapolation.advance(now, 1e-3, &model, &model.contacts[0].clone());
            if k > 200 {
                worst = worst.max((p.x - last - 1e-4).abs());
            }
            last = p.x;
        }
        // Updates fall on whole milliseconds, 33 or 34 ms apart. The motion is off by at most a
        // quarter of a period's motion.
        assert!(worst < 2.5e-5, "{worst} m");
    }
}
