//! The fuzz targets: any bytes through every parser that takes bytes from outside, and through
//! whole sessions. A target panics when something is wrong.
//!
//! cargo-fuzz runs them with libFuzzer, and the test `fuzz` of `pliant_lab` with a stable compiler.

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use pliant_haptics::Replay;
use pliant_mesh::io;
use pliant_modal::{
    BakeInfo, Body, BodyConfig, Damping, Element, FixedObstacle, FixedShape, GrabConfig, ModalModel,
    ModelParts, Plane, SavedBody, SurfaceMesh,
};
use pliant_stream::emulator::{Loss, PathTrace};
use pliant_stream::peer::{PeerSession, PeerSessionConfig};
use pliant_stream::watch::{BodyDecoder, Catalog, WatchHands, WatchSurface};
use pliant_stream::wire::{Datagram, GuestMessage, HostMessage, PeerMessage};
use pliant_stream::{
    BodyId, Channel, GrabState, GuestSession, GuestSessionConfig, HostEvent, HostSession, HostSessionConfig,
    PeerId, RecoveryConfig, RigidId, RigidState, StepSettings, Surroundings, TickState, UserId,
};

/// All targets by name.
pub const TARGETS: [(&str, fn(&[u8])); 12] = [
    ("datagrams", datagrams),
    ("messages", messages),
    ("peers", peers),
    ("traces", traces),
    ("model", model_file),
    ("meshes", meshes),
    ("device", device),
    ("saved", saved),
    ("session", session),
    ("guests", guests),
    ("mesh", mesh),
    ("watch", watch),
];

const BODY: BodyId = BodyId(1);
const LOOSE: BodyId = BodyId(2);
const MOVES: RigidId = RigidId(1);
const RESTS: RigidId = RigidId(2);
/// Formats of meshes and scenes, by their endings.
pub const FORMATS: [&str; 10] = ["obj", "stl", "ply", "gltf", "glb", "msh", "vtk", "mesh", "veg", "ron"];

/// Datagrams of hosts, guests and peers. A datagram that was read must be writable and read back
/// equal.
pub fn datagrams(bytes: &[u8]) {
    if let Ok((sequence, datagram)) = Datagram::decode(bytes) {
        let again = Datagram::decode(&datagram.encode(sequence));
        match &datagram {
            // Reading normalizes a rotation to a unit quaternion, so its last bit may differ the
            // second time.
            Datagram::Frame(frame) if frame.pose.is_some() => assert!(again.is_ok()),
            Datagram::Rigids(_) => assert!(again.is_ok()),
            _ => assert_eq!(again, Ok((sequence, datagram))),
        }
    }
}

/// Reliable messages of both directions, including snapshots.
pub fn messages(bytes: &[u8]) {
    if let Ok(message) = GuestMessage::decode(bytes) {
        assert_eq!(GuestMessage::decode(&message.encode()), Ok(message));
    }
    if let Ok(message) = HostMessage::decode(bytes) {
        assert_eq!(HostMessage::decode(&message.encode()), Ok(message));
    }
}

/// Messages between equal peers.
pub fn peers(bytes: &[u8]) {
    if let Ok(message) = PeerMessage::decode(bytes) {
        assert_eq!(PeerMessage::decode(&message.encode()), Ok(message));
    }
}

/// What watchers get of a relay: catalogs, hands and surfaces, and frames of a body, each behind a
/// byte with its length. What was read must be writable and read back equal.
pub fn watch(bytes: &[u8]) {
    if let Ok(catalog) = Catalog::decode(bytes) {
        assert_eq!(Catalog::decode(&catalog.encode()), Ok(catalog));
    }
    if let Ok(hands) = WatchHands::decode(bytes) {
        assert!(WatchHands::decode(&hands.encode()).is_ok());
    }
    if let Ok(surface) = WatchSurface::decode(bytes) {
        assert_eq!(WatchSurface::decode(&surface.encode()), Ok(surface));
    }
    let mut decoder = BodyDecoder::new(vec![1.0; 8]);
    let mut rest = bytes;
    while let Some((&length, behind)) = rest.split_first() {
        let (frame, behind) = behind.split_at(usize::from(length).min(behind.len()));
        rest = behind;
        if let Ok((_, state)) = decoder.decode(frame) {
            assert!(state.q.iter().all(|q| q.is_finite()));
            assert!(state.pose.is_none_or(|pose| pose.is_valid()));
        }
    }
}

