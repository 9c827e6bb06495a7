//! Meshes and scenes of all formats.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| pliant_fuzz::meshes(bytes));
