//! A host with one body that its guests may grab, connected to them by emulated paths.
#![allow(dead_code, reason = "each test uses its part")]

use std::sync::Arc;
use std::time::Duration;

use pliant_lab::pair::{Pair, PathConfig, World};
use pliant_modal::{Body, BodyConfig, GrabConfig, GrabId, ModalModel, Patch};
use pliant_stream::emulator::{LinkConfig, Loss, Preset};
use pliant_stream::{
    BodyId, GrabKey, GrabState, GuestEvent, GuestSession, HostEvent, HostSession, HostSessionConfig,
    RigidState, StepSettings, TickState,
};

pub const BODY: BodyId = BodyId(3);
pub const S: Duration = Duration::from_secs(1);
pub const MS: Duration = Duration::from_millis(1);

/// Script of the guests' hands. Arguments: time, guest, session.
pub type HandScript = Box<dyn FnMut(Duration, usize, &mut GuestSession)>;

/// A host with one body that its guests may grab. The scene keeps every event.
pub struct Scene {
    pub body: Body,
    pub grabs: Vec<(GrabKey, GrabId, u32, f64, GrabConfig)>,
    pub truth: Vec<(u64, Vec<f64>)>,
    pub host_events: Vec<HostEvent>,
    pub guest_events: Vec<(usize, GuestEvent)>,
    /// Script of the guests' hands.
    pub hand: HandScript,
    pub resting: bool,
    /// A force on a vertex that the stream does not contain, N.
    pub wind: [f64; 3],
    pub worst: f64,
    pub settled: Duration,
    /// The rigid pose at each tick, if the body is free.
    pub poses: Vec<(u64, RigidState)>,
    /// The reaction of each hand at each tick, N.
    pub reactions: Vec<(u64, GrabKey, [f64; 3])>,
}

impl Scene {
    pub fn new(model: &Arc<ModalModel>) -> Self {
        Self::with(model, &StepSettings::default())
    }

    pub fn with(model: &Arc<ModalModel>, settings: &StepSettings) -> Self {
        let config = BodyConfig { step: 1.0 / 40.0, settings: *settings, ..Default::default() };
        Self {
            body: Body::new(model.clone(), config).unwrap(),
            grabs: Vec::new(),
            truth: Vec::new(),
            host_events: Vec::new(),
            guest_events: Vec::new(),
            hand: Box::new(|_, _, _| {}),
            resting: false,
            wind: [0.0; 3],
            worst: 0.0,
            settled: Duration::MAX,
            poses: Vec::new(),
            reactions: Vec::new(),
        }
    }

    pub fn saw(&self, guest: usize, want: impl Fn(&GuestEvent) -> bool) -> bool {
        self.guest_events.iter().any(|(g, e)| *g == guest && want(e))
    }

    pub fn error(&self, session: &GuestSession) -> f64 {
        let view = session.body(BODY).unwrap();
        let (_, truth) = self.truth.iter().rev().find(|t| t.0 == view.tick()).expect("a tick of the host");
        let shown = &view.visual().unwrap().q;
        truth.iter().zip(shown).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }

    pub fn size(&self) -> f64 {
        self.truth.iter().map(|(_, q)| q.iter().map(|x| x * x).sum::<f64>().sqrt()).fold(0.0, f64::max)
    }
}

