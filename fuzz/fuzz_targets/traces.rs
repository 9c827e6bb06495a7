//! Fuzzes recorded networks and loss models in text form.
#![no_main]

use std::time::Duration;

use libfuzzer_sys::fuzz_target;
use pliant_stream::emulator::{Loss, PathTrace};

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let _ = PathTrace::parse(text);
    let _ = Loss::parse(text, 1, Duration::from_millis(25));
});
