//! Attempts to connect again, of a guest to its host and of a peer to another one.

use std::time::Duration;

use crate::transport::Fingerprint;

/// The first attempt follows after about `FIRST_PAUSE`. The pause doubles with each attempt, up to
/// this length, and is half to one and a half times as long as that.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
const FIRST_PAUSE: Duration = Duration::from_millis(100);

/// When to connect again to an end whose connection was lost.
#[derive(Debug, Clone, Default)]
pub(crate) struct Retry {
    /// Time at which the connection was lost.
    since: Option<Duration>,
    /// Time of the next attempt. `None` while an attempt is under way or none is needed.
    next: Option<Duration>,
    /// Number of attempts since the connection was lost.
    attempts: u32,
}

impl Retry {
    /// Sets the time of the next attempt after a loss or a failed attempt, unless it is set.
    /// Returns false when the end has been lost for longer than `patience`, and is given up.
    pub(crate) fn schedule(&mut self, now: Duration, patience: Duration, key: Fingerprint) -> bool {
        self.since.get_or_insert(now);
        if self.is_over(now, patience) {
            return false;
        }
        if self.next.is_none() {
            let pause = FIRST_PAUSE.saturating_mul(1 << self.attempts.min(16)).min(LONGEST_PAUSE);
            self.attempts += 1;
            self.next = Some(now + retry_pause(pause, key, self.attempts));
        }
        true
    }

    /// Returns whether an attempt is due. The caller makes it at once.
    pub(crate) fn is_due(&mut self, now: Duration) -> bool {
        self.next.take_if(|due| now >= *due).is_some()
    }

    /// Returns whether the end has been lost for longer than `patience`.
    pub(crate) fn is_over(&self, now: Duration, patience: Duration) -> bool {
        self.since.is_some_and(|since| now.saturating_sub(since) >= patience)
    }
}

/// Returns a pause of half to one and a half times `pause`. It depends on the key and the number of
/// the attempt, so that those who have lost one host at the same moment do not come back at one.
fn retry_pause(pause: Duration, key: Fingerprint, attempt: u32) -> Duration {
    let bytes = key.0.into_iter().chain(attempt.to_le_bytes());
    // FNV-1a. Its high bits are those that are mixed best.
    let hash = bytes
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3));
    pause.mul_f64(0.5 + (hash >> 32) as f64 / f64::from(u32::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_differ_by_key_and_attempt() {
        let second = Duration::from_secs(1);
        let pauses = |attempt| -> Vec<Duration> {
            let mut all: Vec<_> =
                (0..=255).map(|k| retry_pause(second, Fingerprint([k; 32]), attempt)).collect();
            all.sort();
            all
        };
        for attempt in 1..20 {
            let all = pauses(attempt);
            assert!(all[0] >= second / 2 && all[255] <= second * 3 / 2, "{all:?}");
            // No twentieth of the time has more than three times its share.
            for k in 0..20 {
                let from = second / 2 + k * second / 20;
                let count = all.iter().filter(|p| (from..from + second / 20).contains(*p)).count();
                assert!(count < 3 * 256 / 20, "{count} at {from:?}");
            }
        }
        let key = Fingerprint([7; 32]);
        // The pauses double up to the longest, and each attempt is due once.
        let (mut retry, mut now) = (Retry::default(), Duration::ZERO);
        let patience = 60 * second;
        for most in [100, 200, 400, 800, 1600, 2000, 2000u64].map(Duration::from_millis) {
            assert!(retry.schedule(now, patience, key));
            assert!(!retry.is_due(now + most / 2 - Duration::from_millis(1)));
            assert!(retry.is_due(now + most * 3 / 2));
            assert!(!retry.is_due(now + most * 3 / 2));
            now += most * 3 / 2;
        }
        assert!(!retry.schedule(patience, patience, key));
        assert_ne!(retry_pause(second, key, 1), retry_pause(second, key, 2));
        assert_eq!(retry_pause(second, key, 1), retry_pause(second, key, 1));
    }
}
