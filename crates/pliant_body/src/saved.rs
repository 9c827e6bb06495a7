//! The saved form of a body.

use std::{any::TypeId, sync::Arc};

use bevy::{
    ecs::{
        entity::{EntityMapper, MapEntities},
        reflect::{AppTypeRegistry, ReflectComponent},
    },
    math::{Affine3A, DVec3},
    prelude::*,
    reflect::{FromType, ReflectDeserialize, ReflectFromReflect, ReflectSerialize, TypeRegistry},
};
use pliant_modal::{Body, ModalModel, SavedBody, StepError};
use serde::{Deserialize, Serialize};

use crate::{BodyState, HeldShapesCache, ModalBody, body::HeldBody, grab::GrabHold, gravity::Pull};

/// A [`BodyState`] as data. A world that is saved, as a `DynamicWorld` or otherwise by reflection,
/// has it where the live world has a [`BodyState`].
///
/// When such a world is loaded, the body goes on to the bit as the saved one would have: its
/// state, its grabs and what it touches. The body is there as soon as its model is loaded and the
/// own shapes of its held patches are made again, and this component goes. Pause `Time<Virtual>`
/// until all bodies are there, where they have to go on together. If the data do not fit the model,
/// the body starts at rest, and [`BodyRefused`](crate::BodyRefused) reports why.
/// Attachments begin anew, without the force of the last step.
///
/// Two things begin anew: motion of the entity that the body feels ([`Inertia`](crate::Inertia)),
/// and grabs that were made through [`BodyState::body_mut`], which are not saved.
#[derive(Component, Reflect, Debug, Default, Clone, PartialEq, Serialize, Deserialize)]
#[reflect(opaque)]
#[reflect(Component, Debug, Default, Clone, PartialEq, Serialize, Deserialize, from_reflect = false)]
#[component(map_entities)]
pub struct SavedState {
    body: SavedBody,
    scale: f64,
    placed: Option<[f32; 12]>,
    /// Gravity of its settings and of the scene, m/s^2.
    pull: [[f64; 3]; 2],
    held: Vec<SavedGrab>,
    faulted: bool,
    quiet: f64,
    resting: bool,
    layers: Option<[u32; 2]>,
}

/// A [`HeldBody`] with its index among the grabs of the body. `None` for one that was refused.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct SavedGrab {
    /// Bits of the entity.
    entity: u64,
    index: Option<usize>,
    hold: GrabHold,
    waiting: bool,
    refusing: bool,
}

impl MapEntities for SavedState {
    fn map_entities<M: EntityMapper>(&mut self, mapper: &mut M) {
        let mut map = |bits: u64| match Entity::try_from_bits(bits) {
            Some(entity) => mapper.get_mapped(entity).to_bits(),
            None => bits,
        };
        self.body.map_keys(&mut map);
        self.held.iter_mut().for_each(|held| held.entity = map(held.entity));
    }
}

impl FromReflect for SavedState {
    /// Takes the value itself, or that of a live [`BodyState`].
    fn from_reflect(value: &dyn PartialReflect) -> Option<Self> {
        let live = || value.try_downcast_ref::<BodyState>().map(Self::of);
        value.try_downcast_ref::<Self>().cloned().or_else(live)
    }
}

impl SavedState {
    fn of(state: &BodyState) -> Self {
        let saved: Vec<_> = state.held.iter().filter_map(|held| held.id).collect();
        // The solver has its grabs in the order of their identifiers.
        let order: Vec<_> = state.body.grabs().filter(|id| saved.contains(id)).collect();
        let held = state.held.iter().map(|held| SavedGrab {
            entity: held.entity.to_bits(),
            index: held.id.and_then(|id| order.iter().position(|other| *other == id)),
            hold: held.hold,
            waiting: held.waiting,
            refusing: held.refusing,
        });
        Self {
            body: state.body.save(|id| saved.contains(&id)),
            scale: state.scale,
            placed: state.placed.map(|affine| affine.to_cols_array()),
            pull: [state.pull.own.into(), state.pull.scene.into()],
            held: held.collect(),
            faulted: state.faulted,
            quiet: state.quiet,
            resting: state.resting,
            layers: state.layers,
        }
    }

    /// Makes the body that was saved. `None` while the own shapes of its held patches are made.
    pub(crate) fn restore(
        &self,
        body: &ModalBody,
        model: &Arc<ModalModel>,
        cache: &mut HeldShapesCache,
    ) -> Option<Result<BodyState, StepError>> {
        let shapes = cache.get(model, self.body.shapes())?;
        let (settings, step) = self.body.settings();
        let mut config = body.config(step, 1.0, Pull::default());
        config.settings = *settings;
        let (restored, ids) = match Body::restore(model.clone(), config, &self.body, shapes) {
            Ok(restored) => restored,
            Err(error) => return Some(Err(error)),
        };
        let held = self.held.iter().filter_map(|held| {
            let SavedGrab { index, hold, waiting, refusing, .. } = *held;
            let id = index.and_then(|index| ids.get(index)).copied();
            Some(HeldBody { entity: Entity::try_from_bits(held.entity)?, id, hold, waiting, refusing })
        });
        let scale = if self.scale.is_finite() && self.scale > 0.0 { self.scale } else { 1.0 };
        let [own, scene] = self.pull.map(DVec3::from);
        let quiet = if self.quiet.is_finite() { self.quiet } else { 0.0 };
        Some(Ok(BodyState {
            scale,
            placed: self.placed.map(|cols| Affine3A::from_cols_array(&cols)),
            pull: Pull { own, scene, asked: scene },
            held: held.collect(),
            faulted: self.faulted,
            quiet,
            resting: self.resting,
            layers: self.layers,
            ..BodyState::new(restored)
        }))
    }
}

/// Lets worlds that are saved by reflection have [`SavedState`] in place of [`BodyState`].
pub(crate) fn register(app: &mut App) {
    app.register_type::<SavedState>().register_type::<BodyState>();
    let registry = app.world().resource::<AppTypeRegistry>().clone();
    let mut registry = registry.write();
    registry.register_type_data::<SavedState, ReflectFromReflect>();
    let Some(state) = registry.get_mut(TypeId::of::<BodyState>()) else { return };
    state.insert(<ReflectFromReflect as FromType<SavedState>>::from_type());
    let mut component = <ReflectComponent as FromType<BodyState>>::from_type().fn_pointers().clone();
    component.insert = |entity, value, _: &TypeRegistry| {
        if let Some(saved) = SavedState::from_reflect(value) {
            entity.insert(saved);
        }
    };
    component.apply_or_insert_mapped = |entity, value, _, mut mapper, _| {
        if let Some(mut saved) = SavedState::from_reflect(value) {
            saved.map_entities(&mut mapper);
            entity.insert(saved);
        }
    };
    // A live body is changed by its own methods.
    component.apply = |_, _| ();
    component.copy = |from, to, source, target, _| {
        let saved = from.get::<BodyState>(source).map(SavedState::of);
        if let (Some(saved), Ok(mut target)) = (saved, to.get_entity_mut(target)) {
            target.insert(saved);
        }
    };
    state.insert(ReflectComponent::new(component));
}
