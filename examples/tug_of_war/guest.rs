//! The user on the right: a guest's app without a window, on its own thread.

use std::error::Error;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use bevy::app::ScheduleRunnerPlugin;
use bevy::math::DVec3;
use bevy::prelude::*;
use pliant::modal::ModalModel;
use pliant::net::{Emulation, Invite, JoinConfig, JoinOptions, NetPlugin, RemoteBody};
use pliant::prelude::*;

/// The data that the two threads share.
#[derive(Resource, Clone, Default)]
pub struct Other {
    view: Arc<Mutex<GuestView>>,
    pub stop: Arc<AtomicBool>,
}

/// The visual state of the guest, and the input for its hand.
#[derive(Default)]
pub struct GuestView {
    pub q: Vec<f64>,
    /// Targets and patches of the guest's hands, m, and the reactions on them, N.
    pub hands: Vec<(DVec3, DVec3, DVec3)>,
    /// Largest reaction on the guest's hands, N.
    pub reaction: f64,
    /// Position of the stick, -1 to 1 on each axis; `None` releases the body.
    pub stick: Option<DVec3>,
}

impl Other {
    pub fn view(&self) -> MutexGuard<'_, GuestView> {
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

pub fn start(
    invite: &Invite,
    model: Arc<ModalModel>,
    emulation: Option<Emulation>,
    other: Other,
) -> Result<JoinHandle<()>, Box<dyn Error>> {
    let transport = JoinOptions { emulation, ..default() };
    let net = NetPlugin::join(
        invite,
        JoinConfig { name: "right".into(), transport, models: vec![model], ..default() },
    )?;
    let run = move || {
        App::new()
            .add_plugins((
                MinimalPlugins.set(ScheduleRunnerPlugin::run_loop(Duration::from_millis(4))),
                AssetPlugin::default(),
                TransformPlugin,
                PliantBodyPlugin::default(),
                net,
            ))
            .insert_resource(Time::<Fixed>::from_hz(40.0))
            .insert_resource(other)
            .add_systems(FixedUpdate, pull.before(PliantSystems::Input))
            .add_systems(Last, update_view)
            .run();
    };
    Ok(thread::Builder::new().name("right".into()).spawn(run)?)
}

/// The position of the patch when it was grabbed, and the displacement of the hand from there.
#[derive(Component)]
struct Pull {
    from: DVec3,
    away: DVec3,
}

/// Moves the hand to the position of the stick at a limited speed.
fn pull(
    mut commands: Commands,
    other: Res<Other>,
    time: Res<Time>,
    bodies: Query<(Entity, &BodyState, &GlobalTransform), With<RemoteBody>>,
    mut grabs: Query<(Entity, &mut Grab, &mut Pull)>,
) {
    let stick = other.view().stick;
    let Ok((body, state, place)) = bodies.single() else { return };
    let size = state.model().size();
    match (grabs.single_mut(), stick) {
        (Ok((_, mut grab, mut pull)), Some(stick)) => {
            let to = 0.3 * size * stick.clamp_length_max(1.0);
            let step = (to - pull.away).clamp_length_max(size * time.delta_secs_f64());
            pull.away += step;
            grab.target = pull.from + pull.away;
        }
        (Ok((entity, ..)), None) => commands.entity(entity).despawn(),
        (Err(_), Some(_)) => {
            let positions = state.model().surface().positions();
            let reach = |p: &[f32; 3]| p[0] + 0.55 * p[1];
            let far =
                (0..positions.len()).max_by(|&a, &b| reach(&positions[a]).total_cmp(&reach(&positions[b])));
            let Some(vertex) = far else { return };
            let from = place.transform_point(Vec3::from(positions[vertex])).as_dvec3();
            commands.spawn((
                Grab::new(vertex as u32, 0.06 * size, from),
                GrabOf(body),
                Pull { from, away: DVec3::ZERO },
            ));
        }
        (Err(_), None) => {}
    }
}

fn update_view(
    other: Res<Other>,
    bodies: Query<&VisualState, With<RemoteBody>>,
    hands: Query<(&Grab, &GrabForce)>,
    mut exit: MessageWriter<AppExit>,
) {
    let mut view = other.view();
    if let Ok(visual) = bodies.single() {
        view.q.clear();
        view.q.extend_from_slice(visual.q());
    }
    view.hands = hands.iter().map(|(grab, reaction)| (grab.target, reaction.point, reaction.force)).collect();
    view.reaction = hands.iter().map(|(_, reaction)| reaction.force.length()).fold(0.0, f64::max);
    if other.stop.load(Ordering::Relaxed) {
        exit.write(AppExit::Success);
    }
}
