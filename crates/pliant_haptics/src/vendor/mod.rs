//! Devices whose makers' libraries are loaded at run time: nothing is linked, nothing is needed to build, and a machine without them says so.

mod force_dimension;
mod open_haptics;

use std::path::PathBuf;

use libloading::Library;
use thiserror::Error;

pub use force_dimension::{ForceDimension, ForceDimensionConfig};
pub use open_haptics::{OpenHaptics, OpenHapticsConfig};

/// Why a vendor's device cannot be had.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VendorError {
    /// No library under any of its names.
    #[error("none of {tried:?} could be loaded: {reason}")]
    Library {
        /// The names tried.
        tried: Vec<PathBuf>,
        /// What the loader said of the last.
        reason: String,
    },
    /// The library is there and lacks a function: of another version, or something else by the same name.
    #[error("{library:?} has no {symbol}: it is of another version, or another library")]
    Symbol {
        /// The library.
        library: PathBuf,
        /// The function that is missing.
        symbol: &'static str,
    },
    /// The library is too old.
    #[error("{library:?} is of version {found}, {needed} or newer is needed")]
    Version {
        /// The library.
        library: PathBuf,
        /// What it says.
        found: String,
        /// What is needed.
        needed: &'static str,
    },
    /// The library has no device for us.
    #[error("no device: {what} failed with code {code:#x} ({text})")]
    Device {
        /// The call that failed.
        what: &'static str,
        /// The maker's code.
        code: i64,
        /// The maker's words, if any.
        text: String,
    },
}

/// Loads the first of `names` that there is, or `given` and nothing else.
fn load(given: Option<&PathBuf>, names: &[&str]) -> Result<(Library, PathBuf), VendorError> {
    let tried: Vec<PathBuf> = match given {
        Some(path) => vec![path.clone()],
        None => names.iter().map(PathBuf::from).collect(),
    };
    let mut reason = String::from("no names");
    for name in &tried {
        // SAFETY: loading runs the library's initialisers. These are the makers' own libraries by their own names, or the path that the
        // user gave.
        match unsafe { Library::new(name) } {
            Ok(library) => return Ok((library, name.clone())),
            Err(error) => reason = error.to_string(),
        }
    }
    Err(VendorError::Library { tried, reason })
}

/// Declares a table of functions and how it is filled from a library: one list, so that name, signature and symbol cannot drift apart.
macro_rules! functions {
    ($(#[$meta:meta])* struct $name:ident { $($field:ident = $symbol:literal: fn($($arg:ty),*) $(-> $ret:ty)?;)* }) => {
        $(#[$meta])*
        #[derive(Clone, Copy)]
        struct $name { $($field: unsafe extern "system" fn($($arg),*) $(-> $ret)?,)* }

        impl $name {
            fn from(library: &libloading::Library, path: &std::path::Path) -> Result<Self, crate::vendor::VendorError> {
                $(
                    // SAFETY: the signature is that of the maker's public header.
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

/// A C string of the library's, or nothing.
///
/// # Safety
/// `text` is null or a C string that lives long enough to be copied.
unsafe fn text(text: *const std::ffi::c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: as the caller promised.
    unsafe { std::ffi::CStr::from_ptr(text) }.to_string_lossy().into_owned()
}