impl World for Scene {
    fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
        if !self.resting {
            self.body.push(40, self.wind).unwrap();
            self.body.step().unwrap();
        }
        let grabs: Vec<GrabState> = self
            .grabs
            .iter()
            .map(|(key, id, vertex, radius, hold)| GrabState {
                key: *key,
                vertex: *vertex,
                radius: *radius,
                target: self.body.target(*id).unwrap(),
                reaction: self.body.reaction(*id).unwrap(),
                hold: *hold,
            })
            .collect();
        self.reactions.extend(grabs.iter().map(|g| (tick, g.key, g.reaction)));
        let pose = self.body.model().is_free().then(|| RigidState::of(&self.body));
        self.poses.extend(pose.map(|pose| (tick, pose)));
        self.truth.push((tick, self.body.q().to_vec()));
        let (q, v, a) = (self.body.q(), self.body.v(), self.body.a());
        let state = TickState { tick, q, v, a, z: self.body.z(), pose, grabs: &grabs, resting: self.resting };
        host.publish(now, BODY, &state).unwrap();
    }

    fn host_event(&mut self, _now: Duration, event: HostEvent, _host: &mut HostSession) {
        match &event {
            HostEvent::GrabBegan { key, vertex, radius, target, hold, .. } => {
                let patch = Patch::around(self.body.model().surface(), *vertex, *radius).unwrap();
                let id = self.body.grab(&patch, *hold).unwrap();
                self.body.set_target(id, *target).unwrap();
                self.grabs.push((*key, id, *vertex, *radius, *hold));
            }
            HostEvent::GrabMoved { key, target, .. } => {
                if let Some(g) = self.grabs.iter().find(|g| g.0 == *key) {
                    self.body.set_target(g.1, *target).unwrap();
                }
            }
            HostEvent::Impulse { vertex, impulse, .. } => {
                self.body.apply_impulse(*vertex, *impulse).unwrap();
            }
            HostEvent::GrabEnded { key, .. } => {
                self.grabs.retain(|g| {
                    if g.0 == *key {
                        self.body.release(g.1);
                    }
                    g.0 != *key
                });
            }
            _ => {}
        }
        self.host_events.push(event);
    }

    fn guest_event(&mut self, _now: Duration, guest: usize, event: GuestEvent, _s: &mut GuestSession) {
        self.guest_events.push((guest, event));
    }

    fn guest_stepped(&mut self, now: Duration, guest: usize, stepped: u64, session: &mut GuestSession) {
        if stepped > 0 {
            (self.hand)(now, guest, session);
            if now > self.settled && session.body(BODY).is_some_and(|b| b.is_ready()) {
                self.worst = self.worst.max(self.error(session));
            }
        }
    }
}

/// A scene, and what looks at a guest after each of its updates. Arguments: time, guest, number of
/// ticks, session.
pub struct Observed<F> {
    pub scene: Scene,
    pub look: F,
}

impl<F: FnMut(Duration, usize, u64, &mut GuestSession)> World for Observed<F> {
    fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
        self.scene.step(now, tick, host);
    }

    fn host_event(&mut self, now: Duration, event: HostEvent, host: &mut HostSession) {
        self.scene.host_event(now, event, host);
    }

    fn guest_event(&mut self, now: Duration, guest: usize, event: GuestEvent, s: &mut GuestSession) {
        self.scene.guest_event(now, guest, event, s);
    }

    fn guest_stepped(&mut self, now: Duration, guest: usize, stepped: u64, session: &mut GuestSession) {
        self.scene.guest_stepped(now, guest, stepped, session);
        (self.look)(now, guest, stepped, session);
    }
}

/// Guest 0 grabs the tip as soon as possible and moves in a circle.
pub fn circling() -> HandScript {
    circling_with(GrabConfig::default())
}

/// The same with a spring and damper of the hand's own.
pub fn circling_with(hold: GrabConfig) -> HandScript {
    let mut grab = None;
    Box::new(move |now, guest, session| {
        if guest != 0 || session.user().is_none() {
            return;
        }
        let t = now.as_secs_f64();
        let target = [1.0, 0.08 + 0.1 * (1.3 * t).sin(), 0.08 + 0.1 * (1.0 - (1.3 * t).cos())];
        match grab {
            None => grab = session.begin_grab(now, BODY, 66, 0.05, target, hold).ok(),
            Some(g) => {
                let _ = session.set_target(g, target);
            }
        }
    })
}

pub fn start(model: &Arc<ModalModel>) -> (Pair, Scene) {
    start_with(model, HostSessionConfig::default())
}

pub fn start_with(model: &Arc<ModalModel>, config: HostSessionConfig) -> (Pair, Scene) {
    let mut pair = Pair::new(config).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), StepSettings::default()).unwrap();
    (pair, Scene::new(model))
}

pub fn cached(model: &Arc<ModalModel>) -> impl FnOnce(&mut GuestSession) {
    let model = model.clone();
    move |s| s.add_cached_model(model)
}

pub fn paper1() -> PathConfig {
    PathConfig::symmetric(LinkConfig::preset(Preset::Paper1))
}

/// The paper's worst network. For the paper's own method the path from guest to host has no loss: a
/// lost target makes the true body jerk, and linear prediction multiplies a jerk, so the method has
/// no bound there.
pub fn path_for(name: &str) -> PathConfig {
    let mut path = paper1();
    if name.starts_with("paper") {
        path.up.loss = Loss::None;
    }
    path
}
