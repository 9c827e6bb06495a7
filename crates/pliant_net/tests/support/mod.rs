//! Apps that share a body over loopback, and a body whose modes are known in closed form.
#![allow(dead_code, unused_imports, reason = "each test uses its part")]

pub mod wait;

use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bevy::transform::TransformPlugin;
use bevy::{
    ecs::message::{MessageRegistry, ShouldUpdateMessages},
    prelude::*,
};
use pliant_body::{
    BodyState, ModalAsset, ModalBody, PliantBodyPlugin, PliantTick, RidingPlugin, VisualState,
};
use pliant_modal::{BakeInfo, Damping, Element, FlexibilitySite, ModalModel, ModelParts, Patch, SurfaceMesh};
use pliant_net::{HostConfig, Invite, JoinConfig, NetHost, NetPlugin, NetStats, RemoteBody, SharedBody};

pub(crate) use wait::must;
pub use wait::{Look, PATIENCE, wait_for};

/// Cells along the bar.
const CELLS: u32 = 16;

/// A vertex at the tip of [`bar`].
pub const TIP: u32 = 4 * CELLS;
/// A vertex at half of the bar's length.
pub const MIDDLE: u32 = 4 * (CELLS / 2);

const GIVE: [[f64; 3]; 3] = [[2e-3, 0.0, 0.0], [0.0, 2e-3, 0.0], [0.0, 0.0, 2e-3]];

/// A square bar of 1 m and 2 kg along x, fixed at x = 0. It shears in y and z with the mode shapes
/// sin((2k - 1) pi x / 2).
pub fn bar() -> Arc<ModalModel> {
    bar_of(CELLS)
}

/// The same bar with `cells` cells along it.
pub fn bar_of(cells: u32) -> Arc<ModalModel> {
    let (half, tip) = (0.08, 4 * cells);
    let mut positions: Vec<[f32; 3]> = Vec::new();
    for i in 0..=cells {
        for [y, z] in [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]] {
            positions.push([i as f32 / cells as f32, y * half, z * half]);
        }
    }
    let mut triangles = Vec::new();
    for i in 0..cells {
        for k in 0..4 {
            let (a, b) = (4 * i + k, 4 * i + (k + 1) % 4);
            triangles.extend([[a, b + 4, b], [a, a + 4, b + 4]]);
        }
    }
    triangles.extend([[0, 1, 2], [0, 2, 3], [tip, tip + 2, tip + 1], [tip, tip + 3, tip + 2]]);
    let anchored = positions.iter().map(|p| p[0] == 0.0).collect();
    let surface = SurfaceMesh::new(positions.clone(), triangles, None, anchored).unwrap();
    let modes: Vec<(usize, f64)> = vec![(1, 0.9), (2, 1.1), (1, 2.7), (2, 3.3)];
    let (mut displacement, mut rotation) = (Vec::new(), Vec::new());
    for (mode, &(axis, _)) in modes.iter().enumerate() {
        let wave = (2 * (mode / 2) + 1) as f64 * FRAC_PI_2;
        for p in &positions {
            let (s, c) =
                ((wave * f64::from(p[0])).sin() as f32, (wave * (wave * f64::from(p[0])).cos()) as f32);
            displacement.extend(if axis == 1 { [0.0, s, 0.0] } else { [0.0, 0.0, s] });
            rotation.extend(if axis == 1 { [0.0, 0.0, 0.5 * c] } else { [0.0, -0.5 * c, 0.0] });
        }
    }
    let omega: Vec<f64> = modes.iter().map(|mode| TAU * mode.1).collect();
    let damping = Damping::Ratio(0.2);
    let parts = ModelParts {
        info: BakeInfo {
            name: "bar".into(),
            tets: 1,
            nodes: positions.len(),
            element: Element::Tet4,
            young: 1e5,
            poisson: 0.3,
            density: 1000.0,
            damping,
            anchors: vec!["x<0.01".into()],
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface,
        damping: omega.iter().map(|&w| damping.coefficient(w)).collect(),
        participation: vec![[0.0; 3]; omega.len()],
        omega,
        displacement,
        rotation,
        free: false,
        mass: 2.0,
        center_of_mass: [0.5, 0.0, 0.0],
        inertia: [[0.01, 0.0, 0.0], [0.0, 0.17, 0.0], [0.0, 0.0, 0.17]],
        // Residual flexibility of the truncated modes, m/N. Without it a grab would be stiffer than
        // a body of four modes can bear at 40 Hz.
        sites: [tip, 4 * (cells / 2)]
            .map(|vertex| FlexibilitySite { vertex, radius: 0.3, flexibility: GIVE })
            .to_vec(),
        reduced: None,
    };
    Arc::new(ModalModel::from_parts(parts).unwrap())
}

/// Returns the center of a patch of the bar at rest.
pub fn patch_at_rest(vertex: u32, radius: f64) -> [f64; 3] {
    let model = bar();
    let patch = Patch::around(model.surface(), vertex, radius).unwrap();
    let mut middle = [0.0; 3];
    for &(vertex, weight) in patch.entries() {
        let position = model.surface().positions()[vertex as usize];
        (0..3).for_each(|axis| middle[axis] += weight * f64::from(position[axis]));
    }
    middle
}

/// Runs one test with apps at a time, because they run in real time.
pub fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Creates an app without a renderer, with 40 steps per second of real time.
pub fn app(net: NetPlugin) -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .add_plugins((PliantBodyPlugin::default(), RidingPlugin::default(), net))
        .add_systems(Last, keep_messages);
    app
}

/// Keeps all messages, because a test reads them at any later time.
fn keep_messages(mut registry: ResMut<MessageRegistry>) {
    registry.should_update = ShouldUpdateMessages::Waiting;
}

