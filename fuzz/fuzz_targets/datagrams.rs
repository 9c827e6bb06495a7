//! Fuzzes datagrams of hosts, guests and peers. A datagram that was read must be writable and read
//! back equal.
#![no_main]

use libfuzzer_sys::fuzz_target;
use pliant_stream::wire::Datagram;

fuzz_target!(|bytes: &[u8]| {
    if let Ok((sequence, datagram)) = Datagram::decode(bytes) {
        let again = Datagram::decode(&datagram.encode(sequence));
        match &datagram {
            // Reading normalizes a rotation to a unit quaternion, so its last bit may differ the
            // second time.
            Datagram::Frame(frame) if frame.pose.is_some() => assert!(again.is_ok()),
            _ => assert_eq!(again, Ok((sequence, datagram))),
        }
    }
});
