//! Equal peers over emulated links, and the hello of the peer with the lowest number.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{GrabConfig, ModalModel};
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss};
use pliant_stream::peer::{LateInputRepair, PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::{PROTOCOL_VERSION, PeerMessage};
use pliant_stream::{Channel, PeerId, StepSettings, Surroundings, UserId};

use super::support::bar;
use super::{BODY, MS, OTHER};

/// Peer `k` has user number `k + 1`, and the others know it as `PeerId(k)`.
pub struct Mesh {
    pub peers: Vec<Option<PeerSession>>,
    /// `[from][to]`: the link for datagrams and the link for messages.
    pub links: Vec<Vec<(EmulatedLink, EmulatedLink)>>,
    pub events: Vec<(usize, PeerEvent)>,
    pub now: Duration,
    /// Time of each peer's clock at the test's time zero.
    pub began: Vec<Duration>,
    pub grabs: Vec<Option<u16>>,
    /// Peer, tick and visual coordinates.
    pub seen: Vec<(usize, u64, Vec<f64>)>,
    pub model: Arc<ModalModel>,
    /// A second body, if there is one.
    pub other: Option<Arc<ModalModel>>,
    pub settings: StepSettings,
    pub around: Surroundings,
    pub hold: GrabConfig,
    /// What happens to a datagram on its way. Arguments: sender, receiver, bytes.
    pub tamper: fn(usize, usize, Vec<u8>) -> Vec<u8>,
}

impl Mesh {
    pub fn new(count: usize, link: &LinkConfig, seed: u64) -> Self {
        let reliable = LinkConfig { loss: Loss::None, keep_order: true, ..link.clone() };
        let links = (0..count as u64)
            .map(|a| {
                (0..count as u64)
                    .map(|b| {
                        let s = seed * 1000 + a * 10 + b;
                        (EmulatedLink::new(link.clone(), s), EmulatedLink::new(reliable.clone(), s + 500))
                    })
                    .collect()
            })
            .collect();
        Self {
            peers: (0..count).map(|_| None).collect(),
            links,
            events: Vec::new(),
            now: Duration::ZERO,
            began: vec![Duration::ZERO; count],
            grabs: vec![None; count],
            seen: Vec::new(),
            model: bar(40, 0.05),
            other: None,
            settings: StepSettings::default(),
            around: Surroundings::default(),
            hold: GrabConfig::default(),
            tamper: |_, _, bytes| bytes,
        }
    }

    pub fn start(&mut self, k: usize, repair: LateInputRepair, founds: bool) {
        let user = UserId(k as u16 + 1);
        let config = PeerSessionConfig { user, repair, founds, ..Default::default() };
        let mut peer = PeerSession::new(config).unwrap();
        peer.add_body(BODY, self.model.clone(), &self.settings).unwrap();
        peer.set_surroundings(BODY, self.around.clone()).unwrap();
        if let Some(other) = &self.other {
            peer.add_body(OTHER, other.clone(), &self.settings).unwrap();
            peer.set_surroundings(OTHER, self.around.clone()).unwrap();
        }
        for other in 0..self.peers.len() {
            if let Some(o) = &mut self.peers[other] {
                o.connect(self.began[other] + self.now, PeerId(k as u64), user, 1200).unwrap();
                let number = UserId(other as u16 + 1);
                peer.connect(self.began[k] + self.now, PeerId(other as u64), number, 1200).unwrap();
            }
        }
        self.peers[k] = Some(peer);
    }

    pub fn hand(k: usize, now: Duration) -> [f64; 3] {
        let t = now.as_secs_f64() + k as f64;
        let x = [1.0, 0.5, 0.75, 0.25][k];
        let size = [0.1, 0.04, 0.06, 0.02][k];
        [x, 0.08 + size * (1.1 * t).sin(), 0.08 + size * (0.7 * t).cos()]
    }

    /// Vertices at x = 1, 1/2, 3/4, 1/4 on the edge y = z = 0.08.
    pub(super) const VERTEX: [u32; 4] = [66, 34, 50, 18];

    pub fn run(&mut self, until: Duration) {
        while self.now < until {
            for from in 0..self.peers.len() {
                for to in 0..self.peers.len() {
                    let (datagrams, messages) = &mut self.links[from][to];
                    while let Some(bytes) = messages.poll(self.now) {
                        if let Some(p) = &mut self.peers[to] {
                            p.on_message(self.began[to] + self.now, PeerId(from as u64), &bytes);
                        }
                    }
                    while let Some(bytes) = datagrams.poll(self.now) {
                        if let Some(p) = &mut self.peers[to] {
                            let bytes = (self.tamper)(from, to, bytes.to_vec());
                            p.on_datagram(self.began[to] + self.now, PeerId(from as u64), &bytes);
                        }
                    }
                }
            }
            for (k, slot) in self.peers.iter_mut().enumerate() {
                let Some(p) = slot else { continue };
                if p.tick() > 40 {
                    let target = Self::hand(k, self.now);
                    match self.grabs[k] {
                        None => {
                            self.grabs[k] = p.begin_grab(BODY, Self::VERTEX[k], 0.05, target, self.hold).ok()
                        }
                        Some(g) => p.set_target(g, target).unwrap(),
                    }
                }
                let stepped = p.update(self.began[k] + self.now);
                while let Some(e) = p.poll_event() {
                    self.events.push((k, e));
                }
                if stepped > 0 {
                    let body = p.body(BODY).unwrap();
                    self.seen.push((k, p.tick(), body.visual().q.clone()));
                }
                while let Some(o) = p.poll_output() {
                    let link = &mut self.links[k][o.peer.0 as usize];
                    let link = if o.channel == Channel::Datagram { &mut link.0 } else { &mut link.1 };
                    link.send(self.now, o.bytes.to_vec(), o.bytes.len());
                }
            }
            // Peers update their sessions every 5 ms, as with rendered frames.
            self.now += 5 * MS;
        }
    }

    /// Distance of the centers of mass of the free body at the last tick that two peers have
    /// confirmed, m, and its largest difference in a modal coordinate.
    pub fn other_apart(&self, a: usize, b: usize) -> (f64, f64) {
        let (a, b) = (self.peers[a].as_ref().unwrap(), self.peers[b].as_ref().unwrap());
        let tick = a.confirmed().min(b.confirmed());
        let (x, y) = (a.state_at(OTHER, tick).unwrap(), b.state_at(OTHER, tick).unwrap());
        let (c, d) = (x.frame.center(), y.frame.center());
        let far = (0..3).map(|k| (c[k] - d[k]).powi(2)).sum::<f64>().sqrt();
        (far, x.q.iter().zip(&y.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
    }

    pub fn agree(&self, a: usize, b: usize) -> f64 {
        let (a, b) = (self.peers[a].as_ref().unwrap(), self.peers[b].as_ref().unwrap());
        let tick = a.confirmed().min(b.confirmed());
        let (x, y) = (a.state_at(BODY, tick).unwrap(), b.state_at(BODY, tick).unwrap());
        let size = x.q.iter().map(|q| q * q).sum::<f64>().sqrt();
        x.q.iter().zip(&y.q).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt() / size
    }

    /// Root mean square difference between the visual coordinates and those that peer 0 confirmed
    /// for the same tick, relative to the largest confirmed shape.
    pub fn shown_error(&self, settled: &[(u64, Vec<f64>)]) -> f64 {
        let size =
            settled.iter().map(|(_, q)| q.iter().map(|x| x * x).sum::<f64>().sqrt()).fold(0.0, f64::max);
        let (mut sum, mut count) = (0.0, 0);
        // Skip the first five seconds, because no forecast predicts the start of a grab.
        for (_, tick, q) in self.seen.iter().filter(|s| s.1 > 200) {
            if let Some((_, truth)) = settled.iter().find(|s| s.0 == *tick) {
                sum += q.iter().zip(truth).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
                count += 1;
            }
        }
        assert!(count > 300);
        (sum / f64::from(count)).sqrt() / size
    }
}

/// Connects the peer with the lowest number.
pub fn greeted(p: &mut PeerSession) {
    p.connect(Duration::ZERO, PeerId(1), UserId(1), 1200).unwrap();
    let hello = PeerMessage::Hello {
        version: PROTOCOL_VERSION,
        user: 1,
        name: "first".into(),
        address: String::new(),
        joining: false,
        scene: p.scene(),
    };
    p.on_message(Duration::ZERO, PeerId(1), &hello.encode());
}
