//! Attachments of soft bodies to the rigid bodies of avian.

use std::collections::BTreeSet;

use avian3d::prelude::{Physics, PhysicsTime};
use bevy::{math::DVec3, prelude::*};
use pliant_body::{BodyError, BodyRefused, BodyState, Driven, SurfacePlace};
use pliant_modal::{AttachedTo, AttachmentId, Patch, StepError};

use super::{Body, BodyItem, key};
use crate::contacts::Nearby;

/// Attaches a patch of a soft body to a point of a rigid body of avian, as by a ball joint. The
/// patch pulls and pushes the rigid body, and is pulled and pushed by it.
///
/// Spawn it on an entity of its own, as a joint of avian. Three attachments that are not on one
/// line hold the rotation too. The two bodies do not touch each other while they are attached.
/// Where the patch is away from the point, it is drawn there, at no more than half of the body's
/// size in a second. A static, kinematic or disabled rigid body holds the patch and gives no way.
///
/// An attachment of a body that is [`Driven::Remote`](pliant_body::Driven::Remote) does nothing
/// here.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_contact::Attachment;
/// # fn hang(mut commands: Commands, jack: Entity, lamp: Entity) {
/// // The lowest point of the jack holds the top of a lamp that is 20 cm high.
/// let (low, top) = (Vec3::new(0.0, -0.15, 0.0), Vec3::new(0.0, 0.1, 0.0));
/// commands.spawn(Attachment::new(jack, low, lamp, top));
/// # }
/// ```
#[derive(Component, FromTemplate, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(AttachmentForce, Attached)]
pub struct Attachment {
    /// The soft body. An entity without a [`ModalBody`](pliant_body::ModalBody) is waited for.
    #[entities]
    pub body: Entity,
    /// The place on its surface. The patch lies around the vertex that is nearest to it. A point is
    /// replaced by the place that is found: set it again for another model.
    pub place: SurfacePlace,
    /// Radius of the patch, measured on the rest shape, m (of the model, before the entity's
    /// scale). Default: 0.02.
    pub radius: f64,
    /// The rigid body. An entity without avian's `RigidBody` is waited for.
    #[entities]
    pub rigid: Entity,
    /// The point of the rigid body, m, in the axes of its `Position` and `Rotation`, as the anchors
    /// of avian's joints. Default: its origin.
    pub anchor: Vec3,
}

impl Attachment {
    /// Attaches the place of the surface that is nearest to `point` at rest (m, axes of the body)
    /// to the point `anchor` of a rigid body (m, axes of that body).
    pub fn new(body: Entity, point: Vec3, rigid: Entity, anchor: Vec3) -> Self {
        Self { body, place: SurfacePlace::Nearest(point), radius: 0.02, rigid, anchor }
    }

    /// What a new patch is made for. Bits, so that a refused NaN equals itself.
    fn wanted(&self) -> Wanted {
        let place = match self.place {
            SurfacePlace::Nearest(point) => {
                [u32::MAX, point.x.to_bits(), point.y.to_bits(), point.z.to_bits()]
            }
            SurfacePlace::In { triangle, weights } => {
                [triangle, weights.x.to_bits(), weights.y.to_bits(), weights.z.to_bits()]
            }
        };
        (self.body, place, self.radius.to_bits())
    }
}

impl Default for Attachment {
    /// Attaches nothing.
    fn default() -> Self {
        Self::new(Entity::PLACEHOLDER, Vec3::ZERO, Entity::PLACEHOLDER, Vec3::ZERO)
    }
}

/// Mean force of an [`Attachment`] on the soft body over the last step, N, world axes. The plugin
/// adds this component to every attachment.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq, Default)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct AttachmentForce(pub DVec3);

type Wanted = (Entity, [u32; 4], u64);

/// The attachment of the solver, and what it was made for.
#[derive(Component, Debug, Default)]
pub(crate) struct Attached {
    made: Option<(Wanted, Option<AttachmentId>)>,
}

/// The vertex of a place. A place that was only named by a point is replaced by the one found.
fn vertex(state: &BodyState, place: &mut SurfacePlace) -> Option<u32> {
    let surface = state.model().surface();
    if let SurfacePlace::Nearest(point) = *place {
        let (triangle, weights) = surface.nearest(point.as_dvec3().into())?;
        *place = SurfacePlace::In { triangle, weights: weights.map(|x| x as f32).into() };
    }
    let SurfacePlace::In { triangle, weights } = *place else { return None };
    let corners = surface.triangles().get(triangle as usize).filter(|_| weights.is_finite())?;
    let weights = weights.to_array();
    (0..3).max_by(|&a, &b| weights[a].total_cmp(&weights[b])).map(|corner| corners[corner])
}

/// Point of a rigid body in the world of a soft body on an entity of this scale.
fn point(rigid: &BodyItem<'_, '_>, anchor: Vec3, scale: f64, stands: bool) -> AttachedTo {
    let anchor = anchor.as_dvec3();
    if rigid.gives_way() && !stands {
        let point = (anchor - rigid.center.0.as_dvec3()) / scale;
        return AttachedTo::Rigid { key: key(rigid.entity, scale), point: point.into() };
    }
    let arm = rigid.turn() * anchor;
    let at = rigid.position.0.as_dvec3() + arm;
    let [velocity, spin] = if stands || rigid.disabled { [DVec3::ZERO; 2] } else { rigid.motion() };
    let velocity = velocity + spin.cross(at - rigid.center());
    AttachedTo::World { point: (at / scale).into(), velocity: (velocity / scale).into() }
}