/// Recorded networks and loss models in text form.
pub fn traces(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let _ = PathTrace::parse(text);
    let _ = Loss::parse(text, 1, Duration::from_millis(25));
}

/// `.modal` files. A model that was read must be writable and readable with the same hash.
pub fn model_file(bytes: &[u8]) {
    if let Ok(model) = ModalModel::from_bytes(bytes) {
        let again = ModalModel::from_bytes(&model.to_bytes());
        assert_eq!(again.map(|m| m.hash()).ok(), Some(model.hash()));
    }
}

/// A temporary folder of a thread, which goes with it.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Self {
        let name = format!("pliant-fuzz-{}-{:?}", std::process::id(), std::thread::current().id());
        let folder = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&folder).expect("a temporary folder");
        Self(folder)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // What is left is in the system's folder for temporary files.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Meshes and scenes of all formats. The first byte chooses the format.
pub fn meshes(bytes: &[u8]) {
    let Some((first, rest)) = bytes.split_first() else { return };
    let ending = FORMATS[usize::from(*first) % FORMATS.len()];
    thread_local! {
        // Readers take a file, since some formats name others beside them.
        static FOLDER: Folder = Folder::new();
    }
    let path = FOLDER.with(|folder| folder.0.join(format!("any.{ending}")));
    std::fs::write(&path, rest).expect("a temporary file");
    let _ = io::read(&path);
    let _ = io::read_painted(&path, &["_STIFFNESS", "_DENSITY", "_ANCHOR"]);
}

/// Recordings of devices. Their samples must be finite.
pub fn device(bytes: &[u8]) {
    if let Ok(replay) = Replay::read(bytes) {
        assert!(replay.records().iter().all(|record| record.sample.position.iter().all(|x| x.is_finite())));
    }
}

/// Bodies of saved games. One that was taken must go on, with finite numbers, and be saved again.
pub fn saved(bytes: &[u8]) {
    let Some(mut body) = restored(bytes) else { return };
    body.set_obstacles(ground()).expect("sound");
    for _ in 0..4 {
        if body.step().is_err() {
            break;
        }
    }
    let state = body.state();
    let numbers = [&state.q, &state.v, &state.a, &state.z, &state.s];
    assert!(numbers.into_iter().flatten().all(|x| x.is_finite()));
    assert!(body.contacts().contacts().iter().flat_map(|contact| contact.force).all(f64::is_finite));
    body.save(|_| true);
}

/// The body of a saved game, if it is sound.
pub fn restored(bytes: &[u8]) -> Option<Body> {
    let saved = postcard::from_bytes::<SavedBody>(bytes).ok()?;
    Body::restore(loose(), BodyConfig::default(), &saved, None).ok().map(|(body, _)| body)
}

/// A body that lies on the ground, after some steps, held at so many vertices by hands that move.
pub fn saved_body(hands: u32, hold: GrabConfig, steps: u32) -> SavedBody {
    let (settings, _) = falls();
    let config = BodyConfig { settings, ..BodyConfig::default() };
    let mut body = Body::new(loose(), config).expect("sound");
    body.set_obstacles(ground()).expect("sound");
    let patch = |vertex| pliant_modal::Patch::around(body.model().surface(), vertex, 0.1).expect("sound");
    let patches: Vec<_> = (0..hands).map(|hand| patch(3 - hand)).collect();
    let grabs: Vec<_> = patches.iter().map(|patch| body.grab(patch, hold).expect("room")).collect();
    for step in 0..steps {
        for grab in &grabs {
            let mut target = body.target(*grab).expect("held");
            target[1] += 0.01 * f64::from(step % 7);
            body.set_target(*grab, target).expect("held");
        }
        body.step().expect("sound");
    }
    body.save(|_| true)
}

fn ground() -> Vec<Arc<dyn pliant_modal::ObstacleShape>> {
    vec![Arc::new(Plane::GROUND)]
}

/// A tetrahedron with two invented modes, held at a vertex.
fn model() -> Arc<ModalModel> {
    static MODEL: OnceLock<Arc<ModalModel>> = OnceLock::new();
    MODEL.get_or_init(|| tetrahedron(false)).clone()
}

/// The same, free.
fn loose() -> Arc<ModalModel> {
    static MODEL: OnceLock<Arc<ModalModel>> = OnceLock::new();
    MODEL.get_or_init(|| tetrahedron(true)).clone()
}

