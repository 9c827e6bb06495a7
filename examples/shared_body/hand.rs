//! Scripted hands: the second user's, and yours when there is no window.

use bevy::{math::DVec3, prelude::*};
use pliant::modal::SurfaceMesh;
use pliant::prelude::*;

/// A hand that grabs the farthest point of a body in some direction, moves it and releases it.
#[derive(Resource, Clone, Debug)]
pub struct ScriptedHand {
    /// Direction of the grabbed point, in body axes.
    pub toward: DVec3,
    /// Displacement of the hand, as fractions of the body's size; the hand moves slowly about this
    /// point.
    pub pull: DVec3,
    /// Seconds before the first grab.
    pub wait: f64,
}

/// Seconds of one pull and of the pause after it.
const HOLD: f64 = 4.5;
const PAUSE: f64 = 1.0;

/// Marks the grab of the script.
#[derive(Component)]
pub struct Scripted {
    vertex_at_rest: DVec3,
    began: f64,
}

/// Returns the surface vertex farthest along `toward`.
pub fn farthest(surface: &SurfaceMesh, toward: DVec3) -> u32 {
    let along = |p: &[f32; 3]| Vec3::from_array(*p).as_dvec3().dot(toward);
    let positions = surface.positions();
    (0..positions.len()).max_by(|&a, &b| along(&positions[a]).total_cmp(&along(&positions[b]))).unwrap_or(0)
        as u32
}

/// Rises from 0 to 1 with continuous velocity and acceleration.
fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
}

/// Grabs the body, pulls, releases it, and begins again.
pub fn play(
    mut commands: Commands,
    time: Res<Time>,
    hand: Res<ScriptedHand>,
    bodies: Query<(Entity, &BodyState, &GlobalTransform), Without<crate::view::Ghost>>,
    mut grabs: Query<(Entity, &mut Grab, &Scripted)>,
    mut ready: Local<Option<f64>>,
) {
    let now = time.elapsed_secs_f64();
    let Ok((body, state, place)) = bodies.single() else {
        *ready = None;
        return;
    };
    let since = now - *ready.get_or_insert(now) - hand.wait;
    if since < 0.0 {
        return;
    }
    let phase = since % (HOLD + PAUSE);
    let size = state.model().size();
    if let Ok((entity, mut grab, scripted)) = grabs.single_mut() {
        if phase > HOLD {
            commands.entity(entity).despawn();
            return;
        }
        let t = now - scripted.began;
        let wave = |rate: f64, shift: f64| 0.2 * ((rate * t + shift).sin() - shift.sin());
        let aside = DVec3::new(wave(2.1, 0.0), wave(2.9, 0.8), wave(1.7, 1.9));
        grab.target =
            scripted.vertex_at_rest + size * smooth(t / 0.8) * (hand.pull + aside * hand.pull.length());
    } else if phase < HOLD * 0.5 {
        let surface = state.model().surface();
        let vertex = farthest(surface, hand.toward);
        let local = Vec3::from_array(surface.positions()[vertex as usize]);
        let at = place.transform_point(local).as_dvec3();
        commands.spawn((
            Grab::new(vertex, 0.06 * size, at),
            GrabOf(body),
            Scripted { vertex_at_rest: at, began: now },
        ));
    }
}
