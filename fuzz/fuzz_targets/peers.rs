//! Fuzzes the messages between equal peers.
#![no_main]

use libfuzzer_sys::fuzz_target;
use pliant_stream::wire::PeerMessage;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(message) = PeerMessage::decode(bytes) {
        assert_eq!(PeerMessage::decode(&message.encode()), Ok(message));
    }
});
