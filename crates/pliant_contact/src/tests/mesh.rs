//! Convex hulls and triangle meshes, against the shapes that they are made of.

use bevy::{
    asset::RenderAssetUsages,
    mesh::{Indices, PrimitiveTopology},
    prelude::*,
};
use pliant_modal::{Cuboid, ObstacleShape};

use super::*;
use crate::{DistanceField, mesh::Solids, obstacle::InWorldOf};

/// A mesh of boxes (center, half edges), each with vertices of its own for each face.
fn boxes(all: &[([f32; 3], [f32; 3])]) -> Mesh {
    let (mut positions, mut indices) = (Vec::new(), Vec::new());
    for (center, half) in all {
        for axis in 0..3 {
            for sign in [-1.0f32, 1.0] {
                let first = positions.len() as u32;
                for (u, v) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0f32)] {
                    let mut place = [0.0; 3];
                    (place[axis], place[(axis + 1) % 3], place[(axis + 2) % 3]) = (sign, u * sign, v);
                    positions.push(std::array::from_fn::<f32, 3, _>(|k| center[k] + place[k] * half[k]));
                }
                indices.extend([0, 1, 2, 0, 2, 3].map(|k| first + k));
            }
        }
    }
    triangles(positions, indices)
}

fn triangles(positions: Vec<[f32; 3]>, indices: Vec<u32>) -> Mesh {
    Mesh::new(PrimitiveTopology::TriangleList, RenderAssetUsages::default())
        .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, positions)
        .with_inserted_indices(Indices::U32(indices))
}

/// The solid of a mesh, without an app.
fn solid(mesh: Mesh, hull: bool, scale: DVec3) -> Result<InWorldOf, pliant_modal::StepError> {
    let mut meshes = Assets::<Mesh>::default();
    let handle = meshes.add(mesh);
    let mut solids = Solids::default();
    let made = loop {
        match solids.get(&meshes, &handle, hull, scale) {
            Some(made) => break made?,
            None => std::thread::yield_now(),
        }
    };
    Ok(InWorldOf { shape: made, factor: 1.0 })
}

fn points() -> impl Iterator<Item = nalgebra::Vector3<f64>> {
    (1..400).map(|i| {
        let at = |k: f64| 1.5 * (f64::from(i) * k).sin();
        nalgebra::Vector3::new(at(0.7), at(1.3), at(2.1))
    })
}

/// Compares with a shape whose distance is known, wherever that has a gradient.
fn same(found: &impl ObstacleShape, truth: impl Fn(&nalgebra::Vector3<f64>) -> f64) {
    for point in points() {
        let (at, distance) = (found.at(&point), truth(&point));
        assert!((at.distance - distance).abs() < 1e-6, "{point}: {} for {distance}", at.distance);
        assert!((at.normal.norm() - 1.0).abs() < 1e-12);
        // The way along the normal by the distance ends at the surface.
        let end = found.at(&(point - at.distance * at.normal));
        assert!(end.distance.abs() < 1e-6, "{point}: {}", end.distance);
    }
}

#[test]
fn a_box_of_triangles_is_a_box_whichever_way_it_was_made() {
    let cuboid = |half: [f64; 3]| {
        let rotation = [0.0, 0.0, 0.0, 1.0];
        Cuboid { center: [0.1, 0.2, -0.3], rotation, half, round: 0.0 }
    };
    let exact = cuboid([0.5, 0.25, 0.75]);
    let mesh = || boxes(&[([0.1, 0.2, -0.3], [0.5, 0.25, 0.75])]);
    let mut inside_out = mesh();
    inside_out.invert_winding().unwrap();
    for hull in [false, true] {
        for mesh in [mesh(), inside_out.clone()] {
            let found = solid(mesh, hull, DVec3::ONE).unwrap();
            same(&found, |p| exact.at(p).distance);
        }
        // Of another scale in each direction, and mirrored.
        let scale = DVec3::new(-2.0, 1.0, 0.5);
        let scaled = Cuboid { center: [-0.2, 0.2, -0.15], half: [1.0, 0.25, 0.375], ..exact };
        let found = solid(mesh(), hull, scale).unwrap();
        same(&found, |p| scaled.at(p).distance);
        // In the world of a body on an entity of twice the scale, all lengths are half as long.
        let half = Cuboid { center: [0.05, 0.1, -0.15], half: [0.25, 0.125, 0.375], ..exact };
        let InWorldOf { shape, .. } = solid(mesh(), hull, DVec3::ONE).unwrap();
        same(&InWorldOf { shape, factor: 2.0 }, |p| half.at(p).distance);
    }
}

