//! Loss models: which packets are lost.

use std::sync::Arc;
use std::time::Duration;

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::StreamError;

/// How a link loses packets. Packets are numbered from 0 in the order in which they are sent.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Loss {
    /// No packet is lost.
    #[default]
    None,
    /// Each packet is lost with this probability, independently.
    Random(f64),
    /// All packets numbered `first .. first + count` are lost.
    Burst {
        /// Number of the first lost packet.
        first: u64,
        /// Number of lost packets.
        count: u64,
    },
    /// Packets `first`, `first + every`, `first + 2 every` and so on are lost: one in `every`.
    Every {
        /// Number of the first lost packet.
        first: u64,
        /// Distance from one lost packet to the next.
        every: u64,
    },
    /// Exactly these packets are lost. The numbers ascend.
    Listed(Vec<u64>),
    /// All packets sent between two times are lost.
    Outage {
        /// Start of the outage, measured from the link's time zero.
        from: Duration,
        /// End of the outage, the first time at which packets pass again.
        to: Duration,
    },
    /// The two-state model of Gilbert and Elliott. The time spent in each state is exponentially
    /// distributed in *time*, so that bursts do not get shorter when packets get rarer.
    GilbertElliott {
        /// Mean time in the good state.
        good: Duration,
        /// Mean time in the bad state.
        bad: Duration,
        /// Loss probability in the good state, 0 to 1.
        loss_good: f64,
        /// Loss probability in the bad state, 0 to 1.
        loss_bad: f64,
    },
}

/// Upper limit of packet numbers. A stream of a thousand packets per second takes thousands of
/// years to reach it.
const LAST: u64 = 1 << 48;

impl Loss {
    /// Gilbert's model from the statistics of a sender that sends one packet every `interval`: mean
    /// loss `loss` and mean burst of `burst` packets. The bad state loses everything and lasts
    /// `burst` intervals on average. The good state lasts `burst (1 - loss) / loss` intervals.
    pub fn gilbert(loss: f64, burst: f64, interval: Duration) -> Self {
        let loss = if loss.is_nan() { 0.5 } else { loss.clamp(1e-9, 1.0 - 1e-9) };
        // The clamp keeps every duration representable and above zero.
        let stay = |seconds: f64| Duration::from_secs_f64(seconds.clamp(1e-6, 1e9));
        let bad = interval.as_secs_f64() * if burst.is_nan() { 1.0 } else { burst.clamp(1e-3, 1e6) };
        let good = bad * (1.0 - loss) / loss;
        Self::GilbertElliott { good: stay(good), bad: stay(bad), loss_good: 0.0, loss_bad: 1.0 }
    }

    /// Parses a loss model:
    ///
    /// | text | meaning |
    /// | --- | --- |
    /// | `none` | no loss |
    /// | `9%` | each packet is lost with probability 0.09 |
    /// | `random:22@135` | 22 of the 500 packets from number 135 on, drawn from `seed` |
    /// | `burst:12@140` | 12 in a row from number 140 |
    /// | `every:50@135` | one in 50 from number 135 |
    /// | `gilbert:9%:4` | mean loss 9 %, mean burst 4 packets of a sender with one packet per `interval` |
    ///
    /// `@135` may be left out. The packet number must be below 2^48.
    ///
    /// # Errors
    /// Returns [`StreamError::Invalid`] with the text if the text is not a loss model.
    pub fn parse(words: &str, seed: u64, interval: Duration) -> Result<Self, StreamError> {
        let invalid = || StreamError::Invalid {
            what: "loss",
            found: words.to_owned(),
            expected: "none, 9%, random:22@135, burst:12@140, every:50@135 or gilbert:9%:4",
        };
        let share = |text: &str| -> Option<f64> {
            let percent: f64 = text.strip_suffix('%')?.trim().parse().ok()?;
            (0.0..=100.0).contains(&percent).then_some(percent / 100.0)
        };
        let counted = |text: &str| -> Option<(u64, u64)> {
            let (count, first) = text.split_once('@').unwrap_or((text, "135"));
            let first = first.parse().ok().filter(|first| *first < LAST)?;
            Some((count.parse().ok().filter(|c| (1..=1_000_000).contains(c))?, first))
        };
        let words = words.trim();
        let made = match words.split_once(':') {
            None if words == "none" => Some(Self::None),
            None => share(words).map(Self::Random),
            Some(("random", rest)) => {
                counted(rest).filter(|(count, _)| *count <= 500).map(|(count, first)| {
                    let mut rng = Pcg64Mcg::seed_from_u64(seed);
                    let mut all: Vec<u64> = (first..first + 500).collect();
                    // This performs the first steps of a Fisher-Yates shuffle.
                    for k in 0..count as usize {
                        let other = k + (rng.next_u64() % (all.len() - k) as u64) as usize;
                        all.swap(k, other);
                    }
                    all.truncate(count as usize);
                    all.sort_unstable();
                    Self::Listed(all)
                })
            }
            Some(("burst", rest)) => counted(rest).map(|(count, first)| Self::Burst { first, count }),
            Some(("every", rest)) => counted(rest).map(|(every, first)| Self::Every { first, every }),
            Some(("gilbert", rest)) => rest.split_once(':').and_then(|(loss, burst)| {
                let burst: f64 = burst.parse().ok().filter(|b| (1.0..=1e6).contains(b))?;
                share(loss).map(|loss| Self::gilbert(loss, burst, interval))
            }),
            Some(_) => None,
        };
        made.ok_or_else(invalid)
    }

