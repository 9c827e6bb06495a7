//! A host that publishes at a relay, and what a watcher sees of it.
#![allow(dead_code, reason = "each test uses its part")]

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bevy::math::{DQuat, DVec3};
use bevy::prelude::*;
use moq_net::Timestamp;
use pliant_body::{BodyState, Grab, GrabOf, PliantTick};
use pliant_modal::ModalModel;
use pliant_net::watch::{PublishOptions, RelayOptions, WatchEvent, Watcher};
use pliant_net::{HostConfig, NetHost};
use pliant_stream::watch::{Catalog, CatalogBody, WatchHands, pieces};
use pliant_stream::{BodyId, Placement};

use super::relay::TestRelay;
use super::support::{TIP, host};

pub const NAME: &str = "lectures/bar";

pub fn options(relay: &TestRelay) -> RelayOptions {
    RelayOptions::new(relay.address(), NAME).with_certificate(&relay.hash).unwrap()
}

/// A host that publishes at a relay, with a hand on its body that goes round.
pub struct Publisher {
    pub app: App,
    pub body: Entity,
    pub hand: Entity,
    began: Instant,
    /// The host's coordinates by tick.
    pub truth: BTreeMap<u64, Vec<f64>>,
}

impl Publisher {
    pub fn start(options: PublishOptions) -> Self {
        let (mut app, _, body) = host(HostConfig::default());
        // The host's session begins with the first frame.
        app.update();
        app.world_mut().resource_mut::<NetHost>().publish_to_watchers(options).unwrap();
        let at = DVec3::Y + DQuat::from_rotation_z(0.5) * (2.0 * DVec3::new(0.9, 0.0, 0.0));
        let hand = app.world_mut().spawn((Grab::new(TIP, 0.3, at), GrabOf(body))).id();
        Self { app, body, hand, began: Instant::now(), truth: BTreeMap::new() }
    }

    pub fn update(&mut self) {
        std::thread::sleep(Duration::from_millis(3));
        let time = self.began.elapsed().as_secs_f64();
        let off = DVec3::new(0.9, 0.2 * (3.0 * time).sin(), 0.15 * (2.0 * time).cos());
        if let Some(mut grab) = self.app.world_mut().get_mut::<Grab>(self.hand) {
            grab.target = DVec3::Y + DQuat::from_rotation_z(0.5) * (2.0 * off);
        }
        self.app.update();
        let tick = self.app.world().resource::<PliantTick>().0;
        let q = self.app.world().get::<BodyState>(self.body).unwrap().body().q().to_vec();
        self.truth.insert(tick, q);
    }
}

/// What a watcher has seen so far.
#[derive(Default)]
pub struct Seen {
    pub catalogs: Vec<Catalog>,
    pub models: BTreeMap<BodyId, Arc<ModalModel>>,
    pub states: Vec<(u64, Vec<f64>)>,
    pub hands: Vec<WatchHands>,
    pub over: u32,
    pub wrong: Vec<String>,
    pub connected: u32,
}

impl Seen {
    pub fn take(&mut self, watcher: &mut Watcher) {
        while let Some(event) = watcher.poll() {
            match event {
                WatchEvent::Relay(connected) => self.connected += u32::from(connected),
                WatchEvent::Catalog(catalog) => self.catalogs.push(catalog),
                WatchEvent::Body(body, model) => drop(self.models.insert(body.id, model)),
                WatchEvent::State(_, state) => self.states.push((state.tick, state.q)),
                WatchEvent::Hands(hands) => self.hands.push(hands),
                WatchEvent::Over => self.over += 1,
                WatchEvent::Wrong(what) => self.wrong.push(what),
                _ => {}
            }
        }
    }
}

/// Largest difference of any vertex between two states, as a share of the body's size.
pub fn off(model: &ModalModel, a: &[f64], b: &[f64]) -> f64 {
    let vertices = model.surface().positions().len() as u32;
    let apart = |v| {
        let [a, b] = [a, b].map(|q| DVec3::from(model.vertex_position(v, q, true).unwrap()));
        a.distance(b)
    };
    (0..vertices).map(apart).fold(0.0, f64::max) / model.size()
}

/// The bar, as a catalog has it.
pub fn entry(model: &ModalModel) -> CatalogBody {
    CatalogBody {
        id: BodyId(1),
        name: "a bar".into(),
        model: model.hash(),
        file_bytes: model.to_bytes().len() as u64,
        surface_bytes: 0,
        modes: 4,
        every: 1,
        warps: true,
        free: false,
        placement: Placement::default(),
        color: [0; 4],
    }
}

pub fn catalog(session: u64, body: CatalogBody) -> Vec<u8> {
    Catalog { session, step: 0.025, name: "lies".into(), bodies: vec![body], cameras: Vec::new() }.encode()
}

/// Publishes a model's file in a track, for as long as what is returned is kept.
pub fn give(track: moq_net::track::Producer, model: &ModalModel) -> moq_net::track::Producer {
    let mut group = track.append_group().unwrap();
    for piece in pieces(&model.to_bytes()) {
        group.write_frame(Timestamp::now(), piece.to_vec()).unwrap();
    }
    group.finish().unwrap();
    track
}
