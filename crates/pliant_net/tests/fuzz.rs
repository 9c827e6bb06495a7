//! Invites, files of recorded sessions, and what a port receives, from anybody.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[path = "../../pliant_lab/tests/support/fuzzing.rs"]
mod fuzzing;

use std::net::SocketAddr;

use bytes::Bytes;
use pliant_net::transport::{
    Carrier, CarrierPort, Channel, Event, Fingerprint, Limits, PeerId, RemotePath, Role, Token,
};
use pliant_net::{DisconnectReason, Invite, RecordingError, SessionRecording};

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
                let message = error.to_string();
                // The error shows the form of an invite, which is shorter.
                assert!(text.len() < 40 || !message.contains(&*text), "repeats an invite: {message}");
                assert!(!message.contains(&"0c".repeat(4)), "repeats a token: {message}");
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

const SERVER: u64 = 0;
const GUEST: u64 = 7;
const UNKNOWN: u64 = 8;
/// Largest datagram of the netcode, and longest message of a session here.
const ROOM: usize = 1200;
const LONGEST: usize = 4096;
/// The longest message that a port gives to the netcode.
const LONGEST_OUTPUT: usize = 2051;

/// A host's port with a guest that behaves, and a stranger that sends what it likes.
struct Ports {
    server: CarrierPort,
    guest: CarrierPort,
    sent: u32,
    read: u32,
}

impl Ports {
    fn unknown_path() -> RemotePath {
        RemotePath { key: Fingerprint::of_name(b"stranger"), role: Role::Hold, max_datagram: ROOM }
    }

    fn new() -> Self {
        let keys = [b"server".as_slice(), b"guest"].map(Fingerprint::of_name);
        let path = |key| RemotePath { key, role: Role::Hold, max_datagram: ROOM };
        let (server, guest) = (CarrierPort::new(keys[0]), CarrierPort::new(keys[1]));
        server.connected(GUEST, path(keys[1]));
        server.connected(UNKNOWN, Self::unknown_path());
        guest.connected(SERVER, path(keys[0]));
        Self { server, guest, sent: 0, read: 0 }
    }

    fn carry(&self) {
        for _ in 0..10_000 {
            let (down, up) = (self.server.poll(), self.guest.poll());
            for out in down.iter().chain(&up) {
                let most = if out.channel == Channel::Message { LONGEST_OUTPUT } else { ROOM };
                assert!(out.bytes.len() <= most, "{} bytes at once", out.bytes.len());
            }
            if down.is_none() && up.is_none() {
                return;
            }
            if let Some(out) = down.filter(|out| out.remote == GUEST) {
                self.guest.receive(SERVER, out.channel, out.bytes);
            }
            if let Some(out) = up {
                self.server.receive(GUEST, out.channel, out.bytes);
            }
        }
        panic!("the ports never stop to send");
    }

    /// Reads what the host has been told. The guest's messages come all and in order.
    fn read(&mut self, host: &impl Carrier, guest: PeerId) {
        host.begin_frame();
        while let Some(event) = host.poll_in_frame() {
            match event {
                Event::Message { peer, bytes } if peer == guest => {
                    assert_eq!(&bytes[..], self.read.to_le_bytes());
                    self.read += 1;
                }
                Event::Message { bytes, .. } => assert!(bytes.len() <= LONGEST, "{} bytes", bytes.len()),
                Event::Closed { peer, reason } => assert!(peer != guest, "the guest is gone: {reason}"),
                _ => {}
            }
        }
        assert!(host.peers().len() <= 2, "{:?}", host.peers());
    }
}

#[test]
fn what_a_port_receives_panics_nothing_and_costs_no_other_end_its_session() {
    // What happens: the stranger sends the bytes that follow, and what the other bytes below 9 do.
    let say = |channel: u8, bytes: &[u8]| [&[channel, bytes.len() as u8], bytes].concat();
    let opens = say(0, &[0, 5, 0]);
    let talks =
        [opens.clone(), say(0, &[4, 5, 0, 1, 2]), say(0, &[2, 5, 0, 3]), say(1, &[5, 0, 9]), vec![2, 3]];
    let goes = [opens.clone(), vec![2, 4, 5], say(0, &[3, 5, 0, 1]), opens.clone(), vec![6, 2, 8]];
    let claims = [say(0, &[1, 5, 0, 1]), say(0, &[2, 1, 0, 7]), say(0, &[3, 1, 0, 0]), vec![7, 2, 3, 2]];
    let long = [opens, vec![8; 6], vec![3, 4, 2]];
    let corpus = [&talks[..], &goes, &claims, &long].map(<[_]>::concat).to_vec();
    fuzzing::run("ports", corpus, |mut script| {
        let mut ports = Ports::new();
        let host = ports.server.host(Limits { message: LONGEST, peers: 2, ..Limits::host() });
        let joined = ports.guest.join(SERVER, Limits::guest());
        ports.carry();
        let Some(Event::Connected { peer: guest, .. }) = host.poll() else { panic!("the guest gets in") };
        let event_of = |event: Event| match event {
            Event::Closed { reason, .. } => panic!("the guest is told that it is out: {reason}"),
            event => event,
        };
        for _ in 0..200 {
            let Some((&what, rest)) = script.split_first() else { break };
            script = rest;
            match what % 9 {
                channel @ 0..2 => {
                    let length = script.first().map_or(0, |&length| usize::from(length));
                    let (bytes, rest) = script.split_at((1 + length).min(script.len()));
                    script = rest;
                    let channel = if channel == 0 { Channel::Message } else { Channel::Datagram };
                    let bytes = Bytes::copy_from_slice(bytes.get(1..).unwrap_or_default());
                    ports.server.receive(UNKNOWN, channel, bytes);
                }
                2 => ports.carry(),
                3 => {
                    let number = ports.sent.to_le_bytes();
                    joined.send_message(PeerId::HOST, Bytes::copy_from_slice(&number)).unwrap();
                    ports.sent += 1;
                    joined.send_datagram(PeerId::HOST, Bytes::copy_from_slice(&number)).unwrap();
                }
                4 => {
                    for peer in host.peers() {
                        // A stranger that reads nothing has a full queue one day.
                        let _ = host.send_message(peer, Bytes::from(vec![7; 3000]));
                        let _ = host.send_datagram(peer, Bytes::from(vec![7; 1000]));
                    }
                }
                5 => ports.server.disconnected(UNKNOWN, DisconnectReason::Lost),
                6 => ports.server.connected(UNKNOWN, Ports::unknown_path()),
                7 => {
                    for peer in host.peers().into_iter().filter(|peer| *peer != guest) {
                        host.close(peer, DisconnectReason::Kicked);
                    }
                }
                _ => {
                    let part = [&[4, 5, 0][..], &[1; 1000]].concat();
                    ports.server.receive(UNKNOWN, Channel::Message, part.into());
                }
            }
            ports.read(&host, guest);
            std::iter::from_fn(|| joined.poll()).for_each(|event| drop(event_of(event)));
        }
        // The cap on the rate holds back a part for some milliseconds.
        for _ in 0..1000 {
            ports.carry();
            ports.read(&host, guest);
            if ports.read == ports.sent {
                break;
            }
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        std::iter::from_fn(|| joined.poll()).for_each(|event| drop(event_of(event)));
        assert_eq!(ports.read, ports.sent, "all that the guest has sent has come");
    });
}