fn refuse(commands: &mut Commands, entity: Entity, error: BodyError) {
    warn!("{entity}: {error}");
    commands.trigger(BodyRefused { entity, error });
}

/// Gives the soft bodies their attachments.
pub(super) fn attach(
    physics: Res<Time<Physics>>,
    mut commands: Commands,
    mut attachments: Query<(Entity, &mut Attachment, &mut Attached)>,
    mut soft: Query<(&mut BodyState, &Driven, &mut Nearby)>,
    rigids: Query<Body>,
    there: Query<Entity>,
) {
    let stands = physics.is_paused() || physics.relative_speed_f64() == 0.0;
    for (.., mut nearby) in &mut soft {
        nearby.bypass_change_detection().attached.clear();
    }
    let mut all: Vec<_> = attachments.iter_mut().collect();
    // In the order of entities, so that the order of archetypes makes no difference.
    all.sort_unstable_by_key(|(entity, ..)| *entity);
    for (entity, mut attachment, mut own) in all {
        let made = own.made;
        let release = |soft: &mut Query<(&mut BodyState, &Driven, &mut Nearby)>| {
            if let Some(((body, ..), Some(id))) = made
                && let Ok((mut state, ..)) = soft.get_mut(body)
            {
                state.body_mut().detach(id);
            }
        };
        if !there.contains(attachment.body) || !there.contains(attachment.rigid) {
            release(&mut soft);
            refuse(&mut commands, entity, BodyError::NotAttached);
            commands.entity(entity).try_remove::<Attachment>();
            continue;
        }
        // One that was refused is tried again when it is another.
        let tries = attachment.is_changed() && made.is_some_and(|(_, id)| id.is_none());
        if tries || made.is_some_and(|(wanted, _)| wanted != attachment.wanted()) {
            release(&mut soft);
            own.made = None;
        }
        // What is not loaded or not placed yet is waited for.
        let Ok((mut state, driven, mut nearby)) = soft.get_mut(attachment.body) else {
            own.made = None;
            continue;
        };
        let rigid = rigids.get(attachment.rigid).ok().filter(|rigid| rigid.is_placed());
        let Some(rigid) = rigid.filter(|_| *driven == Driven::Local) else {
            release(&mut soft);
            own.made = None;
            continue;
        };
        let to = point(&rigid, attachment.anchor, state.scale(), stands);
        // The body may be another one since its model was loaded again.
        let known = |id| state.body().attachments().any(|(known, _)| known == id);
        if own.made.is_some_and(|(_, id)| id.is_some_and(|id| !known(id))) {
            own.made = None;
        }
        let id = match own.made {
            Some((_, id)) => id,
            None => {
                let mut place = attachment.place;
                let made = match vertex(&state, &mut place) {
                    Some(vertex) => make(&mut state, vertex, attachment.radius, to).map_err(|error| *error),
                    None => Err(BodyError::NotAttached),
                };
                if place != attachment.place {
                    attachment.place = place;
                }
                let id = made.map_err(|error| refuse(&mut commands, entity, error)).ok();
                own.made = Some((attachment.wanted(), id));
                id
            }
        };
        let Some(id) = id else { continue };
        nearby.bypass_change_detection().attached.push(attachment.rigid);
        let quiet = state.is_resting();
        let state = if quiet { state.bypass_change_detection() } else { &mut *state };
        if let Err(error) = state.set_attachment(id, to)
            && attachment.is_changed()
        {
            refuse(&mut commands, entity, BodyError::Attachment(error));
        }
        // What hangs from a resting body would fall.
        if quiet && !stands && rigid.gives_way() && !rigid.sleeps {
            state.wake();
        }
    }
}

fn make(
    state: &mut BodyState,
    vertex: u32,
    radius: f64,
    to: AttachedTo,
) -> Result<AttachmentId, Box<BodyError>> {
    let patch = Patch::around(state.model().surface(), vertex, radius).map_err(BodyError::Patch)?;
    let made: Result<_, StepError> = state.body_mut().attach(&patch, to);
    Ok(made.map_err(BodyError::Attachment)?)
}

/// Ends an attachment that is removed.
pub(super) fn detach(
    removed: On<Remove, Attachment>,
    mut commands: Commands,
    attached: Query<&Attached>,
    mut soft: Query<&mut BodyState>,
) {
    if let Ok(own) = attached.get(removed.entity)
        && let Some(((body, ..), Some(id))) = own.made
        && let Ok(mut state) = soft.get_mut(body)
    {
        state.body_mut().detach(id);
    }
    if let Ok(mut entity) = commands.get_entity(removed.entity) {
        entity.try_remove::<(Attached, AttachmentForce)>();
    }
}

/// Writes the forces of the attachments.
pub(super) fn write_forces(
    bodies: Query<&BodyState>,
    mut attachments: Query<(&Attached, &mut AttachmentForce)>,
) {
    for (own, mut force) in &mut attachments {
        let mean = own.made.and_then(|((body, ..), id)| {
            let state = bodies.get(body).ok()?;
            let force = state.body().attachment_force(id?).ok()?;
            Some(state.scale() * DVec3::from(force))
        });
        force.set_if_neq(AttachmentForce(mean.unwrap_or_default()));
    }
}

/// The rigid bodies that give way to the soft body to which they are attached.
pub(super) fn giving_way<'a>(
    nearby: &'a Nearby,
    rigids: &'a Query<'_, '_, Body>,
) -> impl Iterator<Item = Entity> + 'a {
    let all: BTreeSet<Entity> = nearby.attached.iter().copied().collect();
    all.into_iter().filter(|rigid| rigids.get(*rigid).is_ok_and(|rigid| rigid.gives_way()))
}
