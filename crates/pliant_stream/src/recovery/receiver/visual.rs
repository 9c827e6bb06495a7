//! The visual state of a receiver: what was predicted wrongly fades without a jump.

use nalgebra::Vector3;

use super::Receiver;
use crate::prediction::HandState;
use crate::replica;

/// Rate at which the offset of a reaction fades, per length of the blend.
const REACTION_FADE: f64 = 2.5;

impl Receiver {
    /// If the last visual pose was a prediction and a better pose is known, blends the difference
    /// out.
    pub(super) fn correct_pose(&mut self) {
        self.pose_blend.advance();
        let Some(guess) = self.frame else { return };
        if let Some(known) = self.best_pose().filter(|known| *known != guess) {
            self.pose_blend.add(&guess, &known);
        }
    }

    pub(super) fn remember_before(&mut self) {
        self.before.clone_from(self.policy.confirmed());
    }

    pub(super) fn blend_from_before(&mut self) {
        let now = self.policy.confirmed();
        self.blend.add(
            self.before.q.iter().zip(&now.q).map(|(b, n)| b - n),
            self.before.v.iter().zip(&now.v).map(|(b, n)| b - n),
        );
        if let Some(guard) = &mut self.guard {
            self.visual.clone_from(now);
            self.blend.apply(&mut self.visual.q, &mut self.visual.v);
            guard.corrected(now, &self.visual);
        }
    }

    pub(super) fn show(&mut self) {
        self.visual.clone_from(self.policy.confirmed());
        self.blend.apply(&mut self.visual.q, &mut self.visual.v);
        if self.tick != self.grabs_at {
            self.trail.swap(0, 1);
            std::mem::swap(&mut self.trail[0], &mut self.grabs);
            self.grabs_at = self.tick;
            self.implied.swap(0, 1);
        }
        self.implied[0].clear();
        self.grabs.clear();
        match self.history.known(self.tick) {
            Some(data) => self.grabs.extend(data.grabs.iter().map(|g| g.state)),
            None => {
                if let Some(near) = self.history.last_known(self.tick) {
                    self.grabs.extend(near.grabs.iter().map(|g| g.state));
                }
            }
        }
        self.frame = self.best_pose().or(self.frame);
        self.pose = self.frame.map(|pose| self.pose_blend.apply(&pose));
        if self.policy.driven_by_reactions() {
            let forecast = self.forecast;
            for g in &mut self.grabs {
                if let Some(now) = self.history.grab(g.key, self.tick, &forecast) {
                    *g = now.state;
                } else if let Some(visual) = self.trail[0].iter().find(|p| p.key == g.key) {
                    // The forecast does not reach this far, so the hand keeps the last visual
                    // reaction.
                    g.reaction = visual.reaction;
                }
            }
            self.blend_reactions();
        } else {
            replica::place(&mut self.visual, self.replica.model(), self.pose.as_ref());
            self.replica.reactions(&self.visual, &mut self.grabs);
            // An acceleration contains the mean force over its step. The hand needs the force at
            // its end.
            let hands = self.grabs.len();
            for g in &mut self.grabs {
                let mean = -Vector3::from(g.reaction);
                if let Some(before) = self.implied[1].iter().find(|hand| hand.key == g.key) {
                    g.reaction = (-self.replica.end(mean, before.mean, hands)).into();
                }
                self.implied[0].push(HandState::of_mean(g.key, mean));
            }
        }
    }

    /// Blends out the error of visual reactions that were predictions.
    ///
    /// The offset vanishes as fast as the reaction may change: its second difference stays within
    /// that of the received reactions of late, or the offset fades as a critically damped motion,
    /// `o(t) = 2 k o(t-1) - k^2 o(t-2)`. The reaction then has no jump and no kink that it would
    /// not have without loss, however wrong the prediction was.
    fn blend_reactions(&mut self) {
        let keep = (-REACTION_FADE / f64::from(self.blend_ticks)).exp();
        let [last, before] = &self.trail;
        for g in &mut self.grabs {
            let Some(s1) = last.iter().find(|p| p.key == g.key) else { continue };
            // If a tick has no data at all, its reaction stays a prediction.
            let known = |back: u64| {
                let tick = self.grabs_at.checked_sub(back)?;
                self.history.grab(g.key, tick, &self.forecast).map(|k| Vector3::from(k.state.reaction))
            };
            let now = Vector3::from(g.reaction);
            let s1 = Vector3::from(s1.reaction);
            let k1 = known(1).unwrap_or(now);
            let o1 = s1 - k1;
            let (s2, o2) = before.iter().find(|p| p.key == g.key).map_or((s1, o1), |s2| {
                let s2 = Vector3::from(s2.reaction);
                (s2, s2 - known(2).unwrap_or(k1))
            });
            let offset = 2.0 * keep * o1 - keep * keep * o2;
            if offset.amax() <= 1e-7 * now.amax() {
                continue;
            }
            let usual = self.history.second_difference(g.key, self.grabs_at, self.forecast.window());
            let share = least_share(now - 2.0 * s1 + s2, offset, usual);
            g.reaction = (now + share * offset).into();
        }
    }
}

/// Returns the least share of `offset`, 0 to 1, with which `base + share * offset` is not longer
/// than `limit`. It is 1 if no share is enough.
fn least_share(base: Vector3<f64>, offset: Vector3<f64>, limit: f64) -> f64 {
    let beyond = base.norm_squared() - limit * limit;
    if beyond <= 0.0 {
        return 0.0;
    }
    let (square, along) = (offset.norm_squared(), -base.dot(&offset));
    let root = along * along - square * beyond;
    let share = (along - root.max(0.0).sqrt()) / square;
    if root >= 0.0 && (0.0..1.0).contains(&share) { share } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_share_ends_on_the_limit_or_is_all() {
        let (base, offset) = (Vector3::new(-3.0, 4.0, 0.0), Vector3::new(6.0, -2.0, 1.0));
        assert_eq!(least_share(base, offset, 5.0), 0.0, "nothing is needed");
        for limit in [3.6, 4.0, 4.5, 4.99] {
            let share = least_share(base, offset, limit);
            assert!((0.0..1.0).contains(&share));
            assert!(((base + share * offset).norm() - limit).abs() < 1e-12, "{limit}: {share}");
            assert!((base + 0.9 * share * offset).norm() > limit, "less is not enough");
        }
        assert_eq!(least_share(base, offset, 1.0), 1.0, "no share is enough");
        assert_eq!(least_share(base, -offset, 4.0), 1.0);
    }
}
