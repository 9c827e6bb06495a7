//! Which packets are lost.

use std::sync::Arc;
use std::time::Duration;

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::StreamError;

/// How a link loses packets. Packets are numbered from 0 in the order in which they are sent.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Loss {
    /// Nothing is lost.
    #[default]
    None,
    /// Each packet with this probability, independently.
    Random(f64),
    /// All packets numbered `first .. first + count`.
    Burst {
        /// The first one lost.
        first: u64,
        /// How many.
        count: u64,
    },
    /// Packets `first`, `first + every`, `first + 2 every` and so on: one in `every`.
    Every {
        /// The first one lost.
        first: u64,
        /// The distance to the next.
        every: u64,
    },
    /// Exactly these packets, ascending.
    Listed(Vec<u64>),
    /// Everything sent within these times.
    Outage {
        /// Since the link's time zero.
        from: Duration,
        /// The first moment at which packets pass again.
        to: Duration,
    },
    /// Gilbert and Elliott's two states. The stays in each are exponential in *time*, so that bursts do not get shorter
    /// when packets get rarer.
    GilbertElliott {
        /// Mean stay in the good state.
        good: Duration,
        /// Mean stay in the bad state.
        bad: Duration,
        /// Loss in the good state, 0 to 1.
        loss_good: f64,
        /// Loss in the bad state, 0 to 1.
        loss_bad: f64,
    },
}

/// Packets have lower numbers than this: of a stream of a thousand a second, none is sent for thousands of years.
const LAST: u64 = 1 << 48;

impl Loss {
    /// Gilbert's loss by what a sender of a packet every `interval` sees: mean loss `loss`, mean burst of `burst` packets.
    /// The bad state loses everything and lasts `burst` intervals on average, the good one `burst (1 - loss) / loss`.
    pub fn gilbert(loss: f64, burst: f64, interval: Duration) -> Self {
        let loss = if loss.is_nan() { 0.5 } else { loss.clamp(1e-9, 1.0 - 1e-9) };
        // No number is too large for a time, and none so small that it is none.
        let stay = |seconds: f64| Duration::from_secs_f64(seconds.clamp(1e-6, 1e9));
        let bad = interval.as_secs_f64() * if burst.is_nan() { 1.0 } else { burst.clamp(1e-3, 1e6) };
        let good = bad * (1.0 - loss) / loss;
        Self::GilbertElliott { good: stay(good), bad: stay(bad), loss_good: 0.0, loss_bad: 1.0 }
    }

    /// From words:
    ///
    /// | words | meaning |
    /// | --- | --- |
    /// | `none` | nothing |
    /// | `9%` | each packet with probability 0.09 |
    /// | `random:22@135` | 22 of the 500 packets from number 135 on, drawn from `seed` |
    /// | `burst:12@140` | 12 in a row from number 140 |
    /// | `every:50@135` | one in 50 from number 135 |
    /// | `gilbert:9%:4` | mean loss 9 %, mean burst 4 packets of a sender that sends one every `interval` |
    ///
    /// `@135` may be left out; it is below 2^48.
    ///
    /// # Errors
    /// [`StreamError::Invalid`] with the words.
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
                    // The first steps of a Fisher-Yates shuffle.
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

    /// The same losses with packets counted from `packets` and time from `time` on.
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

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`StreamError::Config`].
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

/// What happened to one packet of a recorded path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceEntry {
    /// Time on the way; `None` for a lost packet.
    pub delay: Option<Duration>,
}

/// A recorded path, played packet by packet and then from the start again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trace {
    entries: Arc<[TraceEntry]>,
}

impl Trace {
    /// From entries; at least one.
    ///
    /// # Errors
    /// [`StreamError::Config`] for none.
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

    /// From text: one packet a line, its delay in milliseconds or the word `lost`; `#` begins a comment.
    ///
    /// # Errors
    /// [`StreamError::Invalid`], naming the line.
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
