//! What is plugged in.

#[cfg(feature = "vendor")]
use crate::{ForceDimension, ForceDimensionConfig, OpenHaptics, OpenHapticsConfig};
use crate::{Hand, HapticDevice, VirtualConfig, VirtualDevice};
#[cfg(feature = "inverse")]
use crate::{Inverse, InverseConfig};

/// Where to look. Defaults: the vendors' usual places.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FindConfig {
    /// The Inverse's service.
    #[cfg(feature = "inverse")]
    pub inverse: InverseConfig,
    /// 3D Systems' library; its default device is looked for.
    #[cfg(feature = "vendor")]
    pub open_haptics: OpenHapticsConfig,
    /// Force Dimension's library.
    #[cfg(feature = "vendor")]
    pub force_dimension: ForceDimensionConfig,
}

/// A device that is there, or seemed to be when it was looked for.
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
    /// None of them: the simulated Touch, which always is.
    Virtual,
}

/// Why a found device could not be opened after all, in its maker's words.
pub type OpenError = Box<dyn std::error::Error + Send + Sync>;

impl Found {
    /// Opens it.
    ///
    /// # Errors
    /// It has gone since, or somebody else has it.
    pub fn open(&self) -> Result<Box<dyn HapticDevice>, OpenError> {
        Ok(match self {
            #[cfg(feature = "inverse")]
            Self::Inverse(config) => Box::new(Inverse::open(config.clone())?),
            #[cfg(feature = "vendor")]
            Self::OpenHaptics(config) => Box::new(OpenHaptics::open(config.clone())?),
            #[cfg(feature = "vendor")]
            Self::ForceDimension(config) => Box::new(ForceDimension::open(config.clone())?),
            Self::Virtual => Box::new(VirtualDevice::new(VirtualConfig::touch(), Hand::FIRM)?),
        })
    }
}

/// Looks for devices: real ones first, the simulated one last. What is not installed is no error; what was in the way is logged.
///
/// Takes as long as the Inverse's timeout, and opens and closes a 3D Systems device, whose library cannot be asked otherwise: not for every frame.
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
