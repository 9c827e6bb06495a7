//! Smoothed round-trip time.

use std::time::Duration;

/// Smoothed round trip (RFC 6298: gains 1/8 and 1/4).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RoundTrip {
    smooth: f64,
    deviation: f64,
    known: bool,
}

impl RoundTrip {
    pub(crate) fn sample(&mut self, rtt: Duration) {
        let x = rtt.as_secs_f64();
        if self.known {
            self.deviation += 0.25 * ((x - self.smooth).abs() - self.deviation);
            self.smooth += 0.125 * (x - self.smooth);
        } else {
            (self.smooth, self.deviation, self.known) = (x, 0.5 * x, true);
        }
    }

    /// Smoothed round trip and its smoothed deviation; `None` before the first sample.
    pub(crate) fn known(&self) -> Option<[Duration; 2]> {
        let seconds = |x: f64| Duration::from_secs_f64(x.clamp(0.0, 3600.0));
        self.known.then(|| [seconds(self.smooth), seconds(self.deviation)])
    }
}