#[test]
fn a_mesh_may_be_hollow_and_a_hull_is_not() {
    // Two boxes that do not touch. Between them a mesh has room, and a hull has none.
    let pair = [([-0.6, 0.0, 0.0], [0.2, 0.5, 0.5]), ([0.6, 0.0, 0.0], [0.2, 0.5, 0.5])];
    let part = |x: f64, half: f64| Cuboid {
        center: [x, 0.0, 0.0],
        rotation: [0.0, 0.0, 0.0, 1.0],
        half: [half, 0.5, 0.5],
        round: 0.0,
    };
    let found = solid(boxes(&pair), false, DVec3::ONE).unwrap();
    same(&found, |p| part(-0.6, 0.2).at(p).distance.min(part(0.6, 0.2).at(p).distance));
    let found = solid(boxes(&pair), true, DVec3::ONE).unwrap();
    same(&found, |p| part(0.0, 0.8).at(p).distance);
}

#[test]
fn what_bevy_makes_is_closed_and_as_exact_as_its_facets() {
    let (around, across) = (0.8, 0.3);
    let torus = Torus { major_radius: around, minor_radius: across };
    let mesh = torus.mesh().major_resolution(96).minor_resolution(48).build();
    let found = solid(mesh, false, DVec3::ONE).unwrap();
    // Between its rows a facet is off by up to r (1 - cos(pi / n)): inwards, but around the hole.
    let facet = |r: f64, n: f64| r * (1.0 - (std::f64::consts::PI / n).cos());
    let bound = facet(1.1, 96.0) + facet(0.3, 48.0);
    for p in points() {
        let truth = ((p.x.hypot(p.z) - f64::from(around)).hypot(p.y)) - f64::from(across);
        let off = found.at(&p).distance - truth;
        let low = -facet(0.8, 96.0) - 1e-6;
        assert!((low..bound + 1e-6).contains(&off), "{p}: {off}, {low} to {bound}");
    }
    let ball = Sphere::new(0.5).mesh().uv(64, 48);
    for hull in [false, true] {
        let found = solid(ball.clone(), hull, DVec3::ONE).unwrap();
        let bound = facet(0.5, 64.0) + facet(0.5, 96.0);
        for p in points() {
            let off = found.at(&p).distance - (p.norm() - 0.5);
            assert!((-1e-6..bound + 1e-6).contains(&off), "{p}: {off}, at most {bound}");
        }
    }
}

