//! Recorded networks and loss models in text form.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| pliant_fuzz::traces(bytes));
