//! Emulation of one direction of a network path.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{Loss, PathTrace};
use crate::StreamError;

/// Most packets in flight. Further packets are dropped as lost.
const IN_FLIGHT: usize = 1 << 16;

/// Settings of one direction of a path. Default: perfect and immediate.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkConfig {
    /// One-way delay. Default: 0.
    pub delay: Duration,
    /// Mean of an additional exponential delay. The additional delay is at most eight times the
    /// mean. Default: 0.
    pub jitter: Duration,
    /// Keep packets in order despite jitter. Default: false.
    pub keep_order: bool,
    /// Loss model. Default: no loss.
    pub loss: Loss,
    /// Share of packets that are delayed by `reorder_by`. Default: 0.
    pub reorder: f64,
    /// Additional delay of reordered packets. Default: 10 ms.
    pub reorder_by: Duration,
    /// Share of packets that arrive twice, the copy within `reorder_by`. Default: 0.
    pub duplicate: f64,
    /// Bandwidth, bit/s. `None` means unlimited. Default: `None`.
    pub bits_per_second: Option<f64>,
    /// Bytes that may wait in the send queue. A packet that does not fit is dropped. Default: 64
    /// KiB.
    pub queue_bytes: usize,
    /// Header bytes that each packet adds to its payload: 28 for IPv4 and UDP. Default: 28.
    pub overhead_bytes: usize,
    /// A recorded path that replaces `delay`, `jitter` and `loss`. Default: `None`.
    pub trace: Option<PathTrace>,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            delay: Duration::ZERO,
            jitter: Duration::ZERO,
            keep_order: false,
            loss: Loss::None,
            reorder: 0.0,
            reorder_by: Duration::from_millis(10),
            duplicate: 0.0,
            bits_per_second: None,
            queue_bytes: 64 * 1024,
            overhead_bytes: 28,
            trace: None,
        }
    }
}

impl LinkConfig {
    /// Checks that all values are in range.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a value out of range.
    pub fn check(&self) -> Result<(), StreamError> {
        self.loss.check()?;
        for (what, p) in [("reorder", self.reorder), ("duplicate", self.duplicate)] {
            if !(0.0..=1.0).contains(&p) {
                return Err(StreamError::Config { what, found: p.to_string(), expected: "0..=1" });
            }
        }
        if let Some(rate) = self.bits_per_second
            && !(1.0..=1e15).contains(&rate)
        {
            let found = rate.to_string();
            return Err(StreamError::Config { what: "bits_per_second", found, expected: "1 to 1e15" });
        }
        Ok(())
    }
}

/// Packet counts of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkCounts {
    /// Packets sent.
    pub sent: u64,
    /// Packets lost by the loss model, by the trace or because too many were in flight.
    pub lost: u64,
    /// Packets dropped because the send queue was full.
    pub overflowed: u64,
    /// Packets delivered, copies included.
    pub delivered: u64,
    /// Copies made.
    pub duplicated: u64,
    /// Payload bytes sent, without headers.
    pub bytes: u64,
}

struct Flying<T> {
    at: Duration,
    order: u64,
    payload: T,
}

impl<T> PartialEq for Flying<T> {
    fn eq(&self, other: &Self) -> bool {
        (self.at, self.order) == (other.at, other.order)
    }
}
impl<T> Eq for Flying<T> {}
impl<T> PartialOrd for Flying<T> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl<T> Ord for Flying<T> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.at, self.order).cmp(&(other.at, other.order))
    }
}

/// One direction of a path. It carries payloads of any type.
pub struct EmulatedLink<T = Vec<u8>> {
    config: LinkConfig,
    rng: Pcg64Mcg,
    flying: BinaryHeap<Reverse<Flying<T>>>,
    packet: u64,
    order: u64,
    free_at: Duration,
    last_arrival: Duration,
    bad: bool,
    state_until: Duration,
    counts: LinkCounts,
    hash: u64,
}

impl<T> std::fmt::Debug for EmulatedLink<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("EmulatedLink")
            .field("counts", &self.counts)
            .field("in_flight", &self.flying.len())
            .finish_non_exhaustive()
    }
}

impl<T: Clone> EmulatedLink<T> {
    /// Creates a link at time zero. Settings out of range are clamped or reset, and
    /// [`LinkConfig::check`] reports them.
    pub fn new(mut config: LinkConfig, seed: u64) -> Self {
        let share = |p: &mut f64| *p = if p.is_finite() { p.clamp(0.0, 1.0) } else { 0.0 };
        share(&mut config.reorder);
        share(&mut config.duplicate);
        if config.bits_per_second.is_some_and(|r| r.is_nan() || r < 1.0) {
            config.bits_per_second = Some(1.0);
        }
        if config.loss.check().is_err() {
            config.loss = Loss::None;
        }
        Self {
            config,
            rng: Pcg64Mcg::seed_from_u64(seed),
            flying: BinaryHeap::new(),
            packet: 0,
            order: 0,
            free_at: Duration::ZERO,
            last_arrival: Duration::ZERO,
            bad: false,
            state_until: Duration::ZERO,
            counts: LinkCounts::default(),
            hash: 0xCBF2_9CE4_8422_2325,
        }
    }

    /// The settings.
    pub fn config(&self) -> &LinkConfig {
        &self.config
    }

    /// Changes the settings for packets sent from here on. Packets in flight keep their arrival
    /// times.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a value out of range. The old settings then stay.
    pub fn reconfigure(&mut self, config: LinkConfig) -> Result<(), StreamError> {
        config.check()?;
        self.config = config;
        Ok(())
    }

