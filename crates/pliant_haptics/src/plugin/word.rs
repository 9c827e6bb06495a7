//! After a tick: what the simulation tells each device's loop.

use bevy::{math::DVec3, prelude::*};
use pliant_body::{BodyState, Driven, GrabForce, GrabOf};
use pliant_modal::GrabId;

use super::{HapticDevices, HapticTool, ToolGrabs, ToolOffset};
use crate::{FeltGrab, HeldGrab, LocalModel, MAX_CONTACTS, ModalLocal};

type HeldGrabs<'w, 's> =
    Query<'w, 's, (Entity, &'static GrabOf, &'static GrabForce, Option<&'static ToolOffset>)>;

pub(crate) fn publish(
    time: Res<Time>,
    mut devices: ResMut<HapticDevices>,
    tools: Query<(&HapticTool, Option<&ToolGrabs>)>,
    grabs: HeldGrabs,
    bodies: Query<(&BodyState, &Driven)>,
) {
    let period = time.delta_secs_f64();
    if period <= 0.0 {
        // Paused: the simulation is silent, and the loop fades.
        return;
    }
    for (tool, held) in &tools {
        let Some(entry) = devices.entry(tool.device) else { continue };
        let entities = held.map_or(&[][..], ToolGrabs::entities);
        let held: Vec<_> = entities.iter().filter_map(|&e| grabs.get(e).ok()).take(MAX_CONTACTS).collect();
        let local = single_body(&held, &bodies);

        let (seen, coupling) = (entry.seen, entry.status.coupling);
        let (rate, writer) = (entry.running.get().rate(), &mut entry.writer);
        if let Some((state, ids)) = &local {
            let scale = state.scale();
            let wrong = entry.running.get().publish(|model: &mut LocalModel| {
                writer.write(state.body(), ids, &coupling, scale, seen, model).err()
            });
            if let Some(error) = wrong {
                warn!("{}: the hand was told of no contact: {error}", entry.status.info.name);
            }
        } else {
            let felt: Vec<FeltGrab> = held
                .iter()
                .map(|(entity, _, force, offset)| FeltGrab {
                    key: entity.to_bits(),
                    offset: offset.map_or(DVec3::ZERO, |o| o.0).into(),
                    point: force.point.into(),
                    force: force.force.into(),
                })
                .collect();
            let config = coupling.grab_config(tool.motion_scale, tool.force_scale);
            let stiffness = config.stiffness.unwrap_or(0.0);
            let damping = stiffness * config.relaxation;
            entry
                .running
                .get()
                .publish(|model| writer.write_forces(&felt, stiffness, damping, period, seen, model));
        }

        // A body for the loop to step itself: made here, where memory may be had, whenever what is held changes.
        let wanted: Vec<Entity> =
            if tool.modal && local.is_some() { held.iter().map(|(e, ..)| *e).collect() } else { Vec::new() };
        if wanted != entry.modal_for {
            let modal = match &local {
                Some((state, ids)) if !wanted.is_empty() => {
                    match ModalLocal::new(state.body(), ids, state.scale(), rate) {
                        Ok(modal) => Some(Box::new(modal)),
                        Err(error) => {
                            warn!(
                                "{}: the loop does not step the body itself: {error}",
                                entry.status.info.name
                            );
                            None
                        }
                    }
                }
                _ => None,
            };
            if entry.running.get().set_modal(modal) {
                entry.modal_for = wanted;
            }
        }
    }
}

/// The one body that everything is held on, if it is one and stepped here, and the solver's names of the grabs.
fn single_body<'a>(
    held: &[(Entity, &GrabOf, &GrabForce, Option<&ToolOffset>)],
    bodies: &'a Query<(&BodyState, &Driven)>,
) -> Option<(&'a BodyState, Vec<HeldGrab>)> {
    let (_, of, ..) = held.first()?;
    if held.iter().any(|(_, other, ..)| other.0 != of.0) {
        return None;
    }
    let (state, driven) = bodies.get(of.0).ok()?;
    if *driven == Driven::Remote {
        return None;
    }
    let ids = held.iter().map(|(_, _, force, offset)| {
        let id = solver_name(state, force)?;
        Some(HeldGrab { id, offset: offset.map_or(DVec3::ZERO, |o| o.0).into() })
    });
    Some((state, ids.collect::<Option<Vec<_>>>()?))
}

/// The solver's grab whose published force this is: the one whose patch is exactly where the force says.
fn solver_name(state: &BodyState, force: &GrabForce) -> Option<GrabId> {
    let body = state.body();
    body.grabs()
        .find(|&id| body.grab_position(id).is_ok_and(|p| DVec3::from(p) * state.scale() == force.point))
}
