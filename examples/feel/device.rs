//! The choice of the device that an example uses.
#![allow(dead_code, reason = "each example uses the part that it needs")]

use std::error::Error;

use clap::ValueEnum;
use pliant::haptics::{
    FindConfig, ForceDimension, Found, HandModel, HapticDevice, Inverse, LoopConfig, OpenHaptics, Positioned,
    PositionedHandle, SafetyConfig, StaleConfig, VirtualConfig, VirtualDevice, VirtualHandle, find_devices,
};

/// The devices by name.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The first real device that is plugged in, else the simulated device.
    Auto,
    /// A simulated Premium in a simulated hand that plays a script.
    Virtual,
    /// The mouse. The force is shown but not felt.
    Pointer,
    /// A gamepad. The force is shown, and the gamepad vibrates.
    Gamepad,
    /// Haply Inverse3, through its service.
    Inverse,
    /// 3D Systems Touch, Omni, Premium, through OpenHaptics.
    Touch,
    /// Force Dimension omega, delta, sigma; Falcon.
    ForceDimension,
}

/// How the simulated hand holds the simulated device.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum Grip {
    Firm,
    Light,
    Loose,
    None,
}

impl Grip {
    fn hand(self) -> HandModel {
        match self {
            Self::Firm => HandModel::FIRM,
            Self::Light => HandModel::LIGHT,
            Self::Loose => HandModel::LOOSE,
            Self::None => HandModel::NONE,
        }
    }
}

/// What moves the device.
#[derive(Debug, Clone)]
pub enum Mover {
    /// A script, through this handle.
    Script(VirtualHandle),
    /// The mouse or a gamepad, through this handle.
    Input(PositionedHandle),
    /// A person, or a recording.
    Nobody,
}

/// An open device and what moves it.
pub struct Opened {
    pub device: Box<dyn HapticDevice>,
    pub mover: Mover,
}

pub fn open(kind: Kind, grip: Grip) -> Result<Opened, Box<dyn Error>> {
    let real = |device: Box<dyn HapticDevice>| Opened { device, mover: Mover::Nobody };
    Ok(match kind {
        Kind::Auto => match find_devices(&FindConfig::default()).into_iter().next() {
            None | Some(Found::Virtual) => open(Kind::Virtual, grip)?,
            Some(found) => real(found.open().map_err(|error| error.to_string())?),
        },
        Kind::Virtual => {
            let device = VirtualDevice::new(VirtualConfig::premium(), grip.hand())?;
            let mover = Mover::Script(device.handle());
            Opened { device: Box::new(device), mover }
        }
        Kind::Pointer | Kind::Gamepad => {
            let device = Positioned::new(if kind == Kind::Pointer { "pointer" } else { "gamepad" });
            let mover = Mover::Input(device.handle());
            Opened { device: Box::new(device), mover }
        }
        Kind::Inverse => real(Box::new(Inverse::open(Default::default())?)),
        Kind::Touch => real(Box::new(OpenHaptics::open(Default::default())?)),
        Kind::ForceDimension => real(Box::new(ForceDimension::open(Default::default())?)),
    })
}

/// Returns the configuration of the device loop.
///
/// A real device always has the whole safety pipeline. For a picture from a software renderer, the
/// loop of a simulated hand waits longer for the next local model update.
pub fn loop_config(device: &dyn HapticDevice, modal: bool, picture: bool) -> LoopConfig {
    let mut config = LoopConfig { modal, ..LoopConfig::default() };
    let info = device.info();
    if picture && info.simulated {
        let stale = Some(StaleConfig { patience: 5.0, limit: 6.0 });
        config.safety = Some(SafetyConfig { stale, ..SafetyConfig::for_device(&info, config.rate) });
    }
    config
}
