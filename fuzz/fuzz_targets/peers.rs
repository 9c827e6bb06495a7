//! Fuzzes the messages and datagrams between equal peers.
#![no_main]

use libfuzzer_sys::fuzz_target;
use pliant_stream::peer::{PeerDatagram, PeerMessage};

fuzz_target!(|bytes: &[u8]| {
    if let Ok((sequence, datagram)) = PeerDatagram::decode(bytes) {
        let again = datagram.encode(sequence);
        assert_eq!(PeerDatagram::decode(&again), Ok((sequence, datagram)));
    }
    if let Ok(message) = PeerMessage::decode(bytes) {
        assert_eq!(PeerMessage::decode(&message.encode()), Ok(message));
    }
});
