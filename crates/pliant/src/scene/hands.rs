//! Hands that play the scripts of a scene.

use bevy::{math::DVec3, prelude::*};

use super::locate::Step::Field;
use super::motion::smooth;
use super::spawn::{self, PartOf, SceneBody, SceneClock, SceneSource};
use super::{GrabEntry, PatchEntry, SceneError, SceneErrorKind};
use crate::body::{BodyState, Grab, GrabForce, GrabOf, VisualState};
use crate::modal::{ModalModel, Patch};

/// A hand of a scene, with a [`Grab`] between its start and its end.
#[derive(Component, Debug)]
pub(super) struct ScriptedHand {
    entry: GrabEntry,
    /// Center of the patch when the hand took hold, m, and that time, s of the scene's clock.
    held: Option<(DVec3, f64)>,
    /// Whether the hand cannot hold its patch and the error was reported.
    refused: bool,
}

impl ScriptedHand {
    pub(super) fn new(entry: GrabEntry) -> Self {
        Self { entry, held: None, refused: false }
    }
}

/// Returns the center vertex of a patch.
pub(super) fn vertex_of(patch: &PatchEntry, model: &ModalModel) -> Result<u32, String> {
    let positions = model.surface().positions();
    let place = |p: &[f32; 3]| Vec3::from(*p).as_dvec3();
    let best = |measure: &dyn Fn(DVec3) -> f64| {
        (0..positions.len())
            .max_by(|&a, &b| measure(place(&positions[a])).total_cmp(&measure(place(&positions[b]))))
    };
    let found = match patch {
        PatchEntry::Toward(way) => best(&|at| at.dot((*way).into())),
        PatchEntry::Near(point) => best(&|at| -at.distance_squared((*point).into())),
        PatchEntry::Vertex(vertex) => return vertex_there(*vertex, positions.len()),
    };
    let found = found.and_then(|vertex| u32::try_from(vertex).ok());
    found.ok_or_else(|| "the body has no surface".into())
}

/// Checks that the surface has a vertex with this index.
pub(super) fn vertex_there(vertex: u32, count: usize) -> Result<u32, String> {
    if (vertex as usize) < count {
        return Ok(vertex);
    }
    Err(format!("expected a vertex of the surface, 0 to {}, got {vertex}", count.saturating_sub(1)))
}

/// Returns the message for a hand that cannot hold its patch.
pub(super) fn cannot_hold(grab: &GrabEntry, problem: &str) -> String {
    format!("the grab `{}` cannot hold `{}`: {problem}", grab.name, grab.body)
}

/// Radius of a patch without a given radius, as a fraction of the body's size.
const RADIUS: f64 = 0.06;

/// Returns the vertex, the radius and the current center of a patch in the world, m.
fn take_hold(
    entry: &GrabEntry,
    state: &BodyState,
    visual: &VisualState,
    place: &GlobalTransform,
) -> Result<(u32, f64, DVec3), String> {
    let model = state.model();
    let vertex = vertex_of(&entry.patch, model)?;
    let radius = entry.radius.unwrap_or(RADIUS * model.size());
    let patch = Patch::around(model.surface(), vertex, radius).map_err(|error| error.to_string())?;
    let positions = state.positions(visual);
    let middle: DVec3 = patch
        .entries()
        .iter()
        .filter_map(|&(v, weight)| Some(Vec3::from(*positions.get(v as usize)?).as_dvec3() * weight))
        .sum();
    Ok((vertex, radius, place.transform_point(middle.as_vec3()).as_dvec3()))
}

/// Grabs, moves and releases the hands; runs in the bodies' schedule before the tick.
pub(super) fn play(
    mut commands: Commands,
    time: Res<Time>,
    clocks: Query<(&SceneClock, &GlobalTransform)>,
    bodies: Query<(Entity, &Name, &PartOf, &BodyState, &VisualState, &GlobalTransform), With<SceneBody>>,
    mut hands: Query<(Entity, &mut ScriptedHand, &PartOf, &SceneSource, Option<&mut Grab>)>,
) {
    for (entity, mut hand, part, source, grab) in &mut hands {
        let Ok((clock, scene)) = clocks.get(part.0) else { continue };
        let Some(t) = clock.at(time.elapsed_secs_f64()) else { continue };
        let entry = &hand.entry;
        let holds = t >= entry.from && entry.until.is_none_or(|until| t < until);
        match (hand.held, grab) {
            (Some(_), _) if !holds => {
                commands.entity(entity).remove::<(Grab, GrabOf, GrabForce)>();
                hand.held = None;
            }
            (Some((from, since)), Some(mut grab)) => {
                let t = t - since;
                let rise = if entry.rise > 0.0 { smooth(t / entry.rise) } else { 1.0 };
                let way = rise * (DVec3::from(entry.pull) + entry.motion.at(t));
                let target = from + scene.affine().transform_vector3(way.as_vec3()).as_dvec3();
                if grab.target != target {
                    grab.target = target;
                }
            }
            (None, _) if holds && !hand.refused => {
                let body =
                    bodies.iter().find(|(_, name, of, ..)| of.0 == part.0 && name.as_str() == entry.body);
                // The hand waits for a missing body, which may return within a session.
                let Some((body, _, _, state, visual, place)) = body else { continue };
                match take_hold(entry, state, visual, place) {
                    Ok((vertex, radius, from)) => {
                        let grab = Grab {
                            stiffness: entry.stiffness,
                            relaxation: entry.relaxation,
                            ..Grab::new(vertex, radius, from)
                        };
                        commands.entity(entity).insert((grab, GrabOf(body)));
                        hand.held = Some((from, t));
                    }
                    Err(problem) => {
                        let message = cannot_hold(entry, &problem);
                        let path = [source.path.as_slice(), &[Field("patch")]].concat();
                        let error: SceneError = source.file.error(&path, SceneErrorKind::Asset, message);
                        let instance = part.0;
                        commands.queue(move |world: &mut World| spawn::fail(world, instance, error));
                        hand.refused = true;
                    }
                }
            }
            // The body was despawned, and its grab with it.
            (Some(_), None) => hand.held = None,
            (None, _) => {}
        }
    }
}