#[test]
fn what_is_no_solid_is_refused_and_nothing_panics() {
    let flat = || triangles(vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], vec![0, 2, 1]);
    assert!(
        solid(flat(), false, DVec3::ONE).unwrap().at(&nalgebra::Vector3::new(0.2, 0.3, 0.2)).distance > 0.29
    );
    let nan = triangles(vec![[f32::NAN; 3], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], vec![0, 1, 2]);
    let lines = Mesh::new(PrimitiveTopology::LineList, RenderAssetUsages::default());
    let beyond = triangles(vec![[0.0; 3]; 3], vec![0, 7, 9]);
    let bad =
        [(flat(), true), (nan, false), (lines, false), (beyond, false), (triangles(vec![], vec![]), true)];
    for (mesh, hull) in bad {
        let refused = solid(mesh, hull, DVec3::ONE);
        assert!(refused.is_err(), "{refused:?}");
    }
    assert!(solid(flat(), false, DVec3::ZERO).is_err(), "a scale of zero");
    // Any triangles whatever are a solid or an error, and distances are finite.
    for seed in 0..40u32 {
        let mut state = seed.wrapping_mul(0x9E37_79B9) | 1;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            state
        };
        let count = 3 + next() % 30;
        // On a coarse grid, so that points coincide and lie in planes.
        let positions: Vec<[f32; 3]> =
            (0..count).map(|_| [0; 3].map(|_: i32| (next() % 5) as f32 * 0.25)).collect();
        let indices: Vec<u32> = (0..3 * count).map(|_| next() % (count + 1)).collect();
        for hull in [false, true] {
            if let Ok(made) = solid(triangles(positions.clone(), indices.clone()), hull, DVec3::ONE) {
                for point in points().take(50) {
                    let at = made.at(&point);
                    assert!(at.distance.is_finite() && (at.normal.norm() - 1.0).abs() < 1e-9, "{seed}");
                }
            }
        }
    }
}

fn mesh_app() -> App {
    let mut app = app();
    app.init_asset::<Mesh>();
    app
}

/// Updates until the task pool has made the solids.
fn wait(app: &mut App, obstacle: Entity) {
    for _ in 0..2000 {
        app.update();
        if app.world().get::<crate::obstacle::Motion>(obstacle).is_some() {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    panic!("no solid was made");
}

#[test]
fn a_body_rests_on_triangles_and_on_their_distance_field_as_on_a_floor() {
    for kind in 0..3 {
        let mut app = mesh_app();
        let table = boxes(&[([0.0, -0.25, 0.0], [1.0, 0.25, 1.0])]);
        let shape = if kind == 2 {
            let field = DistanceField::of_mesh(&table, 0.07).unwrap();
            Obstacle::Field(app.world_mut().resource_mut::<Assets<DistanceField>>().add(field))
        } else {
            let table = app.world_mut().resource_mut::<Assets<Mesh>>().add(table);
            if kind == 1 { Obstacle::Hull(table) } else { Obstacle::Mesh(table) }
        };
        // The entity's scale of 2 is the mesh's: the top is at y = 0.3.
        let at = Transform::from_xyz(0.0, 0.3, 0.0).with_scale(Vec3::splat(2.0));
        let table = app.world_mut().spawn((shape, at)).id();
        wait(&mut app, table);
        let body = spawn(&mut app, Transform::from_xyz(0.0, 0.5, 0.0), ());
        seconds(&mut app, 6.0);
        let force = contacts(&app, body).force();
        assert!((force - weight() * DVec3::Y).length() < 1e-3 * weight(), "{force} N for {} N", weight());
        let height = center(&app, body).y;
        assert!((height - 0.3 - 0.5 * EDGE).abs() < 0.02 * EDGE, "the center is at {height}");
        assert!(contacts(&app, body).0.iter().all(|c| c.other == table && c.penetration < 2e-3 * EDGE));
        assert!(state(&app, body).is_resting());
    }
}

#[test]
fn a_mesh_that_turns_carries_a_body() {
    let mut app = mesh_app();
    let table = boxes(&[([0.0, -0.25, 0.0], [1.0, 0.25, 1.0])]);
    let table = app.world_mut().resource_mut::<Assets<Mesh>>().add(table);
    // Turned by a little more in each tick, the scale of the entity's matrix changes by rounding.
    let at = Transform::from_scale(Vec3::splat(0.7));
    let table = app.world_mut().spawn((Obstacle::Mesh(table), at)).id();
    wait(&mut app, table);
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.5 * EDGE as f32 + 0.005, 0.0), ());
    let speed = 0.6f32;
    for tick in 0..240 {
        app.world_mut().get_mut::<Transform>(table).unwrap().rotate_y(speed * STEP as f32);
        app.update();
        if tick < 30 {
            continue; // It is being placed, and falls by 5 mm.
        }
        assert!(contacts(&app, body).touches(table), "tick {tick}: it has left the table");
        let height = center(&app, body).y;
        assert!((height - 0.5 * EDGE).abs() < 0.05 * EDGE, "tick {tick}: {height}");
    }
    // Friction has taken the body along.
    let spin: [f64; 3] = state(&app, body).body().frame().angular_velocity(&CUBE).into();
    let spin = DVec3::from(spin);
    assert!((spin - f64::from(speed) * DVec3::Y).length() < 0.05 * f64::from(speed), "{spin}");
}

