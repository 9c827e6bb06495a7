//! Congestion control with a cap on the bit rate, instead of a window that estimates the link.
//!
//! Loss on a wireless link is no sign of a queue. At 9 % loss and a round trip of 196 ms, Cubic's
//! window holds about 200 kbit/s, whatever the link could carry. Here the window follows from the
//! cap and the round trip, and isolated loss changes nothing. A growing round trip is the sign of a
//! queue ([`PeerStats::queueing`](super::PeerStats::queueing)), in which case the application sends
//! fewer modes.

use std::any::Any;
use std::sync::Arc;
use std::time::Duration;

use bevy::platform::time::Instant;
use quinn::congestion::{Controller, ControllerFactory};
use quinn_proto::RttEstimator;

/// The largest rate to one peer, bytes per second. Never below 1,200 bytes per second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RateCap(u64);

impl RateCap {
    /// Creates a cap in megabits per second. NaN, zero and negative rates become the smallest cap.
    pub fn from_mbit_per_s(rate: f64) -> Self {
        // A float-to-integer cast saturates and takes NaN to zero.
        Self(((rate * 125_000.0) as u64).max(SMALLEST))
    }

    /// Returns the cap in bytes per second.
    pub fn bytes_per_s(self) -> u64 {
        self.0
    }
}

const SMALLEST: u64 = 1200;

/// Congestion controller with a window of max(8 packets, 2 x cap x smoothed round trip), and of 8
/// packets while nothing at all gets through.
#[derive(Clone, Debug)]
pub(super) struct RateController {
    cap: RateCap,
    mtu: u64,
    round_trip: Duration,
    stalled: bool,
}

impl RateController {
    pub(super) fn new(cap: RateCap) -> Self {
        Self { cap, mtu: 1200, round_trip: Duration::from_millis(200), stalled: false }
    }

    fn smallest(&self) -> u64 {
        8 * self.mtu
    }
}

impl Controller for RateController {
    fn on_ack(&mut self, _now: Instant, _sent: Instant, _bytes: u64, _app_limited: bool, rtt: &RttEstimator) {
        self.round_trip = rtt.get();
        self.stalled = false;
    }

    fn on_congestion_event(&mut self, _now: Instant, _sent: Instant, persistent: bool, _lost_bytes: u64) {
        // If all packets of several round trips are lost, the link is down, not lossy. The sender
        // then probes it gently until an acknowledgment arrives.
        self.stalled |= persistent;
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.mtu = u64::from(new_mtu);
    }

    fn window(&self) -> u64 {
        if self.stalled {
            return self.smallest();
        }
        let in_flight = 2.0 * self.cap.0 as f64 * self.round_trip.as_secs_f64();
        (in_flight as u64).max(self.smallest())
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(self.clone())
    }

    fn initial_window(&self) -> u64 {
        self.window()
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

impl ControllerFactory for RateController {
    fn build(self: Arc<Self>, _now: Instant, current_mtu: u16) -> Box<dyn Controller> {
        Box::new(Self { mtu: u64::from(current_mtu), ..(*self).clone() })
    }
}

/// A token bucket for both kinds of traffic. Datagrams may take all of it and go into debt by one
/// datagram. Messages must leave half of it, so that a model transfer does not delay a frame.
#[derive(Debug)]
pub(super) struct Bucket {
    rate: f64,
    burst: f64,
    level: f64,
    filled: Instant,
}

/// Bytes that UDP, IP and QUIC add to a payload.
const OVERHEAD: f64 = 60.0;
/// Capacity of the bucket in seconds of the cap, and at least `SMALLEST_BURST` bytes.
const BURST_SECONDS: f64 = 0.05;
const SMALLEST_BURST: f64 = 4096.0;

impl Bucket {
    pub(super) fn new(cap: RateCap, now: Instant) -> Self {
        let rate = cap.0 as f64;
        let burst = (rate * BURST_SECONDS).max(SMALLEST_BURST);
        Self { rate, burst, level: burst, filled: now }
    }

    /// Takes `bytes` for a datagram, or returns how long to wait.
    pub(super) fn take_datagram(&mut self, bytes: usize, now: Instant) -> Result<(), Duration> {
        self.take(bytes, 0.0, now)
    }

    /// Takes `bytes` for a part of a message, or returns how long to wait.
    pub(super) fn take_message(&mut self, bytes: usize, now: Instant) -> Result<(), Duration> {
        self.take(bytes, self.burst / 2.0, now)
    }

    fn take(&mut self, bytes: usize, reserve: f64, now: Instant) -> Result<(), Duration> {
        let passed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.level = (self.level + passed * self.rate).min(self.burst);
        self.filled = self.filled.max(now);
        if self.level > reserve {
            self.level -= bytes as f64 + OVERHEAD;
            return Ok(());
        }
        // The wait is long enough to rise above the reserve, and at least a millisecond, because
        // the timer is no finer.
        Err(Duration::from_secs_f64(((reserve - self.level) / self.rate).clamp(0.001, 1.0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_holds_two_round_trips_of_the_cap_and_ignores_isolated_loss() {
        let now = Instant::now();
        let mut controller = RateController::new(RateCap::from_mbit_per_s(2.0));
        controller.round_trip = Duration::from_millis(196);
        // The window is 2 x 250,000 B/s x 0.196 s.
        assert_eq!(controller.window(), 98_000);
        for _ in 0..1000 {
            controller.on_congestion_event(now, now, false, 1200);
        }
        assert_eq!(controller.window(), 98_000);
        controller.on_congestion_event(now, now, true, 1200);
        assert_eq!(controller.window(), 8 * 1200);
        controller.stalled = false;
        controller.round_trip = Duration::from_micros(100);
        assert_eq!(controller.window(), 8 * 1200, "never below eight packets");
    }

    #[test]
    fn caps_are_positive_whatever_is_asked() {
        for rate in [0.0, -1.0, f64::NAN, f64::NEG_INFINITY] {
            assert_eq!(RateCap::from_mbit_per_s(rate).bytes_per_s(), SMALLEST);
        }
        assert_eq!(RateCap::from_mbit_per_s(2.0).bytes_per_s(), 250_000);
    }

    #[test]
    fn messages_leave_room_for_datagrams_and_both_stay_below_the_cap() {
        let start = Instant::now();
        let mut bucket = Bucket::new(RateCap::from_mbit_per_s(2.0), start);
        let (mut sent, mut late) = (0.0, 0);
        // Ten seconds in steps of a millisecond, with messages whenever the bucket allows them, and
        // a datagram of 300 bytes every 25 ms.
        for ms in 0..10_000u64 {
            let now = start + Duration::from_millis(ms);
            while bucket.take_message(1000, now).is_ok() {
                sent += 1000.0 + OVERHEAD;
            }
            if ms % 25 == 0 {
                match bucket.take_datagram(300, now) {
                    Ok(()) => sent += 300.0 + OVERHEAD,
                    Err(_) => late += 1,
                }
            }
        }
        assert_eq!(late, 0, "a datagram had to wait behind messages");
        let rate = sent / 10.0;
        assert!((0.98..1.02).contains(&(rate / 250_000.0)), "{rate} bytes a second against a cap of 250,000");
    }
}
