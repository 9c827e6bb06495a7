//! Peers step a held body of reduced elasticity with the same own shapes of its patches at the same
//! tick.

use std::sync::Arc;
use std::time::Duration;

use pliant_bake::{BakeConfig, Material, bake};
use pliant_mesh::shapes;
use pliant_modal::{
    Body, BodyConfig, Elasticity, GrabConfig, HeldPlace, HeldShapes, ModalModel, Patch, StepSettings,
};
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss, Preset};
use pliant_stream::peer::{PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::{BodyId, Channel, DisconnectReason, PeerId, UserId};

const BODY: BodyId = BodyId(1);
const STEP: f64 = 0.025;
/// Radius of the held patch, m, which is the same in the single precision of the network.
const RADIUS: f64 = 0.0625;

/// A bar of 1 m by 0.1 m by 0.1 m along x, clamped at x = 0.
fn bar() -> Arc<ModalModel> {
    let config = BakeConfig {
        modes: 20,
        material: Some(Material::NeoHookean),
        anchors: vec!["x<1e-9".parse().unwrap()],
        ..Default::default()
    };
    let mesh = shapes::bar([10, 2, 2], [1.0, 0.1, 0.1]).unwrap();
    Arc::new(bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model)
}

fn settings() -> StepSettings {
    StepSettings { elasticity: Elasticity::Reduced, damping_scale: 10.0, ..Default::default() }
}

fn vertex(model: &ModalModel, place: [f32; 3]) -> u32 {
    model.surface().positions().iter().position(|p| *p == place).unwrap() as u32
}

fn norm(x: [f64; 3]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// A hand that leads a vertex by `way` (m) within two seconds, and then holds it there.
#[derive(Clone, Copy)]
struct Pull {
    place: [f32; 3],
    way: [f64; 3],
}

/// By 8 % of the bar's size.
const PULLED: Pull = Pull { place: [1.0, 0.1, 0.1], way: [0.0, 0.06, 0.053] };
const PRESSED: Pull = Pull { place: [0.5, 0.1, 0.05], way: [0.0, -0.08, 0.0] };

impl Pull {
    fn target(&self, seconds: f64) -> [f64; 3] {
        let share = (0.5 * seconds).clamp(0.0, 1.0);
        let share = share * share * (3.0 - 2.0 * share);
        std::array::from_fn(|k| f64::from(self.place[k]) + share * self.way[k])
    }

    /// The reaction of the body stepped alone with shapes that follow the hand, N.
    fn alone(&self, model: &Arc<ModalModel>) -> [f64; 3] {
        let config = BodyConfig { step: STEP, ..settings().into() };
        let mut body = Body::new(model.clone(), config).unwrap();
        let patch = Patch::around(model.surface(), vertex(model, self.place), RADIUS).unwrap();
        let grab = body.grab(&patch, GrabConfig::default()).unwrap();
        for tick in 0..200 {
            body.set_target(grab, self.target(f64::from(tick) * STEP)).unwrap();
            body.make_held_shapes().unwrap();
            body.step().unwrap();
        }
        body.reaction(grab).unwrap()
    }
}

/// Shapes that one application makes in its own time.
#[derive(Default)]
struct Maker {
    takes: Duration,
    list: Vec<(Vec<HeldPlace>, Duration)>,
    made: u64,
}

/// Peers that are all connected with each other on emulated paths.
struct Mesh {
    model: Arc<ModalModel>,
    peers: Vec<Option<PeerSession>>,
    makers: Vec<Maker>,
    /// By sender and receiver: datagrams, and messages.
    links: Vec<Vec<[EmulatedLink; 2]>>,
    /// Shapes are the same at every peer, so that they are made only once.
    sets: Vec<(Vec<HeldPlace>, Option<Arc<HeldShapes>>)>,
    resyncs: usize,
    now: Duration,
}

impl Mesh {
    /// Peers of which the last `joining` do not have a state at first. `takes` is the time in which
    /// each makes a set, and `None` makes none.
    fn new(model: &Arc<ModalModel>, link: LinkConfig, takes: &[Option<f64>]) -> Self {
        let count = takes.len();
        let reliable = LinkConfig { loss: Loss::None, keep_order: true, ..link.clone() };
        let pair = |a: usize, b: usize| {
            let seed = (7 * a + 31 * b) as u64 + 5;
            [EmulatedLink::new(link.clone(), seed), EmulatedLink::new(reliable.clone(), seed ^ 0x51)]
        };
        let mut mesh = Self {
            model: model.clone(),
            peers: (0..count).map(|_| None).collect(),
            makers: takes
                .iter()
                .map(|takes| Maker {
                    takes: takes.map_or(Duration::MAX, Duration::from_secs_f64),
                    ..Maker::default()
                })
                .collect(),
            links: (0..count).map(|a| (0..count).map(|b| pair(a, b)).collect()).collect(),
            sets: Vec::new(),
            resyncs: 0,
            now: Duration::ZERO,
        };
        mesh.start(0, true);
        mesh.start(1, true);
        mesh
    }

    /// Starts a peer, which connects to all that there are.
    fn start(&mut self, index: usize, founds: bool) {
        let user = UserId(index as u16 + 1);
        let config = PeerSessionConfig { user, step: STEP, founds, ..Default::default() };
        let mut peer = PeerSession::new(config).unwrap();
        peer.add_body(BODY, self.model.clone(), &settings()).unwrap();
        for (other, there) in self.peers.iter_mut().enumerate() {
            let Some(there) = there else { continue };
            let user_of_other = UserId(other as u16 + 1);
            peer.connect(self.now, PeerId(other as u64), user_of_other, 1200).unwrap();
            there.connect(self.now, PeerId(index as u64), user, 1200).unwrap();
        }
        self.peers[index] = Some(peer);
    }

    fn leave(&mut self, index: usize) {
        self.peers[index] = None;
        for peer in self.peers.iter_mut().flatten() {
            peer.disconnect(PeerId(index as u64), DisconnectReason::Left);
        }
    }

    fn shapes(&mut self, places: &[HeldPlace]) -> Option<Arc<HeldShapes>> {
        if let Some((_, made)) = self.sets.iter().find(|(of, _)| of == places) {
            return made.clone();
        }
        let made = HeldShapes::of_places(&self.model, places).unwrap().map(Arc::new);
        self.sets.push((places.to_vec(), made.clone()));
        made
    }

    /// Makes the shapes that a peer's application has had the time for.
    fn make(&mut self, k: usize) {
        let Some(peer) = &mut self.peers[k] else { return };
        if self.makers[k].takes == Duration::MAX {
            return;
        }
        let due = peer.shapes_to_make();
        let maker = &mut self.makers[k];
        maker.list.retain(|(places, _)| due.iter().any(|(_, of)| of == places));
        let mut ready = Vec::new();
        for (body, places) in due {
            match maker.list.iter().find(|(of, _)| *of == places) {
                Some((_, at)) if self.now >= *at => ready.push((body, places)),
                Some(_) => {}
                None => maker.list.push((places, self.now + maker.takes)),
            }
        }
        for (body, places) in ready {
            let made = self.shapes(&places);
            self.makers[k].made += 1;
            let Some(peer) = &mut self.peers[k] else { return };
            peer.take_shapes(body, &places, made);
        }
    }

    fn run(&mut self, seconds: f64, mut act: impl FnMut(usize, f64, &mut PeerSession)) {
        let until = self.now + Duration::from_secs_f64(seconds);
        while self.now < until {
            for k in 0..self.peers.len() {
                let now = self.now;
                let Some(peer) = &mut self.peers[k] else { continue };
                for (from, links) in self.links.iter_mut().enumerate() {
                    let from = PeerId(from as u64);
                    while let Some(bytes) = links[k][1].poll(now) {
                        peer.on_message(now, from, &bytes);
                    }
                    while let Some(bytes) = links[k][0].poll(now) {
                        peer.on_datagram(now, from, &bytes);
                    }
                }
                act(k, now.as_secs_f64(), peer);
                peer.update(now);
                self.make(k);
                let Some(peer) = &mut self.peers[k] else { continue };
                while let Some(event) = peer.poll_event() {
                    self.resyncs += usize::from(matches!(event, PeerEvent::Resynced { .. }));
                }
                while let Some(out) = peer.poll_output() {
                    let channel = usize::from(out.channel == Channel::Message);
                    let link = &mut self.links[k][out.peer.0 as usize][channel];
                    link.send(now, out.bytes.to_vec(), out.bytes.len());
                }
            }
            self.now += Duration::from_millis(5);
        }
    }

    fn peer(&self, index: usize) -> &PeerSession {
        self.peers[index].as_ref().unwrap()
    }

    fn columns(&self, index: usize) -> usize {
        self.peer(index).body(BODY).unwrap().held_shapes().map_or(0, |(_, s)| s.len())
    }

    /// What a peer's copy says that the first hand feels, N.
    fn felt(&self, index: usize) -> [f64; 3] {
        self.peer(index).body(BODY).unwrap().grabs()[0].reaction
    }

    /// Largest difference of the coordinates of two peers at the newest tick that both have
    /// settled, beside the largest coordinate.
    fn apart(&self, [a, b]: [usize; 2]) -> f64 {
        let [a, b] = [self.peer(a), self.peer(b)];
        let tick = a.confirmed().min(b.confirmed()) - 1;
        let [a, b] = [a, b].map(|peer| peer.state_at(BODY, tick).unwrap());
        let size = a.q.iter().fold(0.0f64, |most, q| most.max(q.abs()));
        a.q.iter().zip(&b.q).fold(0.0f64, |most, (a, b)| most.max((a - b).abs())) / size
    }
}

/// The second peer takes hold and pulls from 1 s on.
fn holds(pull: Pull, model: &Arc<ModalModel>) -> impl FnMut(usize, f64, &mut PeerSession) + use<> {
    let (vertex, mut grab) = (vertex(model, pull.place), None);
    move |k, t, peer| {
        if k != 1 || t < 1.0 {
            return;
        }
        let target = pull.target(t - 1.0);
        match grab {
            None => grab = peer.begin_grab(BODY, vertex, RADIUS, target, GrabConfig::default()).ok(),
            Some(grab) => peer.set_target(grab, target).unwrap(),
        }
    }
}

#[test]
fn a_peers_hand_feels_what_the_body_with_shapes_does() {
    let model = bar();
    for (name, pull) in [("pulled", PULLED), ("pressed", PRESSED)] {
        let right = pull.alone(&model);
        for preset in [Preset::Lan, Preset::Paper1] {
            let [without, with] = [None, Some(0.4)].map(|takes| {
                let mut mesh =
                    Mesh::new(&model, LinkConfig::preset(preset), &[takes, takes.map(|t| 1.5 * t)]);
                mesh.run(9.0, holds(pull, &model));
                let both = [0, 1].map(|k| {
                    let felt = mesh.felt(k);
                    norm(std::array::from_fn(|x| felt[x] - right[x])) / norm(right)
                });
                (both, mesh)
            });
            let ([_, off], [at_first, at_second]) = (without.0, with.0);
            let mesh = &with.1;
            let apart = mesh.apart([0, 1]);
            println!(
                "{name}, {}: {:.2} N; the force is off by {:.2} % without shapes, with them by {:.2} % at \
                 the hand's peer and {:.2} % at the other; {} columns, {} sets, {} resyncs, apart {apart:.1e}",
                preset.name(),
                norm(right),
                100.0 * off,
                100.0 * at_second,
                100.0 * at_first,
                mesh.columns(1),
                mesh.makers[1].made,
                mesh.resyncs
            );
            assert!(mesh.columns(0) > 0 && mesh.columns(0) == mesh.columns(1));
            assert!(at_second < 0.02 && at_first < 0.02, "{at_first} {at_second}");
            assert!(at_second < 0.5 * off, "{at_second} beside {off}");
            assert!(apart < 1e-9, "{apart}");
            assert_eq!(mesh.resyncs, 0);
        }
    }
}

#[test]
fn peers_that_join_or_make_late_take_the_same_shapes() {
    let model = bar();
    let right = PULLED.alone(&model);
    let off = |mesh: &Mesh, k: usize| {
        let felt = mesh.felt(k);
        norm(std::array::from_fn(|x| felt[x] - right[x])) / norm(right)
    };
    // The third peer is slower than what can be stepped again, and takes a state.
    for (name, takes) in [("one second", 1.0), ("five seconds", 5.0)] {
        let link = LinkConfig::preset(Preset::Transatlantic);
        let mut mesh = Mesh::new(&model, link, &[Some(0.4), Some(0.3), Some(takes)]);
        let mut hand = holds(PULLED, &model);
        mesh.run(6.0, &mut hand);
        mesh.start(2, false);
        mesh.run(0.9, &mut hand);
        let before = (mesh.columns(2), off(&mesh, 2));
        mesh.run(9.0, &mut hand);
        let apart = mesh.apart([0, 2]);
        println!(
            "who joins makes shapes in {name}: at first {} columns and off by {:.2} %, then {} and {:.2} %, \
             {} resyncs, apart {apart:.1e}",
            before.0,
            100.0 * before.1,
            mesh.columns(2),
            100.0 * off(&mesh, 2),
            mesh.resyncs
        );
        assert!(before.0 == 0 && mesh.columns(2) == mesh.columns(0) && mesh.columns(0) > 0);
        assert!(off(&mesh, 2) < 0.02 && apart < 1e-9, "{apart}");
        assert!(mesh.resyncs <= 3, "{}", mesh.resyncs);
        // The first peer leaves, and the next one decides.
        mesh.leave(0);
        let back = Pull { way: [0.0, -0.06, 0.03], ..PULLED };
        let (start, mut grab) = (mesh.now.as_secs_f64(), None);
        let vertex = vertex(&model, back.place);
        mesh.run(15.0, |k, t, peer| {
            if k != 2 {
                return;
            }
            let target = back.target(t - start);
            match grab {
                None => grab = peer.begin_grab(BODY, vertex, 0.03125, target, GrabConfig::default()).ok(),
                Some(grab) => peer.set_target(grab, target).unwrap(),
            }
        });
        let of_both = mesh.peer(1).body(BODY).unwrap().held_shapes().map(|(of, _)| of.places().len());
        let apart = mesh.apart([1, 2]);
        println!("after the first one has left: shapes of {of_both:?} patches, apart {apart:.1e}");
        assert!(of_both == Some(2) && mesh.columns(1) == mesh.columns(2));
        assert!(apart < 1e-9, "{apart}");
    }
}

#[test]
fn a_peer_that_asks_for_shapes_all_day_harms_nobody() {
    let model = bar();
    let link = LinkConfig::preset(Preset::Lan);
    let mut mesh = Mesh::new(&model, link, &[Some(0.0), Some(0.0)]);
    let corner = vertex(&model, PULLED.place);
    // The first peer's number is the lowest, so that it is believed. It tells of new places in each
    // tick, for ticks long gone, just gone and to come, and of places that are none.
    let mut most = 0.0f64;
    let mut asked = 0_u64;
    let mut hand = holds(PULLED, &model);
    for round in 0..1_200_u32 {
        mesh.run(0.025, &mut hand);
        let tick = mesh.peer(1).tick();
        let now = mesh.now;
        let way = f64::from(round) * 1e-5;
        let sound = HeldPlace { vertex: corner, radius: RADIUS, displacement: [0.0, 0.01 + way, 0.0] };
        let peer = mesh.peers[1].as_mut().unwrap();
        for (from, place) in [
            (0, sound),
            (tick + 3, sound),
            (tick.saturating_sub(20), sound),
            (tick + 100_000, sound),
            (tick + 5, HeldPlace { vertex: 1 << 30, ..sound }),
            (tick + 5, HeldPlace { radius: 50.0, ..sound }),
            (tick + 5, HeldPlace { displacement: [9.0, 0.0, 0.0], ..sound }),
        ] {
            let message = pliant_stream::wire::PeerMessage::Shapes { body: 1, from, places: vec![place] };
            peer.on_message(now, PeerId(0), &message.encode());
            asked += 1;
        }
        // The hand comes after a second.
        if round > 60 {
            most = most.max(norm(mesh.felt(1)));
        }
    }
    let made = mesh.makers[1].made;
    let restepped = mesh.peer(1).body(BODY).unwrap().restepped();
    println!("{asked} requests: {made} sets made, {restepped} ticks stepped again, {most:.2} N at most");
    // Eight at once, and one a second.
    assert!(made <= 8 + 31, "{made}");
    assert!(restepped < 60_000, "{restepped}");
    let body = mesh.peer(1).body(BODY).unwrap();
    assert!(body.visual().is_finite() && most < 20.0, "{most}");
    assert!(mesh.peer(1).tick() > 1_100, "it goes on: {}", mesh.peer(1).tick());
}