#[test]
fn a_mesh_that_changes_is_made_anew_and_a_bad_one_is_told_once() {
    let mut app = mesh_app();
    let low = boxes(&[([0.0, -0.5, 0.0], [1.0, 0.5, 1.0])]);
    let high = boxes(&[([0.0, 0.0, 0.0], [1.0, 0.5, 1.0])]);
    let handle = app.world_mut().resource_mut::<Assets<Mesh>>().add(low);
    let table = app.world_mut().spawn(Obstacle::Mesh(handle.clone())).id();
    wait(&mut app, table);
    let distance = |app: &App| {
        let motion = app.world().get::<crate::obstacle::Motion>(table).unwrap();
        motion.distance(1.0, &nalgebra::Vector3::new(0.0, 2.0, 0.0))
    };
    assert!((distance(&app) - 2.0).abs() < 1e-6);
    app.world_mut().resource_mut::<Assets<Mesh>>().insert(handle.id(), high).unwrap();
    // The old one stays until the new one is made.
    for _ in 0..2000 {
        app.update();
        let now = distance(&app);
        assert!((now - 2.0).abs() < 1e-6 || (now - 1.5).abs() < 1e-6, "{now}");
        if now < 1.9 {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    assert!((distance(&app) - 1.5).abs() < 1e-6);
    let flat = triangles(vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], vec![0, 2, 1]);
    let flat = app.world_mut().resource_mut::<Assets<Mesh>>().add(flat);
    app.world_mut().spawn(Obstacle::Hull(flat));
    for _ in 0..50 {
        app.update();
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    let received = &app.world().resource::<Received>().refused;
    assert_eq!(received.len(), 1, "{received:?}");
}

#[test]
fn a_field_is_the_solid_that_it_was_made_of() {
    let torus = Torus { major_radius: 0.8, minor_radius: 0.3 };
    let mesh = torus.mesh().major_resolution(96).minor_resolution(48).build();
    let exact = solid(mesh.clone(), false, DVec3::ONE).unwrap();
    let cell = 0.05;
    let field = DistanceField::of_mesh(&mesh, cell).unwrap();
    for point in points() {
        let (found, exact) = (field.field().at(&point), exact.at(&point));
        let [off, cell] = [found.distance - exact.distance, f64::from(cell)];
        // Near the surface, which has facets; beyond the grid it is a lower bound.
        assert!(off < 0.3 * cell, "{point}: {} for {}", found.distance, exact.distance);
        if exact.distance.abs() < 2.0 * cell {
            assert!(off.abs() < 0.03 * cell, "{point}: {} for {}", found.distance, exact.distance);
        }
    }
    for z in [0.0, f32::NAN] {
        let open = triangles(vec![[0.0; 3], [1.0, 0.0, z], [0.0, 0.0, 1.0]], vec![0, 2, 1]);
        let error = DistanceField::of_mesh(&open, cell).unwrap_err().to_string();
        assert!(error.contains("enclose") == (z == 0.0), "{error}");
    }
    assert!(DistanceField::of_mesh(&mesh, 0.0).is_err());
    assert!(DistanceField::of_mesh(&mesh, f32::NAN).is_err());
}
