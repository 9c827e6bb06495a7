//! The components of a body: [`ModalBody`] and [`Driven`] for the user, [`BodyState`] for the
//! plugin.

use std::sync::Arc;

use bevy::{
    asset::HandleTemplate,
    ecs::template::{SpecializeFromTemplate, Template, TemplateContext},
    math::Affine3A,
    prelude::*,
    reflect::reflect_remote,
};
use pliant_modal::{
    AttachedTo, AttachmentId, Body, BodyConfig, Elasticity, GrabId, Integrator, ModalModel, ObstacleShape,
    Precision, Relaxation, StepError, StepSettings,
};

use crate::{BodyGravityScale, Inertia, ModalAsset, VisualState, grab::GrabHold, gravity::Pull};

/// A soft body: its model and its step settings.
///
/// The plugin adds all other components after the entity is spawned.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::ModalBody;
/// fn setup(mut commands: Commands, assets: Res<AssetServer>) {
///     commands.spawn((ModalBody::new(assets.load("pip.modal")), Transform::from_xyz(0.0, 1.0, 0.0)));
/// }
/// ```
///
/// With the feature `render`, add a `MeshMaterial3d` to draw the deformed surface with that
/// material.
///
/// The entity's `GlobalTransform` places the body by a rotation, a translation and a positive,
/// uniform scale. The scale multiplies lengths and forces. Masses, stiffness (N/m) and frequencies
/// keep their baked values. Moving the transform of an anchored body, or of an entity above it,
/// moves its anchors, which the body feels as [`Inertia`]. A free body writes its own motion into
/// its `Transform` in each frame and must have no parent. Writing the transform of a free body
/// moves the body there and keeps its velocity.
///
/// A change of a field takes effect at the end of the frame. The shape and the motion are kept if
/// the model stays the same. A change that cannot make a body is refused once
/// ([`BodyRefused`](crate::BodyRefused)), and the body keeps its previous settings.
#[derive(Component, Reflect, Debug, Clone, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(Transform, Visibility, Driven, Inertia, BodyGravityScale)]
pub struct ModalBody {
    /// The baked body. A new handle, or a new asset behind the handle, makes a new body at rest.
    /// Grabs stay if the new model has their vertex.
    pub model: Handle<ModalAsset>,
    /// Step settings: integrator, warping, gravity, damping, stiffness, relaxation. Gravity is in
    /// world axes and world lengths, and adds to that of the scene
    /// ([`BodyGravity`](crate::BodyGravity)).
    #[reflect(remote = ReflectedSettings)]
    pub settings: StepSettings,
    /// Level of detail: number of the model's modes that are kept, lowest first. Default: `None`,
    /// all modes.
    pub modes: Option<usize>,
    /// Whether the CPU computes the surface (see `SurfaceDeformation`) from a basis in half
    /// precision. This takes half the time where the surface is large. The error is some 5e-5 of
    /// the body's size where the body is pulled by a fifth of its size. Default: `false`.
    pub half_basis: bool,
    /// Whether a body of reduced elasticity gets the own shapes of its held patches
    /// ([`HeldShapesCache`](crate::HeldShapesCache)), without which the force in the hand is off by
    /// five to fifty percent. They are made on a compute thread, anew when a hand goes on, and a
    /// step takes some 30 % longer with them. Default: `true`.
    pub held_shapes: bool,
    /// Speed below which the body rests, m/s of the model. The body rests after the root mean
    /// square speed of its mass has stayed below this speed for half a second without a grab. A
    /// resting body is neither stepped nor uploaded until something touches it. With zero the body
    /// never rests. Default: `1e-4`.
    pub rest_speed: f64,
}

impl Default for ModalBody {
    /// Returns a body with all default settings and no model.
    fn default() -> Self {
        Self::new(Handle::default())
    }
}

/// The [`ModalBody`] of a scene in Bevy's notation, where an asset is named by its path:
/// `bsn! { ModalBody { model: "pip.modal" } }`. The fields and their defaults are those of
/// [`ModalBody`].
#[expect(missing_docs, reason = "the fields are those of ModalBody")]
pub struct ModalBodyTemplate {
    pub model: HandleTemplate<ModalAsset>,
    pub settings: StepSettings,
    pub modes: Option<usize>,
    pub half_basis: bool,
    pub held_shapes: bool,
    pub rest_speed: f64,
}

