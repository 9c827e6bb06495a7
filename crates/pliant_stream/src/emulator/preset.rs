//! Named networks.

use std::time::Duration;

use super::{LinkConfig, Loss};

/// A network by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Preset {
    /// The paper's network 1: 9 % loss, 2 Mb/s, 196 ms round trip.
    Paper1,
    /// The paper's network 2: 6 % loss, 4 Mb/s, 120 ms (the paper gives the round trip only in a figure).
    Paper2,
    /// The paper's network 3: 3 % loss, 10 Mb/s, 60 ms (as above).
    Paper3,
    /// The paper's network 4: no loss, 100 Mb/s, 20 ms (as above).
    Paper4,
    /// A wired local network: 0.4 ms, 1 Gb/s.
    Lan,
    /// A busy wireless one: 6 ms and 3 ms of jitter in order, bursts of 20 ms, 1 % loss in all, 50 Mb/s.
    Wifi,
    /// Across an ocean: 80 ms, 1 ms of jitter, 0.1 % loss, 100 Mb/s.
    Transatlantic,
    /// Geostationary: 600 ms, 5 ms of jitter, 1 % loss in bursts of 50 ms, 10 Mb/s.
    Satellite,
}

impl Preset {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::Paper1,
        Self::Paper2,
        Self::Paper3,
        Self::Paper4,
        Self::Lan,
        Self::Wifi,
        Self::Transatlantic,
        Self::Satellite,
    ];

    /// `paper-1` to `paper-4`, `lan`, `wifi`, `transatlantic`, `satellite`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper1 => "paper-1",
            Self::Paper2 => "paper-2",
            Self::Paper3 => "paper-3",
            Self::Paper4 => "paper-4",
            Self::Lan => "lan",
            Self::Wifi => "wifi",
            Self::Transatlantic => "transatlantic",
            Self::Satellite => "satellite",
        }
    }

    /// The network of a name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|p| p.name() == name)
    }

    /// Round trip without queueing and jitter.
    pub fn round_trip(self) -> Duration {
        2 * LinkConfig::preset(self).delay
    }
}

impl LinkConfig {
    /// One direction of a named network; both directions are alike.
    pub fn preset(preset: Preset) -> Self {
        let us = Duration::from_micros;
        let plain = |loss: f64, mbit: f64, round_trip_us: u64| Self {
            delay: us(round_trip_us / 2),
            loss: if loss > 0.0 { Loss::Random(loss) } else { Loss::None },
            bits_per_second: Some(mbit * 1e6),
            ..Self::default()
        };
        let bursts = |loss: f64, bad: Duration| Loss::GilbertElliott {
            good: bad.mul_f64((1.0 - loss) / loss),
            bad,
            loss_good: 0.0,
            loss_bad: 1.0,
        };
        match preset {
            Preset::Paper1 => plain(0.09, 2.0, 196_000),
            Preset::Paper2 => plain(0.06, 4.0, 120_000),
            Preset::Paper3 => plain(0.03, 10.0, 60_000),
            Preset::Paper4 => plain(0.0, 100.0, 20_000),
            Preset::Lan => Self { jitter: us(30), ..plain(0.0, 1000.0, 400) },
            Preset::Wifi => Self {
                jitter: us(3_000),
                keep_order: true,
                loss: bursts(0.01, us(20_000)),
                ..plain(0.0, 50.0, 6_000)
            },
            Preset::Transatlantic => Self { jitter: us(1_000), ..plain(0.001, 100.0, 80_000) },
            Preset::Satellite => {
                Self { jitter: us(5_000), loss: bursts(0.01, us(50_000)), ..plain(0.0, 10.0, 600_000) }
            }
        }
    }
}
