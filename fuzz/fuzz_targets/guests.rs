//! A host with two guests, in any order of events.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| pliant_fuzz::guests(bytes));
