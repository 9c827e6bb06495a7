//! Feel it: the haptic device layer of Pliant.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod core;
mod coupling;
mod cycle;
mod device;
mod follow;
mod hand;
mod histogram;
mod intake;
#[cfg(feature = "inverse")]
mod inverse;
mod local;
mod modal_local;
mod pace;
mod record;
mod runner;
mod safety;
mod tool;
#[cfg(feature = "vendor")]
mod vendor;
mod virtual_device;

pub use core::{LoopConfig, LoopCore, StartError, Tick};
pub use coupling::{Coupling, CouplingConfig, CouplingLimit};
pub use cycle::{Cycle, LoopEvent, LoopReport, LoopState, Record, Sink};
pub use device::{
    Calibration, DeviceInfo, Fault, HapticDevice, InfoError, Pace, Pacing, Period, Sample, VibrationOutput,
    Wrench,
};
pub use hand::Hand;
pub use histogram::Histogram;
#[cfg(feature = "inverse")]
pub use inverse::{Inverse, InverseConfig, InverseError, Spelling};
pub use local::{Contact, HeldGrab, LocalModel, MAX_CONTACTS, ModelWriter};
pub use modal_local::ModalLocal;
pub use pace::{LoopClock, RealPace, VirtualPace};
pub use record::{RecordError, Recorder, Replay};
pub use runner::{HapticLoop, StopSwitch};
pub use safety::{
    Allowed, Gain, Passivity, PassivityConfig, Port, Safety, SafetyConfig, Slew, StaleConfig, Thermal,
    ThermalConfig, VelocityCutConfig, Wanted, cap_damping, clamp_magnitude, stable_damping,
};
pub use tool::ToolMap;
#[cfg(feature = "vendor")]
pub use vendor::{ForceDimension, ForceDimensionConfig, OpenHaptics, OpenHapticsConfig, VendorError};
pub use virtual_device::{Virtual, VirtualConfig, VirtualHandle};
