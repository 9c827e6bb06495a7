//! Links among peers: paths that carry too little, and peers that fall silent.

use std::time::Duration;

use pliant_stream::peer::{PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::PeerMessage;
use pliant_stream::{Channel, DisconnectReason, MIN_DATAGRAM, PeerId, StreamError, UserId};

const PEER: PeerId = PeerId(7);
const IDLE: Duration = Duration::from_secs(10);

fn first_peer() -> PeerSession {
    let config =
        PeerSessionConfig { user: UserId(1), founds: true, idle_timeout: IDLE, ..Default::default() };
    PeerSession::new(config).unwrap()
}

/// Returns the reasons of the goodbyes that wait to be sent.
fn goodbyes(session: &mut PeerSession) -> Vec<DisconnectReason> {
    std::iter::from_fn(|| session.poll_output())
        .filter(|output| output.channel == Channel::Message)
        .filter_map(|output| match PeerMessage::decode(&output.bytes) {
            Ok(PeerMessage::Goodbye { reason }) => Some(reason),
            _ => None,
        })
        .collect()
}

fn turned_away(session: &mut PeerSession) -> Option<DisconnectReason> {
    std::iter::from_fn(|| session.poll_event()).find_map(|event| match event {
        PeerEvent::TurnedAway { peer: PEER, reason } => Some(reason),
        _ => None,
    })
}

#[test]
fn a_path_that_carries_too_little_joins_nobody() {
    let mut session = first_peer();
    for small in [0, MIN_DATAGRAM - 1] {
        let refused = session.accept(Duration::ZERO, PEER, small);
        assert!(matches!(refused, Err(StreamError::Config { what: "datagram size", .. })), "{refused:?}");
        let refused = session.connect(Duration::ZERO, PEER, UserId(2), small);
        assert!(matches!(refused, Err(StreamError::Config { what: "datagram size", .. })), "{refused:?}");
    }
    session.accept(Duration::ZERO, PEER, MIN_DATAGRAM).unwrap();
    session.set_max_datagram(PEER, 1200);
    assert_eq!(goodbyes(&mut session), []);
    session.set_max_datagram(PEER, MIN_DATAGRAM - 1);
    assert_eq!(goodbyes(&mut session), [DisconnectReason::SmallDatagrams]);
    assert_eq!(turned_away(&mut session), Some(DisconnectReason::SmallDatagrams));
    assert!(session.stats(PEER).is_none());
}

#[test]
fn a_peer_that_falls_silent_is_told_of_it_at_the_time_that_was_named() {
    // A peer that waits for its number steps nothing, and still has to be called when the other
    // one has been silent for too long.
    let mut session = PeerSession::new(PeerSessionConfig {
        user: UserId::HOST,
        founds: false,
        idle_timeout: IDLE,
        ..Default::default()
    })
    .unwrap();
    assert_eq!(session.next_wakeup(), None);
    session.connect(Duration::ZERO, PEER, UserId(1), 1200).unwrap();
    let named = session.next_wakeup().unwrap();
    assert!(named > IDLE && named < IDLE + Duration::from_millis(10), "{named:?}");
    session.update(named - Duration::from_millis(2));
    assert_eq!(goodbyes(&mut session), []);
    session.update(named);
    assert_eq!(goodbyes(&mut session), [DisconnectReason::Silent]);
    assert_eq!(turned_away(&mut session), Some(DisconnectReason::Silent));
    assert_eq!(session.next_wakeup(), None);
}
