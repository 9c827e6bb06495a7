//! Arbitrary bytes cause no panic and no large allocation. The session continues or ends with a
//! reason.

mod parsers;
mod samples;
mod sessions;

use crate::support;