impl Default for ModalBodyTemplate {
    fn default() -> Self {
        let ModalBody { settings, modes, half_basis, held_shapes, rest_speed, .. } = ModalBody::default();
        let model = HandleTemplate::default();
        Self { model, settings, modes, half_basis, held_shapes, rest_speed }
    }
}

impl Template for ModalBodyTemplate {
    type Output = ModalBody;

    fn build_template(&self, context: &mut TemplateContext) -> Result<ModalBody> {
        let &Self { settings, modes, half_basis, held_shapes, rest_speed, .. } = self;
        let model = self.model.build_template(context)?;
        Ok(ModalBody { model, settings, modes, half_basis, held_shapes, rest_speed })
    }

    fn clone_template(&self) -> Self {
        let &Self { settings, modes, half_basis, held_shapes, rest_speed, .. } = self;
        let model = self.model.clone_template();
        Self { model, settings, modes, half_basis, held_shapes, rest_speed }
    }
}

impl FromTemplate for ModalBody {
    type Template = ModalBodyTemplate;
}

// Bevy makes a template of every type that is `Default`, `Clone` and `Unpin`. This bound, which
// never holds, keeps it from this one. Bevy's derive for templates does the same.
impl Unpin for ModalBody where for<'a> [()]: SpecializeFromTemplate {}

impl ModalBody {
    /// Returns a body of `model` with all default settings.
    pub fn new(model: Handle<ModalAsset>) -> Self {
        Self {
            model,
            settings: StepSettings::default(),
            modes: None,
            half_basis: false,
            held_shapes: true,
            rest_speed: 1e-4,
        }
    }

    /// Returns the solver's configuration for a step of `step` seconds under a uniform scale of
    /// `scale`, in a scene with this gravity.
    pub(crate) fn config(&self, step: f64, scale: f64, pull: Pull) -> BodyConfig {
        let gravity = self.pulled(pull).of_step(scale);
        BodyConfig {
            settings: StepSettings { gravity, ..self.settings },
            step,
            modes: self.modes,
            precision: if self.half_basis { Precision::Half } else { Precision::Single },
        }
    }

    /// Returns the gravity of the scene together with that of these settings.
    pub(crate) fn pulled(&self, pull: Pull) -> Pull {
        Pull { own: self.settings.gravity.into(), ..pull }
    }
}

// The solver's types do not depend on an engine. Reflection accesses their fields through the
// following types. The compiler checks that both declarations agree.

#[reflect_remote(StepSettings)]
#[derive(Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) struct ReflectedSettings {
    #[reflect(remote = ReflectedElasticity)]
    elasticity: Elasticity,
    #[reflect(remote = ReflectedIntegrator)]
    integrator: Integrator,
    second_order: bool,
    warp: bool,
    corrections: u8,
    gravity: [f64; 3],
    damping_scale: f64,
    stiffness_scale: f64,
    #[reflect(remote = MaybeRelaxation)]
    relaxation: Option<Relaxation>,
}

#[reflect_remote(Elasticity)]
#[derive(Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) enum ReflectedElasticity {
    Linear,
    Reduced,
}

#[reflect_remote(Integrator)]
#[derive(Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) enum ReflectedIntegrator {
    Exact,
    Newmark,
    GeneralizedAlpha { rho_inf: f64 },
}

type Relaxes = Option<Relaxation>;

#[reflect_remote(Relaxes)]
#[derive(Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) enum MaybeRelaxation {
    None,
    Some(#[reflect(remote = ReflectedRelaxation)] Relaxation),
}

#[reflect_remote(Relaxation)]
#[derive(Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) struct ReflectedRelaxation {
    ratio: f64,
    time: f64,
}

/// Selects what moves a body. Default: [`Local`](Self::Local).
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum Driven {
    /// This app steps the body.
    #[default]
    Local,
    /// Another source writes the body's [`VisualState`](crate::VisualState) and its grabs'
    /// [`GrabForce`](crate::GrabForce): the network, a recording or a script. This app does not
    /// step the body.
    Remote,
}

/// Makes the pointer ignore this body, for example a ghost or a backdrop.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct NoPointerGrab;