/// Creates a host that shares [`bar`] at 1 m above the origin. Returns the app, its invite and the
/// body.
pub fn host(config: HostConfig) -> (App, Invite, Entity) {
    host_of(config, bar())
}

/// As [`host`], with another body.
pub fn host_of(config: HostConfig, model: Arc<ModalModel>) -> (App, Invite, Entity) {
    let net = NetPlugin::host(config).unwrap();
    let invite = net.invite().unwrap().clone();
    let mut app = app(net);
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(model));
    let place = Transform::from_xyz(0.0, 1.0, 0.0)
        .with_rotation(Quat::from_rotation_z(0.5))
        .with_scale(Vec3::splat(2.0));
    let body = app.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar"), place)).id();
    (app, invite, body)
}

pub fn guest(invite: &Invite, config: JoinConfig) -> App {
    app(NetPlugin::join(invite, config).unwrap())
}

/// Runs the apps, at about 150 frames per second if the machine can, until `look` succeeds. Panics
/// after [`PATIENCE`], with what is still wrong.
pub fn run_until<L: Look>(
    apps: &mut [&mut App],
    awaited: &str,
    mut look: impl FnMut(&mut [&mut App]) -> L,
) -> L::Found {
    wait_for(awaited, || {
        std::thread::sleep(Duration::from_millis(4));
        apps.iter_mut().for_each(|app| app.update());
        look(apps)
    })
}

/// Runs the apps for a number of frames, to check that nothing happens. For an event that must
/// happen, use [`run_until`].
pub fn run_frames(apps: &mut [&mut App], frames: usize) {
    let mut left = frames;
    run_until(apps, "the frames are over", |_| {
        left = left.saturating_sub(1);
        left == 0
    });
}

/// What a guest has received while its host made `ticks` steps, in `seconds`.
#[derive(Debug, Clone, Copy)]
pub struct Came {
    pub datagrams: u64,
    pub bytes: u64,
    ticks: u64,
    seconds: f64,
}

impl Came {
    /// Bytes per 40 ticks, which nominally take a second.
    pub fn bytes_in_40_ticks(&self) -> f64 {
        40.0 * self.bytes as f64 / self.ticks as f64
    }

    /// Bytes per second, or in total if less than a second has passed.
    pub fn bytes_in_a_second(&self) -> f64 {
        self.bytes as f64 / self.seconds.max(1.0)
    }

    /// Checks that nearly every tick brings a datagram: more than 30 in 40.
    pub fn ticks_come(self) -> Result<Self, String> {
        must!(40 * self.datagrams > 30 * self.ticks, "{self:?}");
        Ok(self)
    }

    /// Checks that an unwanted body is not sent. The clock's answers are two per second, however
    /// many ticks the host makes.
    pub fn only_the_clock(self) -> Result<Self, String> {
        must!(self.datagrams as f64 <= 5.0 * self.seconds.max(1.0), "{self:?}");
        Ok(self)
    }
}

/// A check for [`run_until`] with a host and a guest. It collects what the guest receives while the
/// host makes forty steps, and repeats this until `look` accepts it. Packets that were sent
/// earlier, and occasional drops on a busy machine, therefore do not matter.
pub fn window<T>(
    look: impl Fn(Came) -> Result<T, String>,
) -> impl FnMut(&mut [&mut App]) -> Result<T, String> {
    let mut begin: Option<(NetStats, u64, Instant)> = None;
    let mut last = String::from("forty steps are not over");
    move |apps| {
        let (stats, now) = (*apps[1].world().resource::<NetStats>(), tick(apps[0]));
        let (before, first, start) = begin.get_or_insert((stats, now, Instant::now()));
        if now < *first + 40 {
            return Err(last.clone());
        }
        let came = Came {
            datagrams: stats.datagrams_in - before.datagrams_in,
            bytes: stats.bytes_in - before.bytes_in,
            ticks: now - *first,
            seconds: start.elapsed().as_secs_f64(),
        };
        begin = None;
        // A busy machine may look like a slow network, to which the host sends less.
        if let Some(host) = apps[0].world().get_resource::<NetHost>() {
            let session = host.session();
            let level = session.users().filter_map(|(peer, ..)| session.stats(peer)).map(|s| s.level).max();
            must!(level.unwrap_or(0) == 0, "the stream is reduced: level {level:?}");
        }
        look(came).inspect_err(|off| last.clone_from(off))
    }
}

/// Number of steps of an app's bodies.
pub fn tick(app: &App) -> u64 {
    app.world().resource::<PliantTick>().0
}

/// Returns the host's body on a guest, once it is displayed.
pub fn body_of(guest: &mut App) -> Option<Entity> {
    only::<RemoteBody>(guest).filter(|&body| guest.world().get::<VisualState>(body).is_some())
}

/// Waits for the host's body on a guest.
pub fn arrival(host: &mut App, guest: &mut App) -> Entity {
    run_until(&mut [host, guest], "the body arrives", |apps| body_of(apps[1]))
}

/// Returns whether a body has come to rest: at its speed it moves by less than a hundredth of
/// `size` in a tenth of a second.
pub fn rests(app: &App, body: Entity, size: f64) -> bool {
    let speed = app.world().get::<BodyState>(body).unwrap().body().v().iter().map(|v| v * v).sum::<f64>();
    speed.sqrt() < 0.1 * size
}

/// Returns all messages of a kind so far.
pub fn messages<M: Message + Clone>(app: &App) -> Vec<M> {
    let messages = app.world().resource::<Messages<M>>();
    messages.get_cursor().read(messages).cloned().collect()
}

/// Returns the only entity with a component.
pub fn only<C: Component>(app: &mut App) -> Option<Entity> {
    let mut query = app.world_mut().query_filtered::<Entity, With<C>>();
    query.iter(app.world()).next()
}
