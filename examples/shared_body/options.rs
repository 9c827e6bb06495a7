//! The command line.

use clap::{Parser, ValueEnum};
use pliant::stream::emulator::Preset;

use crate::stage;

/// Two people hold one soft body over a network that loses packets.
///
/// One process runs a host and two guests as separate apps on separate threads, connected by real
/// QUIC on loopback through a seeded link emulator. You are the first guest; drag the body with the
/// left mouse button.
#[derive(Parser, Debug, Clone)]
#[command(mut_arg("seconds", |seconds| seconds.help("Stop after so many seconds. Without a window the default is 10; with one, until it is closed")))]
#[command(mut_arg("screenshot", |picture| picture.help("Save a picture of the window at the end (after 6 seconds, unless told otherwise) and stop")))]
pub struct Options {
    #[command(flatten)]
    pub stage: stage::Options,

    /// The network between host and guests: one of the paper's networks, 1 (9 % loss, 196 ms) to 4
    /// (no loss, 20 ms), or another by name: paper-1 to paper-4, lan, wifi, transatlantic,
    /// satellite.
    #[arg(long, default_value = "paper-1", value_parser = network)]
    pub network: Preset,

    /// How loss is repaired.
    #[arg(long, value_enum, default_value_t = Recovery::Default)]
    pub recovery: Recovery,

    /// Record for the rerun viewer: a file to write, or `viewer` for the viewer on this machine,
    /// which is started if it is installed and none runs.
    #[arg(long, value_name = "FILE|viewer")]
    pub rerun: Option<String>,

    /// Seed of the link emulator: the same seed loses the same packets.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,

    /// The body to hold: a file under assets/.
    #[arg(long, default_value = "pip.modal")]
    pub body: String,
}

/// The recovery policies that the example offers by name; the library has more.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recovery {
    /// Reactions are streamed and the receiver steps the model, so errors decay by themselves.
    Default,
    /// The paper's policy: accelerations are streamed; lost ones are predicted, requested again and
    /// compensated gradually.
    Paper,
    /// Accelerations are streamed, and lost ones are not repaired.
    None,
}

impl Recovery {
    /// Returns the library's name of the policy.
    pub fn name(self) -> &'static str {
        match self {
            Self::Default => "default",
            Self::Paper => "paper",
            Self::None => "none",
        }
    }
}

/// Returns a network by its name or by its number in the paper.
fn network(text: &str) -> Result<Preset, String> {
    let numbered = [Preset::Paper1, Preset::Paper2, Preset::Paper3, Preset::Paper4];
    let number = text.parse::<usize>().ok().and_then(|number| numbered.get(number.checked_sub(1)?).copied());
    let names = || Preset::ALL.map(Preset::name).join(", ");
    number.or_else(|| Preset::by_name(text)).ok_or_else(|| format!("expected 1 to 4, {}", names()))
}

impl Options {
    /// Returns the duration of the run, s. `None`: by frames, or until the window closes.
    pub fn duration(&self) -> Option<f64> {
        let stage = &self.stage;
        match (stage.seconds, &stage.screenshot) {
            (Some(s), _) => Some(s),
            _ if stage.frames.is_some() => None,
            (None, Some(_)) => Some(6.0),
            (None, None) if stage.headless => Some(10.0),
            (None, None) => None,
        }
    }
}
