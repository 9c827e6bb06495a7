//! The body as components: what a user writes ([`ModalBody`], [`Driven`]) and what the plugin keeps ([`BodyState`]).

use std::sync::Arc;

use bevy::{math::Affine3A, prelude::*, reflect::reflect_remote};
use pliant_modal::{Body, BodyConfig, GrabId, Integrator, ModalModel, Precision, Relaxation, StepSettings};

use crate::{ModalAsset, grab::Hold};

/// A soft body: the model it is made of and how it is stepped. Spawn it; the rest comes by itself.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::ModalBody;
/// fn setup(mut commands: Commands, assets: Res<AssetServer>) {
///     commands.spawn((ModalBody::new(assets.load("pip.modal")), Transform::from_xyz(0.0, 1.0, 0.0)));
/// }
/// ```
///
/// With the feature `render`, add a `MeshMaterial3d` and the deformed surface is drawn with it.
///
/// The entity's `GlobalTransform` places the body: rotation, translation and a positive, uniform scale. The scale multiplies
/// lengths and forces; masses, stiffness (N/m) and frequencies stay as baked. Moving the transform of an anchored body moves its
/// anchors without inertia (quasi-static). A free body writes its own motion into its `Transform` each frame and must have no
/// parent; writing the transform puts it elsewhere with its velocity kept.
///
/// A change of a field takes effect at the end of the frame; the shape and its motion are kept where the model is the same. A change that
/// makes no body is refused once ([`BodyRefused`](crate::BodyRefused)), and the body goes on with the settings it had.
#[derive(Component, Reflect, Debug, Clone, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
#[require(Transform, Visibility, Driven)]
pub struct ModalBody {
    /// The baked body. Swapping the handle, or the asset behind it, makes a new body at rest; grabs whose vertex it has stay.
    pub model: Handle<ModalAsset>,
    /// How it is stepped: integrator, warp, gravity, damping, stiffness, relaxation. Gravity is in
    /// world axes and world lengths.
    #[reflect(remote = ReflectedSettings)]
    pub settings: StepSettings,
    /// How many of the model's modes are kept, lowest first: the level of detail. Default: `None`, all.
    pub modes: Option<usize>,
    /// Whether the processor writes the surface (see `SurfaceDeformation`) from a basis in half
    /// precision: in half the time where the surface is large, and off by some 5e-5 of the body's
    /// size where it is pulled by a fifth of it. Default: `false`.
    pub half_basis: bool,
    /// The body rests once the root mean square speed of its mass stays below this, m/s of the model,
    /// for half a second with nobody holding it: it is then neither stepped nor uploaded until
    /// something touches it. Zero never rests. Default: `1e-4`.
    pub rest_speed: f64,
}

impl Default for ModalBody {
    /// Every setting at its default, and no model yet.
    fn default() -> Self {
        Self::new(Handle::default())
    }
}

impl ModalBody {
    /// A body of `model` with every setting at its default.
    pub fn new(model: Handle<ModalAsset>) -> Self {
        Self { model, settings: StepSettings::default(), modes: None, half_basis: false, rest_speed: 1e-4 }
    }

    /// What the solver is told, for a step of `step` seconds under a uniform scale of `scale`.
    pub(crate) fn config(&self, step: f64, scale: f64) -> BodyConfig {
        BodyConfig {
            settings: StepSettings {
                gravity: self.settings.gravity.map(|acceleration| acceleration / scale),
                ..self.settings
            },
            step,
            modes: self.modes,
            precision: if self.half_basis { Precision::Half } else { Precision::Single },
        }
    }
}

// The solver's types know no engine. Reflection sees their fields through these, which the compiler
// holds to be the same.

#[reflect_remote(StepSettings)]
#[derive(Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) struct ReflectedSettings {
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
#[derive(Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub(crate) struct ReflectedRelaxation {
    ratio: f64,
    time: f64,
}

/// Who moves a body. Default: [`Local`](Self::Local).
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum Driven {
    /// This app steps it.
    #[default]
    Local,
    /// Somebody else writes its [`VisualState`](crate::VisualState) and its grabs' [`GrabForce`](crate::GrabForce): the network, a
    /// recording, a script. It is not stepped here.
    Remote,
}

