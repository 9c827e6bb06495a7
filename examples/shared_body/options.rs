//! The command line.

use std::path::PathBuf;

use clap::{Parser, ValueEnum};

/// Two people hold one soft body over a network that loses packets.
///
/// One process: a host and two guests as separate apps on separate threads, joined by real QUIC on loopback through a seeded link emulator.
/// You are the first guest; drag the body with the left mouse button.
#[derive(Parser, Debug, Clone)]
pub struct Options {
    /// Which of the paper's networks lies between host and guests: 1 (9 % loss, 196 ms) to 4 (no loss, 20 ms).
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=4))]
    pub network: u8,

    /// How loss is repaired.
    #[arg(long, value_enum, default_value_t = Recovery::Default)]
    pub recovery: Recovery,

    /// No window: a scripted hand plays your part.
    #[arg(long)]
    pub headless: bool,

    /// Stop after so many seconds. Without a window the default is 10; with one, until it is closed.
    #[arg(long, value_parser = seconds)]
    pub seconds: Option<f64>,

    /// Record for the rerun viewer: a file to write, or `viewer` for one that is running.
    #[arg(long, value_name = "FILE|viewer")]
    pub rerun: Option<String>,

    /// Seed of the link emulator: the same seed loses the same packets.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,

    /// Save a picture of the window at the end (after 6 seconds, unless told otherwise) and stop.
    #[arg(long, value_name = "FILE.png")]
    pub screenshot: Option<PathBuf>,

    /// Open the live panel; F1 does it too.
    #[arg(long)]
    pub panel: bool,

    /// The body to hold: a file under assets/.
    #[arg(long, default_value = "pip.modal")]
    pub body: String,
}

/// The policies that the example offers by name; the library has more.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recovery {
    /// Reactions are streamed, the receiver steps the model: errors die out by themselves.
    Default,
    /// The paper's: accelerations are streamed, lost ones predicted, asked for again and compensated gradually.
    Paper,
    /// Accelerations are streamed, and what is lost is lost.
    None,
}

impl Recovery {
    /// The library's name for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Default => "default",
            Self::Paper => "paper",
            Self::None => "none",
        }
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s.is_finite() && s > 0.0 && s <= 86_400.0 => Ok(s),
        _ => Err("expected seconds above 0 and at most 86400".into()),
    }
}

impl Options {
    /// How long to run; `None` until the window is closed.
    pub fn duration(&self) -> Option<f64> {
        match (self.seconds, &self.screenshot) {
            (Some(s), _) => Some(s),
            (None, Some(_)) => Some(6.0),
            (None, None) if self.headless => Some(10.0),
            (None, None) => None,
        }
    }
}
