//! The laboratory: Pliant measured, in virtual time or on this machine. It is for the project's own
//! tests, its report and the `pliant` program; no app needs it.
//!
//! A whole session, a host and a guest and two hands over a network that loses packets, in virtual
//! time:
//!
//! ```
//! use std::sync::Arc;
//! use pliant_lab::experiment::Experiment;
//! use pliant_modal::ModalModel;
//! use pliant_stream::{RecoveryConfig, emulator::{LinkConfig, Preset}};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let model = Arc::new(ModalModel::read("../../assets/bud.modal")?);
//! let network = LinkConfig::preset(Preset::Paper1); // 9 % lost, 196 ms there and back
//! let whole = Experiment::new(model, network, RecoveryConfig::default());
//! let seen = Experiment { seconds: 5.0, ..whole }.run()?;
//! println!("{} frames lost, shown within {:.3} % (rms)", seen.lost, seen.rms_percent);
//! assert!(seen.lost > 0 && seen.rms_percent < 0.5);
//! # Ok(())
//! # }
//! ```
//!
//! | module | what it holds |
//! | --- | --- |
//! | [`pair`] | host and guests joined by emulated links in virtual time |
//! | [`experiment`] | a session measured: errors, forces, bytes |
//! | [`bench`](mod@bench) | what a body costs on this machine, beside the limit that memory sets |
//! | [`report`] | what the method costs and what it is off by: tables, figures, words |
//! | [`stability`] | stiff, extreme and unfair cases, each with its bound and its margin |
//! | [`fill`](mod@fill) | tetrahedra out of a file, whatever it holds |
//! | [`progress`] | who is told how far a measurement is |

pub mod bench;
mod error;
pub mod experiment;
pub mod fill;
mod machine;
pub mod pair;
pub mod progress;
pub mod report;
pub mod stability;

pub use error::LabError;
pub use progress::Progress;
