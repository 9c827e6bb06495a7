//! Network presets.

use std::time::Duration;

use super::{LinkConfig, Loss};

/// A network preset with a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Preset {
    /// The paper's network 1: 9 % loss, 2 Mb/s, 196 ms round trip.
    Paper1,
    /// The paper's network 2: 6 % loss, 4 Mb/s, 120 ms round trip. The paper gives the round trip
    /// only in a figure.
    Paper2,
    /// The paper's network 3: 3 % loss, 10 Mb/s, 60 ms round trip. The paper gives the round trip
    /// only in a figure.
    Paper3,
    /// The paper's network 4: no loss, 100 Mb/s, 20 ms round trip. The paper gives the round trip
    /// only in a figure.
    Paper4,
    /// A wired local network: 0.4 ms round trip, 30 us of jitter, 1 Gb/s.
    Lan,
    /// A busy wireless network: 6 ms round trip, 3 ms of jitter in order, 1 % loss in bursts of 20
    /// ms, 50 Mb/s.
    Wifi,
    /// A transatlantic path: 80 ms round trip, 1 ms of jitter, 0.1 % loss, 100 Mb/s.
    Transatlantic,
    /// A geostationary satellite: 600 ms round trip, 5 ms of jitter, 1 % loss in bursts of 50 ms,
    /// 10 Mb/s.
    Satellite,
}

impl Preset {
    /// All presets.
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

    /// The name: `paper-1` to `paper-4`, `lan`, `wifi`, `transatlantic` or `satellite`.
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

    /// Returns the preset with this name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|p| p.name() == name)
    }

    /// Round trip time without queueing and jitter.
    pub fn round_trip(self) -> Duration {
        2 * LinkConfig::preset(self).delay
    }
}

impl LinkConfig {
    /// The settings of one direction of a preset. Both directions are alike.
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
