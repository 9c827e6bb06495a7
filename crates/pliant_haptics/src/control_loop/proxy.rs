//! The proxy between two words of the simulation: carried on with its velocity, and never seen to jump.

use nalgebra::Vector3;

use crate::{Contact, LocalModel};

/// The longest that a proxy is carried on with its last velocity, and the longest that a correction takes, s.
const LONGEST: f64 = 0.05;

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ProxyExtrapolation {
    tick: u64,
    /// The newest word: where the proxy was, m, and how fast, m/s.
    told: Vector3<f64>,
    speed: Vector3<f64>,
    /// When it came, on the loop's clock, s.
    since: f64,
    /// Shown minus told at that time, m.
    offset: Vector3<f64>,
    /// How long it takes from word to word, s: a game steps two or four times for a picture, and its words come in one.
    interval: f64,
}

impl ProxyExtrapolation {
    /// Where the proxy is now (m) and how fast (m/s).
    ///
    /// Told: `p + v t`, for as long as it takes from word to word and no longer. Shown: the same plus what it was off when the last word came, taken out over as
    /// long, of which this period of `dt` seconds is already a part: with a word in every period nothing is left of it, and the proxy is where it was
    /// told to be.
    pub(crate) fn advance(
        &mut self,
        now: f64,
        dt: f64,
        model: &LocalModel,
        contact: &Contact,
    ) -> (Vector3<f64>, Vector3<f64>) {
        if self.tick != model.tick {
            let fresh = self.tick == 0;
            let would = self.shown(now, dt);
            let period = if model.period.is_finite() { model.period.clamp(0.0, LONGEST) } else { 0.0 };
            // A longer wait counts at once, a shorter one little by little.
            let waited = if fresh { period } else { (now - self.since).clamp(0.0, LONGEST) };
            self.interval = period.max(waited.max(self.interval + 0.1 * (waited - self.interval)));
            (self.told, self.speed) = (contact.proxy.into(), contact.velocity.into());
            self.offset = if fresh { Vector3::zeros() } else { would - self.told };
            (self.tick, self.since) = (model.tick, now);
        }
        let mut velocity = if self.age(now) < self.interval { self.speed } else { Vector3::zeros() };
        // A correction that is spread over less than two periods is a step, not a motion: no damper is to see it.
        if self.left(now, dt) > 0.0 && self.interval > 2.0 * dt {
            velocity -= self.offset / self.interval;
        }
        (self.shown(now, dt), velocity)
    }

    fn age(&self, now: f64) -> f64 {
        (now - self.since).max(0.0)
    }

    /// Part of the offset that is still to be taken out at the end of this period.
    fn left(&self, now: f64, dt: f64) -> f64 {
        if self.interval > 0.0 { (1.0 - (self.age(now) + dt) / self.interval).max(0.0) } else { 0.0 }
    }

    fn shown(&self, now: f64, dt: f64) -> Vector3<f64> {
        self.told + self.speed * self.age(now).min(self.interval) + self.offset * self.left(now, dt)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shown_proxy_is_continuous_and_arrives() {
        let mut follow = ProxyExtrapolation::default();
        let mut model = LocalModel { tick: 1, period: 0.025, count: 1, ..LocalModel::default() };
        let mut last = None::<f64>;
        let mut now = 0.0;
        for tick in 1..=8u64 {
            model.tick = tick;
            // A proxy that jumps by a centimetre each word, told with no velocity.
            model.contacts[0].proxy = [0.01 * tick as f64, 0.0, 0.0];
            for _ in 0..25 {
                let (p, _) = follow.advance(now, 1e-3, &model, &model.contacts[0].clone());
                if let Some(last) = last {
                    // One centimetre over the 25 periods of a word.
                    assert!((p.x - last).abs() < 0.01 / 25.0 + 1e-12, "{} after {last}", p.x);
                }
                last = Some(p.x);
                now += 1e-3;
            }
        }
        for _ in 0..30 {
            now += 1e-3;
            last = Some(follow.advance(now, 1e-3, &model, &model.contacts[0].clone()).0.x);
        }
        assert!((last.unwrap() - 0.08).abs() < 1e-12, "at rest where it was told to be: {last:?}");
    }
    #[test]
    fn a_word_every_period_is_taken_at_its_word() {
        // A simulation as fast as the loop, or faster: the proxy moves at 0.1 m/s and says so.
        for period in [1e-3, 0.5e-3] {
            let mut follow = ProxyExtrapolation::default();
            let mut model = LocalModel { period, count: 1, ..LocalModel::default() };
            for tick in 1..=100u64 {
                let now = tick as f64 * 1e-3;
                model.tick = tick;
                model.contacts[0].proxy = [0.1 * now, 0.0, 0.0];
                model.contacts[0].velocity = [0.1, 0.0, 0.0];
                let (p, v) = follow.advance(now, 1e-3, &model, &model.contacts[0].clone());
                assert!((p.x - 0.1 * now).abs() < 1e-12 && (v.x - 0.1).abs() < 1e-12, "{p} {v} at {now}");
            }
        }
    }

    #[test]
    fn words_that_come_in_bursts_are_carried_on_from_burst_to_burst() {
        // 120 steps a second, told 30 times a second: a proxy at 0.1 m/s is shown moving evenly, not for 8 ms in every 33.
        let mut follow = ProxyExtrapolation::default();
        let mut model = LocalModel { period: 1.0 / 120.0, count: 1, ..LocalModel::default() };
        let (mut last, mut worst) = (0.0, 0.0f64);
        for k in 0..1000u32 {
            let now = f64::from(k) * 1e-3;
            let burst = (now * 30.0).floor();
            model.tick = 1 + 4 * burst as u64;
            model.contacts[0].proxy = [0.1 * burst / 30.0, 0.0, 0.0];
            model.contacts[0].velocity = [0.1, 0.0, 0.0];
            let (p, _) = follow.advance(now, 1e-3, &model, &model.contacts[0].clone());
            if k > 200 {
                worst = worst.max((p.x - last - 1e-4).abs());
            }
            last = p.x;
        }
        // Words fall on whole milliseconds, 33 or 34 apart: a quarter of a period's motion at most is out of step.
        assert!(worst < 2.5e-5, "{worst} m");
    }
}
