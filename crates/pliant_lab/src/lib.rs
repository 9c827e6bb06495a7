//! The laboratory measures Pliant, in virtual time or on this machine. The project's own tests, its
//! report and the `pliant` program use the laboratory. No app needs it.
//!
//! A whole session in virtual time, with a host, a guest and two hands over a network that loses
//! packets:
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
//! | module | content |
//! | --- | --- |
//! | [`pair`] | host and guests joined by emulated links in virtual time |
//! | [`experiment`] | measures a session: errors, forces, bytes |
//! | [`bench`](mod@bench) | cost of a body on this machine, next to the memory bandwidth limit |
//! | [`pull`](mod@pull) | what a hand feels that pulls a body slowly |
//! | [`drop`](mod@drop) | what happens to a free body that falls onto the ground or a ball |
//! | [`report`] | cost and errors of the method, as tables, plots and text |
//! | [`stability`] | stiff, extreme and unfair cases, each with its bound and its margin |
//! | [`simulate`](mod@simulate) | whole sessions under faults that a seed draws |
//! | [`fill`](mod@fill) | tetrahedral meshes from files of any supported kind |
//! | [`progress`] | progress reports of long measurements |

pub mod bench;
pub mod drop;
mod error;
pub mod experiment;
pub mod fill;
mod machine;
pub mod pair;
pub mod pile;
pub mod progress;
pub mod pull;
pub mod report;
pub mod simulate;
pub mod stability;

use pliant_modal::{Elasticity, ModalModel};

pub use error::LabError;
pub use progress::Progress;

/// A ramp from 0 to 1 for `t` from 0 to 1, with zero speed and acceleration at both ends.
pub(crate) fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
}

/// The elasticity of a body of this model: what is asked for, or what the model has.
fn elasticity_of(model: &ModalModel, asked: Option<Elasticity>) -> Result<Elasticity, LabError> {
    match (asked, model.material()) {
        (Some(Elasticity::Reduced), None) => Err(LabError::NoMaterial),
        (Some(asked), _) => Ok(asked),
        (None, Some(_)) => Ok(Elasticity::Reduced),
        (None, None) => Ok(Elasticity::Linear),
    }
}