/// The body of an entity is there: its model is loaded, or a new one has replaced it. Observe it on
/// the body's entity or on all.
#[derive(EntityEvent, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct BodyReady {
    /// The entity of the [`ModalBody`].
    pub entity: Entity,
}

/// A simulated body.
///
/// The plugin adds this component to a [`ModalBody`] when the model's asset is loaded. Reflection
/// shows the state flags but not the solver, which [`body`](Self::body) returns. A world that is
/// saved by reflection has [`SavedState`](crate::SavedState) in its place.
#[derive(Component, Reflect, Debug)]
#[reflect(Component, from_reflect = false)]
pub struct BodyState {
    /// The solver's body. Its world is the entity's world divided by `scale`.
    #[reflect(ignore)]
    pub(crate) body: Body,
    #[reflect(ignore)]
    pub(crate) scale: f64,
    /// The transform that was processed last: accepted, refused, or written by the body itself.
    #[reflect(ignore)]
    pub(crate) placed: Option<Affine3A>,
    #[reflect(ignore)]
    pub(crate) pull: Pull,
    #[reflect(ignore)]
    pub(crate) held: Vec<HeldBody>,
    /// Whether a step was refused and the warning was logged.
    pub(crate) faulted: bool,
    /// Time for which the body has been slower than its rest speed, s.
    pub(crate) quiet: f64,
    pub(crate) resting: bool,
    /// Whether there is a new state to publish.
    pub(crate) stepped: bool,
    /// Layers of the contact with other bodies, see [`BodyState::touch_bodies`].
    pub(crate) layers: Option<[u32; 2]>,
    /// Layers of the contact with probes, see [`BodyState::set_probe_layers`].
    pub(crate) probe_layers: [u32; 2],
}

/// The solver's record of a grab.
#[derive(Debug)]
pub(crate) struct HeldBody {
    pub entity: Entity,
    /// The solver's grab. `None` if the grab was refused and the refusal was reported.
    pub id: Option<GrabId>,
    pub hold: GrabHold,
    /// Whether the grab was refused only because the body had the maximum number of grabs. Such a
    /// grab is tried again when a slot is free.
    pub waiting: bool,
    /// Whether the current target was refused and the warning was logged.
    pub refusing: bool,
}

impl BodyState {
    pub(crate) fn new(body: Body) -> Self {
        Self {
            body,
            scale: 1.0,
            placed: None,
            pull: Pull::default(),
            held: Vec::new(),
            faulted: false,
            quiet: 0.0,
            resting: false,
            stepped: false,
            layers: None,
            probe_layers: [u32::MAX; 2],
        }
    }

    /// Whether this transform was processed before. The comparison of bits also works for NaN.
    pub(crate) fn is_placed(&self, affine: &Affine3A) -> bool {
        let bits = |affine: &Affine3A| affine.to_cols_array().map(f32::to_bits);
        self.placed.is_some_and(|placed| bits(&placed) == bits(affine))
    }

    /// Whether the entity's transform has been processed. The first tick does this.
    pub fn has_place(&self) -> bool {
        self.placed.is_some()
    }

    /// Returns the simulated body with its modal state, its frame and its grabs.
    pub fn body(&self) -> &Body {
        &self.body
    }

    /// Returns the simulated body for changes, and wakes it.
    ///
    /// Configuration changes made here last until a field of the [`ModalBody`] changes, which sets
    /// all of the configuration again. Gravity is also set again when that of the scene or the
    /// scale of the entity changes. The caller must release grabs that the caller made here.
    /// Grabs of [`Grab`](crate::Grab) entities must not be changed here.
    pub fn body_mut(&mut self) -> &mut Body {
        self.wake();
        &mut self.body
    }

    /// Moves the point of an attachment ([`Body::set_attachment`]). A resting body wakes if the
    /// point is another one or moves.
    ///
    /// # Errors
    /// Returns those of [`Body::set_attachment`]. The old point then stays.
    pub fn set_attachment(&mut self, id: AttachmentId, to: AttachedTo) -> Result<(), StepError> {
        let before = self.body.attachments().find(|(known, _)| *known == id);
        self.body.set_attachment(id, to)?;
        let moves = matches!(to, AttachedTo::World { velocity, .. } if velocity != [0.0; 3]);
        if moves || before != Some((id, to)) {
            self.wake();
        }
        Ok(())
    }

