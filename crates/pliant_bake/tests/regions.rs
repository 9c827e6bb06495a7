//! Bodies of several materials, against closed forms and full solutions.

use std::sync::Arc;

use pliant_bake::{
    BakeConfig, BakeError, Material, Paint, PrescribedPatch, Region, StaticLoads, bake, deflect,
};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Body, BodyConfig, Elasticity, GrabConfig, HeldShapes, ModalModel, Patch, StepSettings};

fn regions(texts: &[&str]) -> Vec<Region> {
    texts.iter().map(|text| text.parse().unwrap()).collect()
}

fn model(mesh: &TetMesh, config: &BakeConfig) -> Arc<ModalModel> {
    Arc::new(bake(mesh, None, config, &mut |_, _| ()).unwrap().model)
}

/// A rod that hangs by its upper half, which is stiffer and lighter. Under its weight the end moves
/// by `g L^2 / 8 (rho1 / E1 + 2 rho2 / E1 + rho2 / E2)` (one dimension, Poisson ratio 0).
#[test]
fn a_rod_of_two_materials_stretches_as_the_closed_form_says() {
    let (young, density, g) = (1e6, 1000.0, 1.0);
    let config = BakeConfig {
        young,
        density,
        poisson: 0.0,
        anchors: vec!["x<1e-9".parse().unwrap()],
        regions: regions(&["x<0.5: stiffness 7, density 0.25"]),
        ..BakeConfig::linear()
    };
    let mesh = shapes::bar([8, 2, 2], [1.0, 0.1, 0.1]).unwrap();
    let loads = StaticLoads { gravity: [g, 0.0, 0.0], ..Default::default() };
    let found = deflect(&mesh, &config, Material::StVenantKirchhoff, &loads).unwrap();
    let (e1, e2, r1, r2) = (7.0 * young, young, 0.25 * density, density);
    let exact = g / 8.0 * (r1 / e1 + 2.0 * r2 / e1 + r2 / e2);
    let surface = mesh.boundary().0;
    for (at, moved) in surface.positions.iter().zip(&found.linear) {
        if at[0] > 1.0 - 1e-9 {
            assert!((moved[0] / exact - 1.0).abs() < 1e-9, "{} for {exact}", moved[0]);
        }
    }
}

/// The lowest frequency of a sandwich beam is that of a beam with the bending stiffness
/// `sum of E_i I_i` and the mass of both materials.
#[test]
fn a_stiff_hull_raises_the_frequency_as_composite_beams_say() {
    let (young, density, side) = (1e6, 1000.0, 1.0 / 30.0);
    let mesh = shapes::bar([40, 4, 2], [1.0, side, side]).unwrap();
    let config = BakeConfig {
        young,
        density,
        poisson: 0.0,
        modes: 6,
        anchors: vec!["x<1e-9".parse().unwrap()],
        // The outer quarters on both sides.
        regions: regions(&[
            &format!("y<{}: stiffness 10, density 2", 0.25 * side),
            &format!("y>{}: stiffness 10, density 2", 0.75 * side),
        ]),
        ..BakeConfig::linear()
    };
    let model = model(&mesh, &config);
    let inner = side * (side / 2.0f64).powi(3) / 12.0;
    let whole = side.powi(4) / 12.0;
    let bending = young * (10.0 * (whole - inner) + inner);
    // A beam bends easily about the other axis: all materials side by side.
    let flat = young * 5.5 * whole;
    let mass = 1.5 * density * side * side;
    let root = 1.875_104_068_711_961_f64;
    let mut exact = [bending, flat].map(|stiffness| root * root * (stiffness / mass).sqrt());
    exact.sort_by(f64::total_cmp);
    let found = [model.omega()[0], model.omega()[1]];
    println!("{found:?} 1/s for {exact:?}");
    for (found, exact) in found.iter().zip(exact) {
        // Shear, which the beam leaves out, takes 0.3 %.
        assert!((found / exact - 1.0).abs() < 0.006, "{found} for {exact}");
    }
}

/// Mass, center and inertia of a free body whose half is three times as heavy.
#[test]
fn a_heavy_half_moves_the_center_of_mass() {
    let mesh = shapes::bar([4, 2, 2], [0.4, 0.2, 0.2]).unwrap();
    let config = BakeConfig { modes: 4, regions: regions(&["x<0.2: density 3"]), ..BakeConfig::linear() };
    let model = model(&mesh, &config);
    let half = 1000.0 * 0.2f64.powi(3);
    assert!((model.mass() / (4.0 * half) - 1.0).abs() < 1e-12);
    assert!((model.center_of_mass()[0] - 0.15).abs() < 1e-12, "{:?}", model.center_of_mass());
    // Two cubes of side a about their own centers, m a^2 / 6, and the distances of these centers.
    let about_y = half * (4.0 * 0.04 / 6.0 + 3.0 * 0.05f64.powi(2) + 0.15f64.powi(2));
    assert!((model.inertia()[1][1] / about_y - 1.0).abs() < 1e-9, "{:?} for {about_y}", model.inertia());
}

fn core() -> BakeConfig {
    BakeConfig {
        modes: BakeConfig::COORDINATES,
        material: Some(Material::NeoHookean),
        poisson: 0.3,
        anchors: vec!["x<1e-9".parse().unwrap()],
        regions: regions(&["y>0.05 & y<0.15 & z>0.05 & z<0.15: stiffness 50, density 2"]),
        ..BakeConfig::linear()
    }
}