/// How the free body is stepped, and the floor under it.
fn falls() -> (StepSettings, Surroundings) {
    let ground = FixedObstacle { position: [0.0, -0.1, 0.0], ..FixedObstacle::GROUND };
    let ball = FixedObstacle { shape: FixedShape::Ball { radius: 0.2 }, ..ground };
    let around = Surroundings { obstacles: vec![ground, ball], ..Surroundings::default() };
    (StepSettings { gravity: [0.0, -9.81, 0.0], ..StepSettings::default() }, around)
}

fn tetrahedron(free: bool) -> Arc<ModalModel> {
    let positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0_f32]];
    let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3_u32]];
    let surface =
        SurfaceMesh::new(positions, triangles, None, vec![!free, false, false, false]).expect("sound");
    let omega = vec![10.0, 30.0];
    let damping = Damping::Ratio(0.05);
    let parts = ModelParts {
        info: BakeInfo {
            name: "fuzz".into(),
            tets: 1,
            nodes: 4,
            element: Element::Tet4,
            young: 1e5,
            poisson: 0.3,
            density: 1000.0,
            damping,
            anchors: if free { Vec::new() } else { vec!["x<0.01".into()] },
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface,
        damping: omega.iter().map(|w| damping.coefficient(*w)).collect(),
        participation: vec![[0.0; 3]; 2],
        omega,
        displacement: (0..24).map(|k| 0.1 * k as f32).collect(),
        rotation: (0..24).map(|k| 0.05 * k as f32).collect(),
        free,
        mass: 1.0,
        center_of_mass: [0.25; 3],
        inertia: [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]],
        sites: Vec::new(),
        reduced: None,
    };
    Arc::new(ModalModel::from_parts(parts).expect("sound"))
}

fn recovery(byte: u8) -> RecoveryConfig {
    match byte % 3 {
        0 => RecoveryConfig::default(),
        1 => RecoveryConfig::paper(),
        _ => RecoveryConfig::none(),
    }
}

/// A host and one guest that receive arbitrary bytes between valid data.
pub fn session(bytes: &[u8]) {
    let mut star = Star::new(1, bytes.first().copied().unwrap_or(0));
    let mut chunks = bytes.chunks(97);
    for _ in 1..40 {
        star.tick(0);
        if let Some(chunk) = chunks.next() {
            let now = star.now;
            star.guests[0].on_datagram(now, chunk);
            star.host.on_datagram(now, PeerId(1), chunk);
        }
        star.check();
    }
}

/// A host with its guests. What one sends arrives at once, or not at all.
struct Star {
    host: HostSession,
    guests: Vec<GuestSession>,
    now: Duration,
    tick: u64,
    held: Vec<GrabState>,
}

impl Star {
    fn new(count: u64, first: u8) -> Self {
        let mut host = HostSession::new(HostSessionConfig::default()).expect("sound");
        host.add_body(BODY, "fuzz", model(), StepSettings::default()).expect("sound");
        let (settings, around) = falls();
        host.add_body(LOOSE, "loose", loose(), settings).expect("sound");
        host.set_surroundings(LOOSE, around).expect("sound");
        for (rigid, name) in [(MOVES, "moves"), (RESTS, "rests")] {
            host.add_rigid(rigid, name, RigidState::default()).expect("sound");
        }
        let now = Duration::ZERO;
        let guest = |k: u64| {
            let recovery = recovery(first.wrapping_add(k as u8));
            let config = GuestSessionConfig { recovery, ..Default::default() };
            let mut guest = GuestSession::new(config, 1200).expect("sound");
            guest.add_cached_model(model());
            guest.add_cached_model(loose());
            guest.connect(now).expect("sound");
            guest
        };
        let guests = (0..count).map(guest).collect();
        (1..=count).for_each(|peer| host.connect(now, PeerId(peer), 1200).expect("room"));
        Self { host, guests, now, tick: 0, held: Vec::new() }
    }

