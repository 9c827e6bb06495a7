//! Tests that a glTF file, as Blender exports it, becomes a body that keeps what the file says:
//! material and anchors of the body, and the materials of its surface.

#[path = "blender/mod.rs"]
mod bud;

use std::{fs, path::Path, time::Duration};

use bevy::{
    asset::{
        AssetMode, LoadState,
        processor::{AssetProcessor, FileTransactionLogFactory},
    },
    gltf::{GltfExtras, GltfMaterialName},
    mesh::{VertexAttributeValues, skinning::SkinnedMesh},
    prelude::*,
};
use bevy_skein::SkeinPlugin;
use pliant::{
    body::{BakeFailed, BakePlugin, SurfacePart},
    prelude::*,
};

/// The rows of a part's mesh: positions.
fn positions(app: &App, part: Entity) -> Vec<Vec3> {
    let mesh = &app.world().get::<Mesh3d>(part).unwrap().0;
    let mesh = app.world().resource::<Assets<Mesh>>().get(mesh).unwrap();
    match mesh.attribute(Mesh::ATTRIBUTE_POSITION) {
        Some(VertexAttributeValues::Float32x3(values)) => values.iter().map(|p| Vec3::from(*p)).collect(),
        _ => panic!("no positions"),
    }
}

/// Spawns what Bevy makes of a node whose extras Skein for Blender has written: the node, and a
/// child with its mesh.
fn node_of_skein(app: &mut App, settings: &str) -> Entity {
    let mesh = app.world_mut().resource_mut::<Assets<Mesh>>().add(Cuboid::new(0.1, 0.2, 0.1));
    let value = format!(
        r#"{{ "skein": [{{ "pliant_body::bake::node::BakeNode": {{ "settings": {settings} }} }}] }}"#
    );
    app.world_mut().spawn((GltfExtras { value }, Transform::default(), children![Mesh3d(mesh)])).id()
}

#[test]
fn skein_makes_a_body_of_a_node_with_its_settings() {
    let mut app = bud::empty(false, |app| {
        app.add_plugins(SkeinPlugin { handle_brp: false });
    });
    let settings =
        r#"{ "tets": 500, "modes": 8, "material": "linear", "young": 3e4, "anchors": ["y<-0.09"] }"#;
    let node = node_of_skein(&mut app, settings);
    assert_eq!(bud::body(&mut app), node);
    let model = app.world().get::<BodyState>(node).unwrap().model();
    let info = model.info();
    assert_eq!(
        (model.mode_count(), info.young, info.density),
        (8, 3e4, 1000.0),
        "the density is the default"
    );
    assert!(!model.is_free(), "it is fixed at its bottom");
}

#[derive(Resource, Default)]
struct Failed(Vec<(Entity, String)>);