/// Force of a hand on a body with a stiff core in a soft hull, against the full solution.
#[test]
fn a_hand_feels_a_stiff_core_in_a_soft_hull() {
    let mesh = shapes::bar([8, 4, 4], [0.6, 0.2, 0.2]).unwrap();
    let model = model(&mesh, &core());
    let positions = model.surface().positions();
    let off = |p: &[f32; 3]| (p[0] - 0.6).powi(2) + (p[1] - 0.2).powi(2) + (p[2] - 0.1).powi(2);
    let end = (0..positions.len()).min_by(|&a, &b| off(&positions[a]).total_cmp(&off(&positions[b])));
    // One of the radii for which the flexibility is baked. Between two of them a body of one
    // material is off by 1.8 % on this coarse mesh.
    let patch = Patch::around(model.surface(), end.unwrap() as u32, 0.113 * 0.6).unwrap();
    for (elasticity, way, most) in [
        (Elasticity::Linear, [5e-5, 1e-4, 5e-5], 0.005),
        (Elasticity::Reduced, [0.0, 0.05, 0.0], 0.01),
        (Elasticity::Reduced, [0.0, -0.05, 0.0], 0.01),
    ] {
        let held = [PrescribedPatch { patch: patch.clone(), displacement: way }];
        let loads = StaticLoads { prescribed: &held, ..Default::default() };
        let full = deflect(&mesh, &core(), Material::NeoHookean, &loads).unwrap();
        let settings = StepSettings { elasticity, damping_scale: 30.0, ..Default::default() };
        let config = BodyConfig { step: 1.0 / 60.0, ..settings.into() };
        let mut body = Body::new(model.clone(), config).unwrap();
        let grab = body.grab(&patch, GrabConfig::default()).unwrap();
        if elasticity == Elasticity::Reduced {
            let shapes = HeldShapes::new(&model, std::slice::from_ref(&patch)).unwrap();
            body.set_held_shapes(shapes.map(Arc::new)).unwrap();
        }
        let start = body.target(grab).unwrap();
        for i in 1..=1_200 {
            let share = (f64::from(i) / 600.0).min(1.0);
            body.set_target(grab, std::array::from_fn(|k| start[k] + share * way[k])).unwrap();
            body.step().unwrap();
        }
        let (force, want) = (body.reaction(grab).unwrap(), full.reactions[0]);
        let size = want.iter().map(|x| x * x).sum::<f64>().sqrt();
        let error = (0..3).map(|k| (force[k] - want[k]).powi(2)).sum::<f64>().sqrt() / size;
        println!("{elasticity:?} by {way:?} m: {size:.4} N, off by {error:.4}");
        assert!(error < most, "{elasticity:?} by {way:?}: {force:?} for {want:?}");
    }
}

/// What is painted on the boundary is the same as regions and anchors with the same values.
#[test]
fn painted_values_are_those_of_regions_and_anchors() {
    let mesh = shapes::bar([6, 2, 2], [0.6, 0.2, 0.2]).unwrap();
    let plain = BakeConfig {
        modes: 5,
        anchors: vec!["x<0.15".parse().unwrap()],
        regions: regions(&["x>-1: stiffness 3, density 2"]),
        ..BakeConfig::linear()
    };
    let surface = mesh.boundary().0;
    let count = surface.positions.len();
    // Weights fall off linearly, so that they are 1/2 at x = 0.15.
    let anchored = surface.positions.iter().map(|p| 0.5 + (0.15 - p[0])).collect();
    let painted = BakeConfig {
        anchors: Vec::new(),
        regions: Vec::new(),
        paint: Some(Paint {
            stiffness: vec![3.0; count],
            density: vec![2.0; count],
            anchored,
            surface: surface.clone(),
        }),
        ..plain.clone()
    };
    let [by_region, by_paint] = [&plain, &painted].map(|config| model(&mesh, config));
    assert!(!by_paint.is_free() && by_paint.info().anchors == ["painted"]);
    // Interpolated values are rounded.
    for (a, b) in by_region.omega().iter().zip(by_paint.omega()) {
        assert!((a / b - 1.0).abs() < 1e-12, "{a} and {b}");
    }
    assert!((by_region.mass() / by_paint.mass() - 1.0).abs() < 1e-12);
    let nowhere = Paint { anchored: vec![0.2; count], ..Paint::new(surface.clone()) };
    let free = BakeConfig { anchors: Vec::new(), paint: Some(nowhere), ..plain.clone() };
    assert!(model(&mesh, &free).is_free());
    let everywhere = Paint { anchored: vec![1.0; count], ..Paint::new(surface) };
    let fixed = BakeConfig { anchors: Vec::new(), paint: Some(everywhere), ..plain };
    let refused = bake(&mesh, None, &fixed, &mut |_, _| ());
    assert!(matches!(refused, Err(BakeError::AnchorHoldsEverything { .. })));
}

/// A model keeps the stiffness of its elements, from which the shapes of held patches are made.
#[test]
fn the_stiffness_of_the_elements_is_in_the_file() {
    let mesh = shapes::bar([6, 4, 4], [0.6, 0.2, 0.2]).unwrap();
    let model = model(&mesh, &core());
    let stiffness = &model.parts().reduced.as_ref().unwrap().mesh.as_ref().unwrap().stiffness;
    assert!(stiffness.contains(&1.0) && stiffness.contains(&50.0));
    let bytes = model.to_bytes();
    let again = ModalModel::from_bytes(&bytes).unwrap();
    assert_eq!(again.parts().reduced.as_ref().unwrap().mesh.as_ref().unwrap().stiffness, *stiffness);
    let plain = BakeConfig { regions: Vec::new(), ..core() };
    let plain = Arc::new(bake(&mesh, None, &plain, &mut |_, _| ()).unwrap().model);
    assert!(plain.parts().reduced.as_ref().unwrap().mesh.as_ref().unwrap().stiffness.is_empty());
    // Cut or altered at its end, the section is an error.
    assert!(ModalModel::from_bytes(&bytes[..bytes.len() - 4]).is_err());
}
