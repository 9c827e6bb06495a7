//! Fuzzes the reliable messages of both directions, including snapshots.
#![no_main]

use libfuzzer_sys::fuzz_target;
use pliant_stream::wire::{GuestMessage, HostMessage};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(message) = GuestMessage::decode(bytes) {
        assert_eq!(GuestMessage::decode(&message.encode()), Ok(message));
    }
    if let Ok(message) = HostMessage::decode(bytes) {
        assert_eq!(HostMessage::decode(&message.encode()), Ok(message));
    }
});