    /// The same loss model with packet numbers shifted by `packets` and times shifted by `time`.
    #[must_use]
    pub fn shifted(&self, packets: u64, time: Duration) -> Self {
        match self.clone() {
            Self::Burst { first, count } => Self::Burst { first: first.saturating_add(packets), count },
            Self::Every { first, every } => Self::Every { first: first.saturating_add(packets), every },
            Self::Listed(list) => Self::Listed(list.into_iter().map(|k| k.saturating_add(packets)).collect()),
            Self::Outage { from, to } => {
                Self::Outage { from: from.saturating_add(time), to: to.saturating_add(time) }
            }
            other @ (Self::None | Self::Random(_) | Self::GilbertElliott { .. }) => other,
        }
    }

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a value out of range.
    pub fn check(&self) -> Result<(), StreamError> {
        let share = |what, p: f64| {
            if (0.0..=1.0).contains(&p) {
                Ok(())
            } else {
                Err(StreamError::Config { what, found: p.to_string(), expected: "0..=1" })
            }
        };
        match self {
            Self::Random(p) => share("loss", *p),
            Self::GilbertElliott { good, bad, loss_good, loss_bad } => {
                share("loss_good", *loss_good)?;
                share("loss_bad", *loss_bad)?;
                let least = Duration::from_micros(1);
                if *good < least || *bad < least {
                    let found = format!("{good:?}, {bad:?}");
                    return Err(StreamError::Config { what: "mean stays", found, expected: "1 us or more" });
                }
                Ok(())
            }
            Self::Every { every: 0, .. } => {
                Err(StreamError::Config { what: "every", found: "0".into(), expected: "1 or more" })
            }
            Self::None | Self::Burst { .. } | Self::Every { .. } | Self::Listed(_) | Self::Outage { .. } => {
                Ok(())
            }
        }
    }
}

/// The outcome for one packet of a recorded path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceEntry {
    /// One-way delay. `None` for a lost packet.
    pub delay: Option<Duration>,
}

/// A recorded path. It is replayed packet by packet and repeats from the start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PathTrace {
    entries: Arc<[TraceEntry]>,
}

impl PathTrace {
    /// Creates a trace from at least one entry.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] if `entries` is empty.
    pub fn new(entries: Vec<TraceEntry>) -> Result<Self, StreamError> {
        if entries.is_empty() {
            return Err(StreamError::Config {
                what: "trace",
                found: "empty".into(),
                expected: "one packet or more",
            });
        }
        Ok(Self { entries: entries.into() })
    }

    /// Parses a trace with one packet per line: its delay in milliseconds (0 to 60,000) or the word
    /// `lost`. `#` begins a comment.
    ///
    /// # Errors
    /// Returns [`StreamError::Invalid`] with the line number for a line that is neither, and
    /// [`StreamError::Config`] if the text has no packets.
    pub fn parse(text: &str) -> Result<Self, StreamError> {
        let mut entries = Vec::new();
        for (number, line) in text.lines().enumerate() {
            let line = line.split('#').next().unwrap_or("").trim();
            if line.is_empty() {
                continue;
            }
            let delay = if line == "lost" {
                None
            } else {
                let ms: Option<f64> = line.parse().ok().filter(|x: &f64| (0.0..=60_000.0).contains(x));
                let Some(ms) = ms else {
                    let found = format!("line {}: {line:?}", number + 1);
                    let expected = "milliseconds (0 to 60,000) or `lost`";
                    return Err(StreamError::Invalid { what: "trace", found, expected });
                };
                Some(Duration::from_secs_f64(ms * 1e-3))
            };
            entries.push(TraceEntry { delay });
        }
        Self::new(entries)
    }

    pub(crate) fn entry(&self, packet: u64) -> TraceEntry {
        self.entries[(packet % self.entries.len() as u64) as usize]
    }
}