    /// Sends a payload of `bytes` bytes at time `now`. Times must not decrease.
    pub fn send(&mut self, now: Duration, payload: T, bytes: usize) {
        let packet = self.packet;
        self.packet += 1;
        self.counts.sent += 1;
        self.counts.bytes += bytes as u64;
        // Bandwidth comes before loss: a packet that is lost on the path has still used bandwidth.
        let on_line = match self.config.bits_per_second {
            None => now,
            Some(rate) => {
                let start = self.free_at.max(now);
                let waiting = (start - now).as_secs_f64() * rate / 8.0;
                if waiting + bytes as f64 > self.config.queue_bytes as f64 {
                    self.counts.overflowed += 1;
                    self.note(packet, 2, Duration::ZERO);
                    return;
                }
                let bits = 8.0 * (bytes + self.config.overhead_bytes) as f64;
                self.free_at = start + whole_micros(bits / rate);
                self.free_at
            }
        };
        // Every packet draws the same count of random numbers, so that a change of one setting does
        // not shift the random numbers of the others.
        let [lost, jitter, held, double, copy] = std::array::from_fn(|_| self.unit());
        let recorded = self.config.trace.as_ref().map(|t| t.entry(packet));
        let is_lost = match recorded {
            Some(entry) => entry.delay.is_none(),
            None => self.loses(packet, now, lost),
        };
        if is_lost || self.flying.len() >= IN_FLIGHT {
            self.counts.lost += 1;
            self.note(packet, 1, Duration::ZERO);
            return;
        }
        let way = match recorded.and_then(|e| e.delay) {
            Some(delay) => delay,
            None => {
                let jitter = self.config.jitter.as_secs_f64() * (-(1.0 - jitter).ln()).min(8.0);
                self.config.delay + whole_micros(jitter)
            }
        };
        let mut at = on_line + way;
        if held < self.config.reorder {
            at += self.config.reorder_by;
        } else if self.config.keep_order {
            at = at.max(self.last_arrival);
            self.last_arrival = at;
        }
        if double < self.config.duplicate {
            let later = at + whole_micros(copy * self.config.reorder_by.as_secs_f64());
            self.counts.duplicated += 1;
            self.fly(later, payload.clone());
        }
        self.note(packet, 0, at);
        self.fly(at, payload);
    }

    fn fly(&mut self, at: Duration, payload: T) {
        self.order += 1;
        self.flying.push(Reverse(Flying { at, order: self.order, payload }));
    }

    fn loses(&mut self, packet: u64, now: Duration, draw: f64) -> bool {
        match &self.config.loss {
            Loss::None => false,
            Loss::Random(p) => draw < *p,
            Loss::Burst { first, count } => packet >= *first && packet - first < *count,
            Loss::Every { first, every } => {
                packet >= *first && (packet - first).is_multiple_of((*every).max(1))
            }
            Loss::Listed(list) => list.binary_search(&packet).is_ok(),
            Loss::Outage { from, to } => (*from..*to).contains(&now),
            Loss::GilbertElliott { good, bad, loss_good, loss_bad } => {
                let (good, bad, loss_good, loss_bad) = (*good, *bad, *loss_good, *loss_bad);
                if self.state_until.is_zero() {
                    // The first state is bad with the long-run probability of the bad state.
                    let share = bad.as_secs_f64() / (good + bad).as_secs_f64().max(1e-12);
                    self.bad = self.unit() < share;
                    self.state_until = self.stay(if self.bad { bad } else { good });
                }
                while now >= self.state_until {
                    self.bad = !self.bad;
                    let stay = self.stay(if self.bad { bad } else { good });
                    self.state_until += stay;
                }
                draw < if self.bad { loss_bad } else { loss_good }
            }
        }
    }

    fn stay(&mut self, mean: Duration) -> Duration {
        let drawn = -(1.0 - self.unit()).ln() * mean.as_secs_f64();
        whole_micros(drawn).max(Duration::from_micros(1))
    }

    /// Uniform random number in [0, 1) with 53 bits.
    fn unit(&mut self) -> f64 {
        (self.rng.next_u64() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
    }

    fn note(&mut self, packet: u64, fate: u8, at: Duration) {
        // FNV-1a hash over all decisions.
        let mut add = |bytes: &[u8]| {
            for b in bytes {
                self.hash = (self.hash ^ u64::from(*b)).wrapping_mul(0x0000_0100_0000_01B3);
            }
        };
        add(&packet.to_le_bytes());
        add(&[fate]);
        add(&(at.as_micros() as u64).to_le_bytes());
    }

    /// Returns the next payload that has arrived by `now`.
    pub fn poll(&mut self, now: Duration) -> Option<T> {
        if self.flying.peek().is_none_or(|f| f.0.at > now) {
            return None;
        }
        self.counts.delivered += 1;
        self.flying.pop().map(|f| f.0.payload)
    }

    /// Returns the time at which the next payload arrives.
    pub fn next_wakeup(&self) -> Option<Duration> {
        self.flying.peek().map(|f| f.0.at)
    }

    /// The packet counts.
    pub fn counts(&self) -> LinkCounts {
        self.counts
    }

    /// A hash of all decisions so far. The same calls with the same seed give the same hash.
    pub fn hash(&self) -> u64 {
        self.hash
    }
}

fn whole_micros(seconds: f64) -> Duration {
    Duration::from_micros((seconds * 1e6).round().clamp(0.0, 1e15) as u64)
}
