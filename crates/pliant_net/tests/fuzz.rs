//! Invites, and files of recorded sessions, from anybody.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[path = "../../pliant_lab/tests/support/fuzzing.rs"]
mod fuzzing;

use std::net::SocketAddr;

use pliant_net::transport::{Fingerprint, Token};
use pliant_net::{Invite, RecordingError, SessionRecording};

#[test]
fn no_text_panics_the_reader_of_invites() {
    let address: [SocketAddr; 2] = ["192.0.2.7:4433".parse().unwrap(), "[2001:db8::1]:9".parse().unwrap()];
    let invite = Invite::new(address[0], Fingerprint([0xab; 32]));
    let secret = Invite::new(address[1], Fingerprint([7; 32])).with_token(Token([0x0c; 16]));
    let named = format!(" pliant://play.example.org:4433#{}\n", "1f".repeat(32));
    // Found by this test: an address with leading zeros was another invite after it was written.
    let zeros = secret.to_string().replace("db8", "0b8");
    assert_eq!(zeros.parse::<Invite>().unwrap(), zeros.replace("0b8", "b8").parse().unwrap());
    let corpus = vec![invite.to_string().into_bytes(), secret.to_string().into_bytes(), named.into_bytes()];
    fuzzing::run("invites", corpus, |bytes| {
        let text = String::from_utf8_lossy(bytes);
        match text.parse::<Invite>() {
            // What was read is written and read again alike.
            Ok(invite) => assert_eq!(invite.to_string().parse(), Ok(invite)),
            Err(error) => {
                let said = error.to_string();
                // The error shows the form of an invite, which is shorter.
                assert!(text.len() < 40 || !said.contains(&*text), "repeats an invite: {said}");
                assert!(!said.contains(&"0c".repeat(4)), "repeats a token: {said}");
            }
        }
    });
}

/// A record of a session: its kind, its time in microseconds and its data.
fn record(kind: u8, at: u64, data: &[u8]) -> Vec<u8> {
    let length = u32::try_from(data.len()).unwrap().to_le_bytes();
    [&[kind], &at.to_le_bytes()[..], &length, data].concat()
}

#[test]
fn no_file_panics_the_reader_of_recordings() {
    // The first byte says whether the rest is a file, or what a file has before it is compressed.
    let records =
        [record(0, 1500, &[1, 0x8a, 4]), record(1, 2000, &[7; 90]), record(2, 3000, b"a message")].concat();
    let model = [record(3, 0, b"PLIANTM of a kind"), record(4, 9000, &[1])].concat();
    let packed = |records: &[u8]| {
        let file = zstd::encode_all(records, 3).unwrap();
        [&b"PLIANT\x02R"[..], &file].concat()
    };
    let corpus = vec![
        [&[1][..], &records].concat(),
        [&[1][..], &records, &model].concat(),
        [&[0][..], &packed(&records)].concat(),
    ];
    let path = std::env::temp_dir().join(format!("pliant-fuzz-recording-{}", std::process::id()));
    fuzzing::run("recordings", corpus, |bytes| {
        let Some((first, rest)) = bytes.split_first() else { return };
        let file = if first % 2 == 0 { rest.to_vec() } else { packed(rest) };
        std::fs::write(&path, &file).unwrap();
        match SessionRecording::open(&path) {
            Ok(_) | Err(RecordingError::Kind { .. }) => {}
            Err(other) => panic!("{other}"),
        }
    });
    std::fs::remove_file(&path).unwrap();
}
