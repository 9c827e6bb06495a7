//! The moments with which the anchors' motion drives a baked body, against integrals over its mesh
//! and closed forms.

use std::{path::Path, sync::Arc};

use nalgebra::{Matrix3, Vector3};
use pliant_bake::{BakeConfig, Material, bake};
use pliant_mesh::{StuffOptions, TetMesh, io, shapes};
use pliant_modal::{Body, BodyConfig, FrameMotion, ModalModel, SimulationMesh, StepSettings, tetrahedron};

/// The integral of `rho phi r^T` of each mode over the simulation mesh, kg^1/2 m.
fn integrals(model: &ModalModel) -> Vec<Matrix3<f64>> {
    let mesh = model.parts().reduced.as_ref().unwrap().mesh.as_ref().unwrap();
    let (element, modes) = (model.info().element, model.mode_count());
    let (nodes, _) = tetrahedron::connectivity(mesh.corners.len(), &mesh.tets, element);
    let (points, share) = tetrahedron::stiffness_points(element);
    let mut out = vec![Matrix3::zeros(); modes];
    for (tet, nodes) in mesh.tets.iter().zip(nodes.chunks_exact(element.node_count())) {
        let corners = tet.map(|corner| mesh.corners[corner as usize].map(f64::from));
        let mass = model.info().density * tetrahedron::Affine::new(corners).volume * share;
        for at in points {
            let place: Vector3<f64> = corners.iter().zip(at).map(|(c, at)| Vector3::from(*c) * *at).sum();
            let shape = tetrahedron::shape(element, *at);
            for (mode, out) in out.iter_mut().enumerate() {
                let scale = f64::from(mesh.scales[mode] / SimulationMesh::STEPS);
                let of_node = |node: u32, axis: usize| {
                    scale * f64::from(mesh.displacements[(3 * node as usize + axis) * modes + mode])
                };
                let moved = Vector3::from_fn(|axis, _| {
                    nodes.iter().zip(&shape).map(|(&node, n)| n * of_node(node, axis)).sum()
                });
                *out += mass * moved * place.transpose();
            }
        }
    }
    out
}

fn model(mesh: &TetMesh, anchor: &str, modes: usize, material: Option<Material>) -> ModalModel {
    let anchors = vec![anchor.parse().unwrap()];
    let config = BakeConfig { modes, material, anchors, poisson: 0.0, young: 1e6, ..Default::default() };
    bake(mesh, None, &config, &mut |_, _| ()).unwrap().model
}

#[test]
fn the_moments_are_the_integrals_over_the_body() {
    let bud = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/bud.ron"));
    let options = StuffOptions::with_target(2_000);
    let (bud, _) = io::read(bud).unwrap().into_tets(&options, &mut |_| ()).unwrap();
    let bar = shapes::bar([20, 2, 2], [1.0, 0.1, 0.1]).unwrap();
    let cube = shapes::bar([5, 5, 5], [1.0; 3]).unwrap();
    for (name, mesh, anchor, limit) in
        [("bar", bar, "x<1e-9", 0.005), ("bud", bud, "y<0.004", 0.005), ("cube", cube, "x<1e-9", 0.06)]
    {
        let model = model(&mesh, anchor, 20, Some(Material::NeoHookean));
        // Weighted by what the modes give way: the elastic energy of a slow motion.
        let energy = |moments: &mut dyn Iterator<Item = Matrix3<f64>>| -> f64 {
            moments.zip(model.omega()).map(|(moment, omega)| moment.norm_squared() / omega.powi(2)).sum()
        };
        let exact = integrals(&model);
        let off = exact.iter().enumerate().map(|(mode, exact)| {
            let moment = model.moment(mode);
            Matrix3::from_fn(|a, b| moment[a][b]) - exact
        });
        let off = (energy(&mut off.into_iter()) / energy(&mut exact.iter().copied())).sqrt();
        println!("{name}: moments off by {:.2} %", 100.0 * off);
        assert!(off < limit, "{name}: {off}");
    }
}

/// Displacement of the tip of a slender bar whose anchors move, m.
fn tip_under(motion: FrameMotion) -> [f64; 3] {
    let mut mesh = shapes::bar([30, 2, 2], [1.0, 0.05, 0.05]).unwrap();
    // The axes of the turns go through the middle of the bar.
    mesh.nodes.iter_mut().flat_map(|node| &mut node[1..]).for_each(|x| *x -= 0.025);
    let model = Arc::new(model(&mesh, "x<1e-9", 30, None));
    // The closed forms are those of small displacements.
    let settings = StepSettings { warp: false, damping_scale: 20.0, ..Default::default() };
    let mut body = Body::new(model, BodyConfig { step: 1.0 / 240.0, ..settings.into() }).unwrap();
    for _ in 0..4_000 {
        body.set_frame_motion(motion).unwrap();
        body.step().unwrap();
    }
    let mut positions = body.model().surface().positions().to_vec();
    let tip = positions.iter().position(|p| p[0] > 0.999 && p[1].abs() < 1e-6 && p[2].abs() < 1e-6).unwrap();
    let rest = positions[tip];
    body.reconstruct(&mut positions).unwrap();
    std::array::from_fn(|axis| f64::from(positions[tip][axis] - rest[axis]))
}

#[test]
fn a_bar_that_is_spun_up_bends_as_published() {
    // A load that grows along a cantilever, q = rho A alpha x: 11 q(L) L^4 / (120 E I) at the tip,
    // with I = a^4 / 12 (Roark's Formulas for Stress and Strain, table 8.1).
    let alpha = 0.5;
    let motion = FrameMotion { angular_acceleration: [0.0, 0.0, alpha], ..Default::default() };
    let [_, bent, _] = tip_under(motion);
    let (density, young, side) = (BakeConfig::default().density, 1e6, 0.05f64);
    let exact = -11.0 * density * side.powi(2) * alpha * 12.0 / (120.0 * young * side.powi(4));
    println!("spun up: {bent:.6} m, {exact:.6} m");
    assert!((bent / exact - 1.0).abs() < 0.02, "{bent} {exact}");
}

#[test]
fn a_bar_that_spins_stretches_as_published() {
    // rho omega^2 L^3 / (3 E) at the tip.
    let omega = 2.0;
    let [stretched, ..] =
        tip_under(FrameMotion { angular_velocity: [0.0, 0.0, omega], ..Default::default() });
    let exact = BakeConfig::default().density * omega * omega / (3.0 * 1e6);
    println!("spins: {stretched:.6} m, {exact:.6} m");
    assert!((stretched / exact - 1.0).abs() < 0.03, "{stretched} {exact}");
}
