//! The picking backend: which deformed surfaces lie under the pointers.

use bevy::{
    camera::{primitives::Aabb, visibility::RenderLayers},
    math::Affine3A,
    picking::{
        PickingSystems,
        backend::{HitData, PointerHits, ray::RayMap},
    },
    prelude::*,
};

use crate::{BodyState, NoPointerGrab, VisualState, pick_surface};

/// Adds the backend; [`PliantBodyPlugin`](crate::PliantBodyPlugin) describes it.
pub(crate) fn build(app: &mut App) {
    app.add_systems(PreUpdate, update_hits.in_set(PickingSystems::Backend).run_if(resource_exists::<RayMap>));
}

/// The data of a body that picking needs.
type Candidate = (
    Entity,
    &'static BodyState,
    &'static VisualState,
    &'static GlobalTransform,
    Option<&'static Aabb>,
    Option<&'static InheritedVisibility>,
    Option<&'static RenderLayers>,
);

fn update_hits(
    rays: Res<RayMap>,
    cameras: Query<(&Camera, Option<&RenderLayers>)>,
    bodies: Query<Candidate, Without<NoPointerGrab>>,
    mut output: MessageWriter<PointerHits>,
) {
    let mut picks: Vec<_> = rays
        .iter()
        .filter_map(|(&id, ray)| {
            let (camera, layers) = cameras.get(id.camera).ok()?;
            Some((id, *ray, camera.order, layers.unwrap_or_default(), Vec::new()))
        })
        .collect();
    for (body, state, visual, place, bounds, visible, layers) in &bodies {
        if visible.is_some_and(|visible| !visible.get()) {
            continue;
        }
        let affine = place.affine();
        let inverse = affine.inverse();
        // The reconstruction is the larger cost, and all rays share it.
        let mut positions = None;
        for (id, ray, _, seen, picked) in &mut picks {
            if !seen.intersects(layers.unwrap_or_default()) {
                continue;
            }
            // The direction keeps its length in the body's axes, so that distances along it can be
            // compared between bodies.
            let origin = inverse.transform_point3(ray.origin);
            let direction = inverse.transform_vector3(*ray.direction);
            if bounds.is_some_and(|bounds| !meets(bounds, origin, direction)) {
                continue;
            }
            let positions = positions.get_or_insert_with(|| state.positions(visual));
            let triangles = state.model().surface().triangles();
            let (origin, direction) = (origin.as_dvec3().into(), direction.as_dvec3().into());
            let Some(hit) = pick_surface(positions, triangles, origin, direction) else { continue };
            let depth = hit.distance as f32;
            let normal = normal(positions, triangles[hit.triangle], &affine);
            let point = Some(ray.get_point(depth));
            picked.push((body, HitData::new_with_extra(id.camera, depth, point, normal, hit)));
        }
    }
    for (id, _, order, _, picked) in picks {
        if !picked.is_empty() {
            output.write(PointerHits::new(id.pointer, picked, order as f32));
        }
    }
}

/// Tests whether a ray meets a box, by slabs. A ray that cannot be judged, such as one with a NaN,
/// counts as meeting the box.
fn meets(bounds: &Aabb, origin: Vec3, direction: Vec3) -> bool {
    let (low, high) = (Vec3::from(bounds.min()), Vec3::from(bounds.max()));
    let (a, b) = ((low - origin) / direction, (high - origin) / direction);
    let enter = a.min(b).max_element();
    let leave = a.max(b).min_element();
    // Rounding must not cut off a hit on the rim of a flat box.
    let slack = 1e-4 * (1.0 + leave.abs());
    !(enter > leave + slack || leave < -slack)
}

/// The outward unit normal of a triangle, world axes.
fn normal(positions: &[[f32; 3]], triangle: [u32; 3], affine: &Affine3A) -> Option<Vec3> {
    let corner = |vertex: u32| {
        let point = positions.get(vertex as usize)?;
        Some(affine.transform_point3(Vec3::from(*point)))
    };
    let [a, b, c] = [corner(triangle[0])?, corner(triangle[1])?, corner(triangle[2])?];
    // A mirrored transform turns the winding over.
    let turned = affine.matrix3.determinant() < 0.0;
    let normal = (b - a).cross(c - a).try_normalize()?;
    Some(if turned { -normal } else { normal })
}