    /// Gives the body its obstacles ([`Body::set_obstacles`]). A resting body wakes only if it
    /// touches one of `moved`, or may do so before or after: these are indices, with how near each
    /// is near (m).
    ///
    /// # Errors
    /// Returns those of [`Body::set_obstacles`]. The body then keeps its obstacles.
    pub fn set_obstacles(
        &mut self,
        obstacles: Vec<Arc<dyn ObstacleShape>>,
        moved: &[(usize, f64)],
    ) -> Result<(), StepError> {
        let meets = |body: &Body| moved.iter().any(|&(index, near)| body.may_touch(index, near));
        // What the body rested on may be gone afterwards.
        let left = self.resting && meets(&self.body);
        self.body.set_obstacles(obstacles)?;
        if left || self.resting && meets(&self.body) {
            self.wake();
        }
        Ok(())
    }

    /// Returns the solver's identifier of a [`Grab`](crate::Grab) entity's grab, for queries to
    /// [`body`](Self::body).
    ///
    /// Returns `None` before the grab's first tick, for a grab that was refused or waits for a free
    /// slot, and on a remote body.
    pub fn grab_id(&self, grab: Entity) -> Option<GrabId> {
        self.held.iter().find(|held| held.entity == grab)?.id
    }

    /// Returns the baked model.
    pub fn model(&self) -> &Arc<ModalModel> {
        self.body.model()
    }

    /// Whether modal warping bends the shape.
    pub fn warps(&self) -> bool {
        self.body.config().settings.warps(self.body.model())
    }

    /// Returns the precision of the basis from which the CPU computes the surface.
    pub fn precision(&self) -> Precision {
        self.body.config().precision
    }

    /// Returns the uniform scale from the entity's transform.
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Whether the body is at rest and not stepped.
    pub fn is_resting(&self) -> bool {
        self.resting
    }

    /// Wakes the body: it is stepped until it comes to rest again.
    pub fn wake(&mut self) {
        self.quiet = 0.0;
        self.resting = false;
    }

    /// Lets the body touch other bodies: those whose `[memberships, filters]` each have a bit of
    /// the other's filters and memberships. Default: `None`, it touches no body.
    ///
    /// Two bodies touch only if their entities have the same scale. The contacts name a body by the
    /// bits of its entity ([`Touched::Body`](pliant_modal::Touched::Body)). Bodies that touch come
    /// to rest together, and wake together.
    pub fn touch_bodies(&mut self, layers: Option<[u32; 2]>) {
        if self.layers != layers {
            self.layers = layers;
            self.wake();
        }
    }

    /// Layers of the contact with other bodies, see [`BodyState::touch_bodies`].
    pub fn body_layers(&self) -> Option<[u32; 2]> {
        self.layers
    }

    /// Sets which probes touch the body: those of which the `[memberships, filters]`
    /// ([`ProbeState::set_layers`](crate::ProbeState::set_layers)) each have a bit of the body's
    /// filters and memberships. Default: all bits, all probes. The contact plugin sets them at
    /// every tick.
    pub fn set_probe_layers(&mut self, layers: [u32; 2]) {
        self.probe_layers = layers;
    }

    /// Layers of the contact with probes, see [`BodyState::set_probe_layers`].
    pub fn probe_layers(&self) -> [u32; 2] {
        self.probe_layers
    }

    /// Returns the surface that is shown: one position per surface vertex, m, body axes.
    ///
    /// The function allocates and suits occasional queries such as a click. The drawn surface is
    /// computed by a faster path.
    pub fn positions(&self, visual: &VisualState) -> Vec<[f32; 3]> {
        let mut q = Vec::new();
        visual.draw(&mut q);
        let mut positions = self.positions_at(&q);
        if let Some((shapes, s)) = visual.held() {
            shapes.add_to(s, &mut positions);
        }
        positions
    }

    /// Returns the surface at modal coordinates `q` alone: one position per surface vertex, m, body
    /// axes.
    pub fn positions_at(&self, q: &[f64]) -> Vec<[f32; 3]> {
        let coordinates: Vec<f32> = q.iter().map(|&q| q as f32).collect();
        let mut positions = self.model().surface().positions().to_vec();
        self.model().basis().reconstruct(&coordinates, self.warps(), &mut positions);
        positions
    }
}
