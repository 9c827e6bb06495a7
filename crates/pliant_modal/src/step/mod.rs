//! The step of a body. Bodies, guests, predictions, peers and devices share one kernel.

mod constraint;
mod elastic;
mod gravity;
mod implied;
mod kernel;
mod modes;
mod patch;
mod predicted_frame;
mod rigid;
mod settings;
mod solve;
mod state;

pub use constraint::{GrabConfig, Hand, Hold};
pub use gravity::FrameMotion;
pub use implied::ImpliedPulls;
pub use kernel::{Kernel, Load, StepReport};
pub use patch::HeldPatch;
pub use rigid::{Frame, RigidMotion};
pub use settings::{Elasticity, StepSettings};
pub use state::State;

pub(crate) use gravity::MassSites;
pub(crate) use kernel::group;
pub(crate) use modes::SharedModes;
pub(crate) use patch::{Six, Tangent, contact_floor, displacement, residual, tangent};
