//! Tests that a glTF file, as Blender exports it, becomes a body that keeps what the file says:
//! material and anchors of the body, and the materials of its surface.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

#[path = "blender/mod.rs"]
mod bud;

use bevy::{
    gltf::GltfMaterialName,
    mesh::{VertexAttributeValues, skinning::SkinnedMesh},
    prelude::*,
};
use pliant::{body::SurfacePart, prelude::*};

/// The rows of a part's mesh: positions.
fn positions(app: &App, part: Entity) -> Vec<Vec3> {
    let mesh = &app.world().get::<Mesh3d>(part).unwrap().0;
    let mesh = app.world().resource::<Assets<Mesh>>().get(mesh).unwrap();
    match mesh.attribute(Mesh::ATTRIBUTE_POSITION) {
        Some(VertexAttributeValues::Float32x3(values)) => values.iter().map(|p| Vec3::from(*p)).collect(),
        _ => panic!("no positions"),
    }
}

#[test]
fn a_file_becomes_a_body_with_both_of_its_materials() {
    let mut app = bud::app(false);
    app.insert_resource(BodyGravity(Vec3::X * 3.0));
    let body = bud::body(&mut app);
    app.update();
    let world = app.world();
    assert_eq!(world.get::<Name>(body).unwrap().as_str(), "Bud");
    let model = world.get::<BodyState>(body).unwrap().model().clone();
    // An ellipsoid of 0.1, 0.2 and 0.1 m, in flat faces, of 400 kg/m^3.
    let expected = 400.0 * 4.0 / 3.0 * std::f64::consts::PI * 0.1 * 0.2 * 0.1 * 0.979;
    let off = model.mass() / expected - 1.0;
    println!("mass {:.4} kg, of the faces {expected:.4} kg: {:+.2} %", model.mass(), 100.0 * off);
    assert!(off.abs() < 0.02 && !model.is_free());
    // Its lowest fifth is fixed, as painted, up to the size of a tetrahedron: a vertex is where all
    // nodes of its tetrahedron are.
    let surface = model.surface();
    for (p, fixed) in surface.positions().iter().zip(surface.anchored()) {
        assert!(if *fixed { p[1] < 0.1 } else { p[1] > 0.02 }, "{p:?} {fixed}");
    }
    // Each primitive draws its own triangles with its own material.
    let parts: Vec<Entity> = world.get::<Children>(body).unwrap().iter().collect();
    let colors = parts.iter().map(|part| {
        let material = world.get::<MeshMaterial3d<StandardMaterial>>(*part).unwrap();
        let material = world.resource::<Assets<StandardMaterial>>().get(&material.0).unwrap();
        let name = world.get::<GltfMaterialName>(*part).unwrap().0.clone();
        (name, world.get::<SurfacePart>(*part).unwrap().triangles.clone(), material.base_color.to_linear())
    });
    let colors: Vec<_> = colors.collect();
    assert_eq!(colors[0], ("Stem".to_owned(), 0..360, LinearRgba::rgb(0.0, 0.8, 0.0)));
    assert_eq!(colors[1], ("Cap".to_owned(), 360..720, LinearRgba::rgb(0.8, 0.0, 0.0)));
    for (part, above) in parts.iter().zip([false, true]) {
        let mesh = world.resource::<Assets<Mesh>>().get(&world.get::<Mesh3d>(*part).unwrap().0).unwrap();
        let places = positions(&app, *part);
        let corners: Vec<usize> = mesh.indices().unwrap().iter().collect();
        assert_eq!(corners.len(), 3 * 360);
        let side = |v: &usize| if above { places[*v].y > 0.195 } else { places[*v].y < 0.205 };
        assert!(corners.iter().all(side));
        for attribute in [Mesh::ATTRIBUTE_UV_0, Mesh::ATTRIBUTE_TANGENT, Mesh::ATTRIBUTE_NORMAL] {
            assert!(mesh.contains_attribute(attribute), "{attribute:?}");
        }
        assert!(!mesh.contains_attribute(Mesh::ATTRIBUTE_JOINT_INDEX));
        assert!(!world.entity(*part).contains::<SkinnedMesh>());
    }
    // It bends under gravity. `blender_picture` looks at what is drawn then: without a camera nothing
    // is deformed.
    (0..80).for_each(|_| app.update());
    let q = app.world().get::<BodyState>(body).unwrap().body().q();
    assert!(q.iter().any(|q| q.abs() > 1e-3), "{q:?}");
    assert_eq!(positions(&app, parts[0]), positions(&app, parts[1]), "one surface");
}
