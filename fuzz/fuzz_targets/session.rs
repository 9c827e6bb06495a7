//! Arbitrary bytes into a host and a guest in full session.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| pliant_fuzz::session(bytes));