/// The pointer passes through this body: a ghost, a backdrop.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct NoPointerGrab;

/// A body that has its model and is simulated; the plugin adds it to a [`ModalBody`] once the asset is there.
///
/// Reflection shows how it stands, not the solver, which is [`body`](Self::body)'s to show.
#[derive(Component, Reflect, Debug)]
#[reflect(Component, from_reflect = false)]
pub struct BodyState {
    /// Its world is the entity's world divided by `scale`.
    #[reflect(ignore)]
    pub(crate) body: Body,
    #[reflect(ignore)]
    pub(crate) scale: f64,
    /// The transform that was last looked at: taken, refused, or written by the body itself.
    #[reflect(ignore)]
    pub(crate) placed: Option<Affine3A>,
    #[reflect(ignore)]
    pub(crate) held: Vec<Held>,
    /// A step was refused and the warning given.
    pub(crate) faulted: bool,
    /// Seconds for which it has been slower than the rest speed.
    pub(crate) quiet: f64,
    pub(crate) resting: bool,
    /// There is a new state to publish.
    pub(crate) stepped: bool,
}

/// A grab as the solver has it.
#[derive(Debug)]
pub(crate) struct Held {
    pub entity: Entity,
    /// `None`: refused, and the refusal was told.
    pub id: Option<GrabId>,
    pub hold: Hold,
    /// Refused only because the body had no place left; it is tried again when one is free.
    pub waiting: bool,
    /// The current target was refused and the warning given.
    pub refusing: bool,
}

impl BodyState {
    pub(crate) fn new(body: Body) -> Self {
        Self {
            body,
            scale: 1.0,
            placed: None,
            held: Vec::new(),
            faulted: false,
            quiet: 0.0,
            resting: false,
            stepped: false,
        }
    }

    /// Whether this transform was looked at before (one with NaN in it, too).
    pub(crate) fn is_placed(&self, affine: &Affine3A) -> bool {
        let bits = |affine: &Affine3A| affine.to_cols_array().map(f32::to_bits);
        self.placed.is_some_and(|placed| bits(&placed) == bits(affine))
    }

    /// Whether the entity's transform has been taken over, which the first tick does.
    pub fn has_place(&self) -> bool {
        self.placed.is_some()
    }

    /// The simulated body: its modal state, its frame, its grabs.
    pub fn body(&self) -> &Body {
        &self.body
    }

    /// The simulated body, to be changed: it wakes. What is configured here holds until a field of the [`ModalBody`] changes, which sets all
    /// of them again. Grabs made here are the caller's to release; those of [`Grab`](crate::Grab) entities
    /// are not to be touched.
    pub fn body_mut(&mut self) -> &mut Body {
        self.wake();
        &mut self.body
    }

    /// The solver's name for the grab that a [`Grab`](crate::Grab) entity is, to ask [`body`](Self::body) about it. `None` before the first
    /// tick of the grab, when it was refused or waits for a place, and on a body that somebody else moves.
    pub fn grab_id(&self, grab: Entity) -> Option<GrabId> {
        self.held.iter().find(|held| held.entity == grab)?.id
    }

    /// The baked model.
    pub fn model(&self) -> &Arc<ModalModel> {
        self.body.model()
    }

    /// Whether the shape is bent by modal warping.
    pub fn warps(&self) -> bool {
        self.body.config().settings.warp
    }

    /// What the surface is written from on the processor.
    pub fn precision(&self) -> Precision {
        self.body.config().precision
    }

    /// The uniform scale that the entity's transform gives the body.
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Whether it is at rest and left alone.
    pub fn is_resting(&self) -> bool {
        self.resting
    }

    /// Steps it again until it comes to rest by itself.
    pub fn wake(&mut self) {
        self.quiet = 0.0;
        self.resting = false;
    }

    /// The surface at modal coordinates `q`: positions in body axes, m, one a surface vertex. For a question now and then (a click); the
    /// drawn surface has a faster way.
    pub fn positions_at(&self, q: &[f64]) -> Vec<[f32; 3]> {
        let coordinates: Vec<f32> = q.iter().map(|&q| q as f32).collect();
        let mut positions = self.model().surface().positions().to_vec();
        self.model().basis().reconstruct(&coordinates, self.warps(), &mut positions);
        positions
    }
}
