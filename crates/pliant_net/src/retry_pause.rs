//! Pauses between attempts to connect.

use std::time::Duration;

use crate::transport::Fingerprint;

/// Returns a pause of half to one and a half times `pause`. It depends on the key and the number of
/// the attempt, so that those who have lost one host at the same moment do not come back at one.
pub(crate) fn retry_pause(pause: Duration, key: Fingerprint, attempt: u32) -> Duration {
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
        assert_ne!(retry_pause(second, key, 1), retry_pause(second, key, 2));
        assert_eq!(retry_pause(second, key, 1), retry_pause(second, key, 1));
    }
}
