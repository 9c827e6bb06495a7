//! The body as components: what a user writes ([`ModalBody`], [`Driven`]) and what the plugin keeps ([`BodyState`]).

use std::sync::Arc;

use bevy::{
    math::{Affine3A, DVec3},
    prelude::*,
};
use pliant_modal::{Body, BodyConfig, GrabId, Integrator, ModalModel, Precision, Relaxation};

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
    /// How a step is integrated. Default: [`Integration::Exact`].
    pub integrator: Integration,
    /// How many of the model's modes are kept, lowest first: the level of detail. Default: `None`, all.
    pub modes: Option<usize>,
    /// Bend by modal warping, right for large rotations; `false` is the plain linear shape. Default: `true`.
    pub warp: bool,
    /// Multiplies the baked damping of every mode, 0 or more. Default: `1.0`.
    pub damping_scale: f64,
    /// Multiplies the baked stiffness, 1e-6 to 1e6, as though it were baked with so many times the Young's modulus: frequencies go with its root.
    /// May be changed while the body moves. Default: `1.0`.
    pub stiffness_scale: f64,
    /// A material that relaxes under a held strain and creeps under a held force. Default: `None`, elastic.
    pub relaxation: Option<Viscoelastic>,
    /// Newton corrections in one step of the grabs on a body that is bent by warping, a number from 1 to 8 (what is outside is taken as
    /// the nearest of them). Default: `2`.
    pub corrections: usize,
    /// Where the processor writes the surface (see `SurfaceDeformation`): from a basis in half precision, in half the time where the surface is large,
    /// and off by some 5e-5 of the body's size where it is pulled by a fifth of it. Default: `false`.
    pub half_basis: bool,
    /// Acceleration of gravity, m/s^2, in world axes. Default: zero, as a bake at rest is usually wanted as it was drawn.
    pub gravity: DVec3,
    /// The body rests once the root mean square speed of its mass stays below this, m/s of the model, for half a second with
    /// nobody holding it: it is then neither stepped nor uploaded until something touches it. Zero never rests. Default: `1e-4`.
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
        Self {
            model,
            integrator: Integration::default(),
            modes: None,
            warp: true,
            damping_scale: 1.0,
            stiffness_scale: 1.0,
            relaxation: None,
            corrections: BodyConfig::default().corrections,
            half_basis: false,
            gravity: DVec3::ZERO,
            rest_speed: 1e-4,
        }
    }

    /// What the solver is told, for a step of `step` seconds under a uniform scale of `scale`.
    pub(crate) fn config(&self, step: f64, scale: f64) -> BodyConfig {
        BodyConfig {
            step,
            integrator: self.integrator.into(),
            second_order: true,
            warp: self.warp,
            modes: self.modes,
            gravity: (self.gravity / scale).into(),
            damping_scale: self.damping_scale,
            stiffness_scale: self.stiffness_scale,
            relaxation: self.relaxation.map(Relaxation::from),
            corrections: self.corrections,
            precision: if self.half_basis { Precision::Half } else { Precision::Single },
        }
    }
}

/// The material of a [`ModalBody`] that relaxes: [`Relaxation`], which knows no engine, as a field that reflection sees.
///
/// The stress under a strain that is held falls to `1 - ratio` of what it was, as `1 - ratio (1 - exp(-t / time))`. Default: half of the
/// stiffness within a second.
#[derive(Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub struct Viscoelastic {
    /// Share of the baked stiffness that relaxes away, 0 or more and below 1. Default: `0.5`.
    pub ratio: f64,
    /// Relaxation time under a held strain, s, above 0. Default: `1.0`.
    pub time: f64,
}

impl Default for Viscoelastic {
    fn default() -> Self {
        Self { ratio: 0.5, time: 1.0 }
    }
}

impl From<Viscoelastic> for Relaxation {
    fn from(Viscoelastic { ratio, time }: Viscoelastic) -> Self {
        Self { ratio, time }
    }
}

/// How a [`ModalBody`] is stepped: [`Integrator`], which knows no engine, as a field that reflection sees.
#[derive(Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub enum Integration {
    /// [`Integrator::Exact`]: closed form, exact for a force that is constant over the step.
    #[default]
    Exact,
    /// [`Integrator::Newmark`]: average acceleration.
    Newmark,
    /// [`Integrator::GeneralizedAlpha`]: the form whose accelerations are streamed.
    GeneralizedAlpha {
        /// Spectral radius at infinite frequency, 0 to 1; 0.5 suits hands.
        rho_inf: f64,
    },
}

impl From<Integration> for Integrator {
    fn from(integration: Integration) -> Self {
        match integration {
            Integration::Exact => Self::Exact,
            Integration::Newmark => Self::Newmark,
            Integration::GeneralizedAlpha { rho_inf } => Self::GeneralizedAlpha { rho_inf },
        }
    }
}

/// Who moves a body. Default: [`Local`](Self::Local).
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum Driven {
    /// This app steps it.
    #[default]
    Local,
    /// Somebody else writes its [`ShownState`](crate::ShownState) and its grabs' [`GrabForce`](crate::GrabForce): the network, a
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
        self.body.config().warp
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
