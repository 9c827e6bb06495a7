//! Three peers, in any order of events.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| pliant_fuzz::mesh(bytes));
