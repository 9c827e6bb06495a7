//! Search for connected devices.

#[cfg(feature = "vendor")]
use crate::{ForceDimension, ForceDimensionConfig, OpenHaptics, OpenHapticsConfig};
use crate::{HandModel, HapticDevice, VirtualConfig, VirtualDevice};
#[cfg(feature = "inverse")]
use crate::{Inverse, InverseConfig};

/// Settings of the search. Defaults: the usual locations of the vendors.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FindConfig {
    /// Settings of the Inverse's service.
    #[cfg(feature = "inverse")]
    pub inverse: InverseConfig,
    /// Settings of 3D Systems' library. The search tries the device that they name.
    #[cfg(feature = "vendor")]
    pub open_haptics: OpenHapticsConfig,
    /// Settings of Force Dimension's library.
    #[cfg(feature = "vendor")]
    pub force_dimension: ForceDimensionConfig,
}

/// A device that was present when the search ran.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Found {
    /// A Haply Inverse3.
    #[cfg(feature = "inverse")]
    Inverse(InverseConfig),
    /// A 3D Systems device.
    #[cfg(feature = "vendor")]
    OpenHaptics(OpenHapticsConfig),
    /// A Force Dimension device.
    #[cfg(feature = "vendor")]
    ForceDimension(ForceDimensionConfig),
    /// The simulated Touch, which is always present.
    Virtual,
}

/// Reason why a found device could not be opened, in the words of its driver.
pub type OpenError = Box<dyn std::error::Error + Send + Sync>;

impl Found {
    /// Opens the device.
    ///
    /// # Errors
    /// Returns an error if the device has gone since, or if another program uses it.
    pub fn open(&self) -> Result<Box<dyn HapticDevice>, OpenError> {
        Ok(match self {
            #[cfg(feature = "inverse")]
            Self::Inverse(config) => Box::new(Inverse::open(config.clone())?),
            #[cfg(feature = "vendor")]
            Self::OpenHaptics(config) => Box::new(OpenHaptics::open(config.clone())?),
            #[cfg(feature = "vendor")]
            Self::ForceDimension(config) => Box::new(ForceDimension::open(config.clone())?),
            Self::Virtual => Box::new(VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM)?),
        })
    }
}

/// Searches for devices and returns real devices first and the simulated device last. A library
/// that is not installed is no error. Other errors are only logged.
///
/// The call takes up to the Inverse's timeout. It also opens and closes a 3D Systems device,
/// because its library has no other way to query it. The call is therefore not suitable for every
/// frame.
pub fn find_devices(config: &FindConfig) -> Vec<Found> {
    let mut found = Vec::new();
    #[cfg(feature = "inverse")]
    match Inverse::list(&config.inverse) {
        Ok(ids) => found.extend(
            ids.into_iter()
                .map(|id| Found::Inverse(InverseConfig { device: Some(id), ..config.inverse.clone() })),
        ),
        Err(error) => tracing::debug!("{error}"),
    }
    #[cfg(feature = "vendor")]
    {
        match OpenHaptics::open(config.open_haptics.clone()) {
            Ok(_) => found.push(Found::OpenHaptics(config.open_haptics.clone())),
            Err(error) => tracing::debug!("{error}"),
        }
        match ForceDimension::count(&config.force_dimension) {
            Ok(count) => found.extend((0..count.min(16)).map(|index| {
                let index = index as u8;
                Found::ForceDimension(ForceDimensionConfig { index, ..config.force_dimension.clone() })
            })),
            Err(error) => tracing::debug!("{error}"),
        }
    }
    #[cfg(not(any(feature = "inverse", feature = "vendor")))]
    let _ = config;
    found.push(Found::Virtual);
    found
}
