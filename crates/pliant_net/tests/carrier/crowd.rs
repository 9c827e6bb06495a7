//! A carrier that bounds nothing: all that has come is there in one frame.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use bevy::prelude::*;
use bytes::Bytes;
use pliant_body::{ModalAsset, ModalBody};
use pliant_net::transport::{Carrier, Event, Fingerprint, PeerId, PeerStats, SendError};
use pliant_net::{
    DisconnectReason, HandOf, HostConfig, NetHost, NetPlugin, Role, SessionCommands, SharedBody, UserLeft,
};
use pliant_stream::wire::{
    Datagram, GuestMessage, PROTOCOL_VERSION, Payload, StreamSubscription, TargetEntry, Targets,
};

use super::support::{alone, app, bar, messages, wait_for};

/// Events that a session keeps for its app, and drops the oldest of.
const KEPT: u64 = 4096;
const HOLDERS: u64 = 8;
const LEAVER: PeerId = PeerId(100);

/// What has come. What is sent goes nowhere.
#[derive(Clone, Default)]
struct Inbox(Arc<Mutex<VecDeque<Event>>>);

impl Inbox {
    fn push(&self, event: Event) {
        self.0.lock().unwrap().push_back(event);
    }

    fn message(&self, peer: PeerId, message: &GuestMessage) {
        self.push(Event::Message { peer, bytes: message.encode().into() });
    }
}

impl Carrier for Inbox {
    fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of_name(b"host")
    }

    fn poll(&self) -> Option<Event> {
        self.0.lock().unwrap().pop_front()
    }

    fn peers(&self) -> Vec<PeerId> {
        Vec::new()
    }

    fn send_datagram(&self, _: PeerId, _: Bytes) -> Result<(), SendError> {
        Ok(())
    }

    fn send_message(&self, _: PeerId, _: Bytes) -> Result<(), SendError> {
        Ok(())
    }

    fn unsent(&self, _: PeerId) -> usize {
        0
    }

    fn max_datagram_size(&self, _: PeerId) -> Option<usize> {
        Some(1200)
    }

    fn close(&self, _: PeerId, _: DisconnectReason) {}

    fn rejoin(&self) {}

    fn end(&self) {}

    fn stats(&self, _: PeerId) -> Option<PeerStats> {
        None
    }
}

#[test]
fn a_goodbye_is_heard_also_when_others_flood_the_same_frame() {
    let _alone = alone();
    let mut host = app(NetPlugin::default());
    let (model, inbox) = (bar(), Inbox::default());
    let cached = vec![model.hash().0];
    let handle = host.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(model));
    host.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar")));
    host.world_mut().commands().host_session_over(inbox.clone(), HostConfig::default());
    wait_for("the session", || {
        host.update();
        host.world().contains_resource::<NetHost>()
    });
    let holders = 1..=HOLDERS;
    for peer in holders.clone().map(PeerId).chain([LEAVER]) {
        let fingerprint = Fingerprint::of_name(&peer.0.to_le_bytes());
        inbox.push(Event::Connected { peer, fingerprint, address: None, role: Role::Hold });
        let subscription = StreamSubscription { payload: Payload::Forces, modes: 4, repeats: 0, refresh: 60 };
        let (version, name) = (PROTOCOL_VERSION, format!("{peer:?}"));
        inbox.message(peer, &GuestMessage::Hello { version, name, subscription, cached: cached.clone() });
    }
    for peer in holders.clone() {
        let (target, hold) = ([1.0, 0.0, 0.0], Default::default());
        let (body, vertex, radius) = (1, 4 * peer as u32, 0.05);
        inbox.message(PeerId(peer), &GuestMessage::GrabBegin { grab: 0, body, vertex, radius, target, hold });
    }
    wait_for("all hold", || {
        host.update();
        host.world_mut().query::<&HandOf>().iter(host.world()).count() as u64 == HOLDERS
    });
    assert_eq!(messages::<UserLeft>(&host).len(), 0);

    // One says goodbye, and in the same frame each of the others moves its hand a thousand times,
    // which is its budget.
    inbox.message(LEAVER, &GuestMessage::Goodbye { reason: DisconnectReason::Left });
    let mut sent = 0;
    for input in (1..1000u32).step_by(3) {
        for peer in holders.clone() {
            let target =
                |k| TargetEntry { grab: 0, input: input + k, target: [1.0, 1e-4 * f64::from(k), 0.0] };
            let datagram = Datagram::Targets(Targets { entries: (0..3u32).map(target).collect() });
            let bytes = datagram.encode(input as u16).into();
            inbox.push(Event::Datagram { peer: PeerId(peer), at: Instant::now(), bytes });
            sent += 3;
        }
    }
    assert!(sent > KEPT + 1000, "{sent} targets");
    host.update();
    assert!(inbox.poll().is_none(), "all have come in one frame");
    let left = messages::<UserLeft>(&host);
    println!("{sent} targets in the frame of a goodbye, of which {} were heard", left.len());
    let reasons: Vec<_> = left.iter().map(|left| left.reason).collect();
    assert_eq!(reasons, [DisconnectReason::Left]);
}