    /// Steps and exchanges. Bit `k` of `lost` loses the datagrams to guest `k`, and bit `k + 4`
    /// those from it.
    fn tick(&mut self, lost: u8) {
        self.now += Duration::from_millis(25);
        self.tick += 1;
        let t = self.tick as f64;
        let (q, v) = ([0.01 * (0.1 * t).sin(), 0.002], [0.04 * (0.1 * t).cos(), 0.0]);
        let tick = self.tick;
        let grabs = &self.held;
        let state = TickState { tick, q: &q, v: &v, a: &v, z: &[], pose: None, grabs, resting: false };
        self.host.publish(self.now, BODY, &state).expect("sound");
        let position = [0.0, 0.1 * (0.2 * t).sin(), 0.0];
        let pose = Some(RigidState { position, ..RigidState::default() });
        let state = TickState { pose, grabs: &[], ..state };
        self.host.publish(self.now, LOOSE, &state).expect("sound");
        let moves = RigidState { position, ..RigidState::default() };
        let rigids = [(MOVES, moves), (RESTS, RigidState::default())];
        self.host.publish_rigids(self.now, tick, &rigids).expect("sound");
        for _ in 0..2 {
            self.exchange(lost);
        }
    }

    fn exchange(&mut self, lost: u8) {
        let now = self.now;
        self.host.update(now);
        while let Some(event) = self.host.poll_event() {
            match event {
                HostEvent::GrabBegan { key, vertex, radius, target, hold, .. } => {
                    let grab = GrabState { key, vertex, radius, target, reaction: [0.1, 0.0, -0.2], hold };
                    self.held.push(grab);
                }
                HostEvent::GrabMoved { key, target, .. } => {
                    assert!(target.iter().all(|x| x.is_finite()));
                    self.held.iter_mut().filter(|grab| grab.key == key).for_each(|grab| grab.target = target);
                }
                HostEvent::GrabEnded { key, .. } => self.held.retain(|grab| grab.key != key),
                _ => {}
            }
        }
        for (k, guest) in self.guests.iter_mut().enumerate() {
            guest.update(now);
            while let Some(out) = guest.poll_output() {
                match out.channel {
                    Channel::Datagram if lost & (16 << k) != 0 => {}
                    Channel::Datagram => self.host.on_datagram(now, PeerId(k as u64 + 1), &out.bytes),
                    Channel::Message => self.host.on_message(now, PeerId(k as u64 + 1), &out.bytes),
                }
            }
        }
        let mut sent = 0;
        while let Some(out) = self.host.poll_output() {
            sent += 1;
            let k = out.peer.0 as usize - 1;
            let Some(guest) = self.guests.get_mut(k) else { continue };
            match out.channel {
                Channel::Datagram if lost & (1 << k) != 0 => {}
                Channel::Datagram => guest.on_datagram(now, &out.bytes),
                Channel::Message => guest.on_message(now, &out.bytes),
            }
        }
        assert!(sent < 10_000, "{sent} outputs at once");
    }

    fn check(&mut self) {
        for guest in &mut self.guests {
            while guest.poll_event().is_some() {}
            let user = guest.user();
            assert!(guest.bodies().all(|view| view.visual().is_none_or(|shown| shown.is_finite())));
            assert!(guest.rigids().all(|rigid| rigid.visual().is_valid()));
            let Some(view) = guest.body(BODY) else { continue };
            for grab in 0..4 {
                let reaction = user.and_then(|user| view.hand_reaction(user, grab));
                assert!(reaction.is_none_or(|reaction| reaction.iter().all(|x| x.is_finite())));
            }
        }
        assert!(self.host.users().count() <= self.guests.len() && self.held.len() <= 16 * self.guests.len());
    }
}

/// Reads bytes as what happens in a session.
struct Script<'a>(&'a [u8]);

impl Script<'_> {
    fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    fn take(&mut self) -> &[u8] {
        let count = usize::from(self.byte().unwrap_or(0)).min(self.0.len());
        let (taken, rest) = self.0.split_at(count);
        self.0 = rest;
        taken
    }

    fn target(&mut self) -> [f64; 3] {
        std::array::from_fn(|_| (f64::from(self.byte().unwrap_or(128)) - 128.0) * 0.02)
    }
}