#[test]
fn settings_that_cannot_be_read_make_no_body_and_say_why() {
    let mut app = bud::empty(false, |app| {
        app.add_plugins(SkeinPlugin { handle_brp: false }).init_resource::<Failed>().add_observer(
            |failed: On<BakeFailed>, mut all: ResMut<Failed>| {
                all.0.push((failed.entity, failed.error.to_string()));
            },
        );
    });
    for (settings, expected) in [
        (r#"{ "anchors": ["left"] }"#, "expected an axis"),
        (r#"{ "material": "cheese" }"#, "cheese"),
        (r#"{ "young": -1.0 }"#, "-1"),
    ] {
        let node = node_of_skein(&mut app, settings);
        for _ in 0..600 {
            app.update();
            if !app.world().resource::<Failed>().0.is_empty() {
                break;
            }
        }
        let told = std::mem::take(&mut app.world_mut().resource_mut::<Failed>().0);
        assert!(matches!(&told[..], [(of, why)] if *of == node && why.contains(expected)), "{told:?}");
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
    // It bends under gravity. `blender_picture` looks at what is drawn then: without a camera
    // nothing is deformed.
    (0..80).for_each(|_| app.update());
    let q = app.world().get::<BodyState>(body).unwrap().body().q();
    assert!(q.iter().any(|q| q.abs() > 1e-3), "{q:?}");
    assert_eq!(positions(&app, parts[0]), positions(&app, parts[1]), "one surface");
}

/// Returns an app that loads the processed assets of a folder, and processes them first if it can.
fn processed(folder: &Path, process: bool) -> App {
    let text = |name: &str| folder.join(name).to_string_lossy().into_owned();
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin {
            file_path: text("assets"),
            processed_file_path: text("imported"),
            mode: AssetMode::Processed,
            use_asset_processor_override: Some(process),
            ..default()
        },
        TransformPlugin,
        PliantBodyPlugin::default(),
    ));
    // A game that only loads what was processed does not know how to bake.
    if process {
        app.add_plugins(BakePlugin { cache: None });
        let log = FileTransactionLogFactory { file_path: folder.join("imported/log") };
        app.world().resource::<AssetProcessor>().data().set_log_factory(Box::new(log)).unwrap();
    }
    app
}

/// Loads the file as a baked body.
fn load(app: &mut App, name: &'static str) -> Result<ModalAsset, String> {
    let handle: Handle<ModalAsset> = app.world().resource::<AssetServer>().load(name);
    for _ in 0..60_000 {
        app.update();
        if let Some(model) = app.world().resource::<Assets<ModalAsset>>().get(&handle) {
            return Ok(model.clone());
        }
        if let LoadState::Failed(error) = app.world().resource::<AssetServer>().load_state(&handle) {
            return Err(error.to_string());
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("{name} has not come");
}

#[test]
fn a_file_is_baked_when_assets_are_processed() {
    let folder = std::env::temp_dir().join(format!("pliant-processed-{}", std::process::id()));
    let assets = folder.join("assets");
    fs::create_dir_all(&assets).unwrap();
    let glb = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/blender/bud.glb");
    let meta = |settings: &str| {
        format!(
            "(meta_format_version: \"1.0\", asset: Process(processor: \"BakeProcessor\", settings: {settings}))"
        )
    };
    fs::copy(&glb, assets.join("bud.glb")).unwrap();
    let settings = r#"(tets: 2000, modes: 8, young: 2e4, density: 400, anchors: ["y<0.08"])"#;
    fs::write(assets.join("bud.glb.meta"), meta(settings)).unwrap();
    // The anchor of this one is painted, and nothing else fixes it.
    fs::copy(&glb, assets.join("painted.glb")).unwrap();
    fs::write(assets.join("painted.glb.meta"), meta(r#"(tets: 1200, material: "linear", modes: 6)"#))
        .unwrap();
    fs::copy(&glb, assets.join("bad.glb")).unwrap();
    fs::write(assets.join("bad.glb.meta"), meta(r#"(anchors: ["left"])"#)).unwrap();

    let mut app = processed(&folder, true);
    let ModalAsset(baked) = load(&mut app, "bud.glb").unwrap();
    assert_eq!((baked.mode_count(), baked.is_free()), (8, false));
    assert_eq!(baked.surface().triangles().len(), 720, "the surface of the file");
    assert!(baked.surface().uvs().is_some());
    println!("processed: {} tetrahedra, {:.3} kg", baked.info().tets, baked.mass());
    let ModalAsset(painted) = load(&mut app, "painted.glb").unwrap();
    assert_eq!((painted.mode_count(), painted.is_free()), (6, false));
    let error = load(&mut app, "bad.glb").unwrap_err();
    println!("{error}");
    drop(app);
    // What was processed is loaded by an app that cannot bake.
    let ModalAsset(shipped) = load(&mut processed(&folder, false), "bud.glb").unwrap();
    assert_eq!(shipped.hash(), baked.hash());
    fs::remove_dir_all(&folder).unwrap();
}
