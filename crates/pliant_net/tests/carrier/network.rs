//! Another netcode that carries sessions between apps and ports, with delay and loss.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use bevy::prelude::*;
use bytes::Bytes;
use pliant_net::Role;
use pliant_net::transport::{CarrierPort, Channel, Fingerprint, RemotePath};
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss};

use super::support::{Look, wait_for};

pub(super) const SERVER: u64 = 0;

pub(super) const CLIENT: u64 = 7;

pub(super) const ROOM: usize = 1200;

/// A netcode in memory: reliable messages in order, and datagrams of which 9 % are lost and many
/// overtake others.
pub(super) struct Network {
    pub(super) began: Instant,
    pub(super) delay: Duration,
    pub(super) server: CarrierPort,
    pub(super) client: CarrierPort,
    /// To the client, and to the server.
    pub(super) messages: [EmulatedLink<Bytes>; 2],
    pub(super) datagrams: [EmulatedLink<Bytes>; 2],
}

impl Network {
    pub(super) fn new() -> Self {
        Self::with_delay(Duration::from_millis(30))
    }

    pub(super) fn with_delay(delay: Duration) -> Self {
        let keys = [b"server".as_slice(), b"client"].map(Fingerprint::of_name);
        let even = LinkConfig { delay, keep_order: true, ..LinkConfig::default() };
        let uneven = LinkConfig {
            delay,
            loss: Loss::Random(0.09),
            jitter: Duration::from_millis(2),
            reorder: 0.1,
            duplicate: 0.02,
            ..LinkConfig::default()
        };
        let network = Self {
            began: Instant::now(),
            delay,
            server: CarrierPort::new(keys[0]),
            client: CarrierPort::new(keys[1]),
            messages: [1, 2].map(|seed| EmulatedLink::new(even.clone(), seed)),
            datagrams: [3, 4].map(|seed| EmulatedLink::new(uneven.clone(), seed)),
        };
        network.connect();
        network
    }

    pub(super) fn connect(&self) {
        let path = |key| RemotePath { key, role: Role::Hold, max_datagram: ROOM };
        self.server.connected(CLIENT, path(Fingerprint::of_name(b"client")));
        self.client.connected(SERVER, path(Fingerprint::of_name(b"server")));
        for (port, remote) in [(&self.server, CLIENT), (&self.client, SERVER)] {
            port.set_round_trip(remote, 2 * self.delay);
        }
    }

    pub(super) fn carry(&mut self) {
        let now = self.began.elapsed();
        for (to, from) in [&self.server, &self.client].into_iter().enumerate() {
            while let Some(out) = from.poll() {
                let len = out.bytes.len();
                match out.channel {
                    Channel::Message => self.messages[to].send(now, out.bytes, len),
                    Channel::Datagram => {
                        assert!(len <= ROOM, "{len} bytes");
                        self.datagrams[to].send(now, out.bytes, len);
                    }
                }
            }
        }
        for (to, (port, remote)) in [(&self.client, SERVER), (&self.server, CLIENT)].into_iter().enumerate() {
            while let Some(bytes) = self.messages[to].poll(now) {
                port.receive(remote, Channel::Message, bytes);
            }
            while let Some(bytes) = self.datagrams[to].poll(now) {
                port.receive(remote, Channel::Datagram, bytes);
            }
        }
    }

    pub(super) fn run_until<L: Look>(
        &mut self,
        apps: &mut [&mut App],
        awaited: &str,
        mut look: impl FnMut(&mut [&mut App]) -> L,
    ) -> L::Found {
        wait_for(awaited, || {
            std::thread::sleep(Duration::from_millis(4));
            self.carry();
            apps.iter_mut().for_each(|app| app.update());
            look(apps)
        })
    }
}

/// Peers on ports, each connected with each, over links that lose 9 % of the datagrams.
pub(super) struct Party {
    pub(super) began: Instant,
    pub(super) ports: Vec<CarrierPort>,
    /// From the first to the second of each pair: messages, and datagrams.
    pub(super) links: BTreeMap<(usize, usize), [EmulatedLink<Bytes>; 2]>,
}

impl Party {
    pub(super) fn new(count: usize) -> Self {
        let delay = Duration::from_millis(20);
        let even = LinkConfig { delay, keep_order: true, ..LinkConfig::default() };
        let uneven = LinkConfig { delay, loss: Loss::Random(0.09), reorder: 0.1, ..LinkConfig::default() };
        let ports: Vec<CarrierPort> = (0..count).map(|peer| CarrierPort::new(name(peer))).collect();
        let mut links = BTreeMap::new();
        for (from, port) in ports.iter().enumerate() {
            for to in (0..count).filter(|&to| to != from) {
                port.connected(to as u64, RemotePath { key: name(to), role: Role::Hold, max_datagram: ROOM });
                let seed = (10 * from + to) as u64;
                let pair = [(even.clone(), seed), (uneven.clone(), seed + 100)];
                links.insert((from, to), pair.map(|(config, seed)| EmulatedLink::new(config, seed)));
            }
        }
        Self { began: Instant::now(), ports, links }
    }

    pub(super) fn run_until<L: Look>(
        &mut self,
        apps: &mut [&mut App],
        awaited: &str,
        mut look: impl FnMut(&mut [&mut App]) -> L,
    ) -> L::Found {
        wait_for(awaited, || {
            std::thread::sleep(Duration::from_millis(4));
            let now = self.began.elapsed();
            for (from, port) in self.ports.iter().enumerate() {
                while let Some(out) = port.poll() {
                    let link = self.links.get_mut(&(from, out.remote as usize)).unwrap();
                    let (kind, len) = (usize::from(out.channel == Channel::Datagram), out.bytes.len());
                    link[kind].send(now, out.bytes, len);
                }
            }
            for (&(from, to), links) in &mut self.links {
                for (link, channel) in links.iter_mut().zip([Channel::Message, Channel::Datagram]) {
                    while let Some(bytes) = link.poll(now) {
                        self.ports[to].receive(from as u64, channel, bytes);
                    }
                }
            }
            apps.iter_mut().for_each(|app| app.update());
            look(apps)
        })
    }
}

pub(super) fn name(peer: usize) -> Fingerprint {
    Fingerprint::of_name(&[peer as u8])
}