/// A host with two guests: grabs, messages and datagrams of theirs, losses and pauses, in any
/// order.
pub fn guests(bytes: &[u8]) {
    let mut script = Script(bytes);
    let mut star = Star::new(2, script.byte().unwrap_or(0));
    (0..8).for_each(|_| star.tick(0));
    let mut looks = 0;
    while let Some(what) = script.byte() {
        let k = usize::from(what >> 7);
        let now = star.now;
        match what & 15 {
            0..=5 => star.tick(what >> 4 & 3 | (what >> 2 & 3) << 4),
            6 | 7 => {
                let vertex = u32::from(script.byte().unwrap_or(0) % 5);
                let target = script.target();
                let hold = GrabConfig { stiffness: (what & 1 > 0).then_some(50.0), relaxation: 0.0 };
                let _ = star.guests[k].begin_grab(now, BODY, vertex, 0.5, target, hold);
            }
            8 | 9 => {
                let grab = u16::from(script.byte().unwrap_or(0) % 4);
                let target = script.target();
                let _ = star.guests[k].set_target(grab, target);
            }
            10 => star.guests[k].end_grab(u16::from(script.byte().unwrap_or(0) % 4)),
            11 => star.host.on_datagram(now, PeerId(k as u64 + 1), script.take()),
            12 => star.host.on_message(now, PeerId(k as u64 + 1), script.take()),
            13 => star.guests[k].on_datagram(now, script.take()),
            14 => star.guests[k].on_message(now, script.take()),
            _ => star.now += Duration::from_millis(10 * u64::from(script.byte().unwrap_or(0))),
        }
        star.exchange(0);
        star.check();
        looks += 1;
        if looks > 400 {
            break;
        }
    }
}

/// Three peers: grabs, messages and datagrams of theirs, losses and pauses, in any order.
pub fn mesh(bytes: &[u8]) {
    let mut script = Script(bytes);
    let mut now = Duration::ZERO;
    let mut all: Vec<PeerSession> = (0..3_u16)
        .map(|k| {
            let config = PeerSessionConfig { user: UserId(k + 1), ..Default::default() };
            let mut peer = PeerSession::new(config).expect("sound");
            peer.add_body(BODY, model(), &StepSettings::default()).expect("sound");
            let (settings, around) = falls();
            peer.add_body(LOOSE, loose(), &settings).expect("sound");
            peer.set_surroundings(LOOSE, around).expect("sound");
            for other in (0..3).filter(|other| *other != k) {
                peer.connect(now, PeerId(u64::from(other)), UserId(other + 1), 1200).expect("room");
            }
            peer
        })
        .collect();
    (0..4).for_each(|_| pass(&mut all, now, 0));
    let mut looks = 0;
    while let Some(what) = script.byte() {
        let (k, from) = (usize::from(what >> 6) % 3, PeerId(u64::from(what >> 4 & 3)));
        match what & 15 {
            0..=5 => {
                now += Duration::from_millis(25);
                pass(&mut all, now, what >> 4);
            }
            6 | 7 => {
                let vertex = u32::from(script.byte().unwrap_or(0) % 5);
                let target = script.target();
                let hold = GrabConfig { stiffness: (what & 1 > 0).then_some(50.0), relaxation: 0.0 };
                let _ = all[k].begin_grab(BODY, vertex, 0.5, target, hold);
            }
            8 | 9 => {
                let grab = u16::from(script.byte().unwrap_or(0) % 4);
                let target = script.target();
                let _ = all[k].set_target(grab, target);
            }
            10 => all[k].end_grab(u16::from(script.byte().unwrap_or(0) % 4)),
            11 | 12 => all[k].on_datagram(now, from, script.take()),
            13 => all[k].on_message(now, from, script.take()),
            14 => all[k].disconnect(from, pliant_stream::DisconnectReason::Lost),
            _ => now += Duration::from_millis(10 * u64::from(script.byte().unwrap_or(0))),
        }
        pass(&mut all, now, 0);
        for peer in &mut all {
            while peer.poll_event().is_some() {}
            let Some(body) = peer.body(BODY) else { continue };
            assert!(body.visual().is_finite() && body.live().is_finite());
            assert!(body.grabs().iter().all(|grab| grab.reaction.iter().all(|x| x.is_finite())));
        }
        looks += 1;
        if looks > 400 {
            break;
        }
    }
}

/// Bit `k` of `lost` loses the datagrams of peer `k`.
fn pass(all: &mut [PeerSession], now: Duration, lost: u8) {
    for from in 0..all.len() {
        let before = all[from].tick();
        all[from].update(now);
        assert!(all[from].tick() <= before + 8, "no more steps in an update");
        while let Some(out) = all[from].poll_output() {
            let to = out.peer.0 as usize;
            match out.channel {
                Channel::Datagram if lost & (1 << from) != 0 => {}
                Channel::Datagram => all[to].on_datagram(now, PeerId(from as u64), &out.bytes),
                Channel::Message => all[to].on_message(now, PeerId(from as u64), &out.bytes),
            }
        }
    }
}
