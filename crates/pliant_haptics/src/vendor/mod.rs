//! Devices with vendor libraries that are loaded at run time. The build links nothing and needs
//! nothing, and without the libraries an error is returned at run time.

mod force_dimension;
mod open_haptics;

use std::path::PathBuf;

use libloading::Library;
use thiserror::Error;

pub use force_dimension::{ForceDimension, ForceDimensionConfig};
pub use open_haptics::{OpenHaptics, OpenHapticsConfig};

/// Reason why a vendor's device could not be opened.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VendorError {
    /// No library could be loaded under any of its names.
    #[error("none of {tried:?} could be loaded: {reason}")]
    Library {
        /// The names that were tried.
        tried: Vec<PathBuf>,
        /// The loader's message for the last name.
        reason: String,
    },
    /// The library lacks a function. It has another version, or it is another library of the same
    /// name.
    #[error("{library:?} has no {symbol}: it is of another version, or another library")]
    Symbol {
        /// The library.
        library: PathBuf,
        /// The missing function.
        symbol: &'static str,
    },
    /// The library is too old.
    #[error("{library:?} is of version {found}, {needed} or newer is needed")]
    Version {
        /// The library.
        library: PathBuf,
        /// The version of the library.
        found: String,
        /// The needed version.
        needed: &'static str,
    },
    /// The library could not open a device.
    #[error("no device: {what} failed with code {code:#x} ({text})")]
    Device {
        /// The call that failed.
        what: &'static str,
        /// The vendor's error code.
        code: i64,
        /// The vendor's error text, if any.
        text: String,
    },
}

/// Loads the first available library of `names`, or only `given` if there is one.
fn load(given: Option<&PathBuf>, names: &[&str]) -> Result<(Library, PathBuf), VendorError> {
    let tried: Vec<PathBuf> = match given {
        Some(path) => vec![path.clone()],
        None => names.iter().map(PathBuf::from).collect(),
    };
    let mut reason = String::from("no names");
    for name in &tried {
        // SAFETY: loading runs the library's initializers. These are the vendors' own libraries by
        // their own names, or the path that the user gave.
        match unsafe { Library::new(name) } {
            Ok(library) => return Ok((library, name.clone())),
            Err(error) => reason = error.to_string(),
        }
    }
    Err(VendorError::Library { tried, reason })
}

/// Declares a table of functions and how a library fills it. One list serves for both, so that
/// name, signature and symbol cannot diverge.
macro_rules! functions {
    ($(#[$meta:meta])* struct $name:ident { $($field:ident = $symbol:literal: fn($($arg:ty),*) $(-> $ret:ty)?;)* }) => {
        $(#[$meta])*
        #[derive(Clone, Copy)]
        struct $name { $($field: unsafe extern "system" fn($($arg),*) $(-> $ret)?,)* }

        impl $name {
            fn from(library: &libloading::Library, path: &std::path::Path) -> Result<Self, crate::vendor::VendorError> {
                $(
                    // SAFETY: the signature is that of the vendor's public header.
                    let $field = unsafe {
                        library.get::<unsafe extern "system" fn($($arg),*) $(-> $ret)?>(concat!($symbol, "\0").as_bytes())
                    };
                    let $field = *$field.map_err(|_| crate::vendor::VendorError::Symbol {
                        library: path.to_path_buf(),
                        symbol: $symbol,
                    })?;
                )*
                Ok(Self { $($field),* })
            }
        }
    };
}
use functions;

/// Copies a C string of the library. A null pointer gives an empty string.
///
/// # Safety
/// `text` is null or a C string that lives long enough to be copied.
unsafe fn text(text: *const std::ffi::c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: the caller guarantees it.
    unsafe { std::ffi::CStr::from_ptr(text) }.to_string_lossy().into_owned()
}
