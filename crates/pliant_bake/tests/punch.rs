//! A flat punch pressed on a block, against the full solution by finite elements and against the
//! formula of a half-space.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_bake::{Anchor, BakeConfig, PrescribedPatch, StaticLoads, bake, deflect};
use pliant_mesh::shapes;
use pliant_modal::{Body, Material, ObstacleShape, Patch, StepError, StepSettings, SurfacePoint};

/// The flat end of a cylinder that stands on the plane `y = height`.
#[derive(Debug)]
struct Punch {
    center: [f64; 2],
    radius: f64,
    height: f64,
}

impl ObstacleShape for Punch {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let out = Vector3::new(point.x - self.center[0], 0.0, point.z - self.center[1]);
        let (beside, below) = (out.norm() - self.radius, self.height - point.y);
        let outward = out.try_normalize(0.0).unwrap_or_else(Vector3::x);
        let (distance, normal) = if beside > 0.0 && below > 0.0 {
            let way = beside * outward - below * Vector3::y();
            (way.norm(), way.normalize())
        } else if beside > below {
            (beside, outward)
        } else {
            (below, -Vector3::y())
        };
        SurfacePoint { distance, normal }
    }

    fn check(&self) -> Result<(), StepError> {
        Ok(())
    }
}

#[test]
fn a_flat_punch_is_as_stiff_as_the_full_solution_says() {
    let (young, poisson, size) = (1e5, 0.3f64, 0.2);
    for (cells, modes) in [([8, 4, 8], 30), ([8, 4, 8], 100)] {
        let cell = size / cells[0] as f64;
        let mesh = shapes::bar(cells, [size, cell * cells[1] as f64, size]).unwrap();
        let anchor: Anchor = "y<1e-6".parse().unwrap();
        let config = BakeConfig { modes, young, poisson, anchors: vec![anchor], ..BakeConfig::linear() };
        let model = Arc::new(bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model);
        let top = cell * cells[1] as f64;
        for reach in [1.2, 2.3, 3.2] {
            let (center, radius, depth) = ([0.5 * size; 2], reach * cell, 1e-4 * size);
            let settings = StepSettings { damping_scale: 20.0, ..StepSettings::default() };
            let mut body = Body::new(model.clone(), settings.into()).unwrap();
            body.set_friction(10.0).unwrap();
            body.set_obstacles(vec![Arc::new(Punch { center, radius, height: top - depth })]).unwrap();
            for _ in 0..1200 {
                body.step().unwrap();
            }
            let report = body.contacts().report();
            let got = -report.force[1];
            // The full solution, where the same vertices are led down.
            let touched: Vec<PrescribedPatch> = body
                .contacts()
                .contacts()
                .iter()
                .map(|contact| PrescribedPatch {
                    patch: Patch::around(model.surface(), contact.vertex, 1e-3 * cell).unwrap(),
                    displacement: [0.0, -depth, 0.0],
                })
                .collect();
            let loads = StaticLoads { prescribed: &touched, ..StaticLoads::default() };
            let full = deflect(&mesh, &config, Material::NeoHookean, &loads).unwrap();
            let want: f64 = full.linear_reactions.iter().map(|force| force[1]).sum::<f64>().abs();
            // A punch that sticks to a half-space (Mossakovskii 1954):
            // 4 G a ln(3 - 4 nu) / (1 - 2 nu).
            let wide = (touched.len() as f64 * cell * cell / std::f64::consts::PI).sqrt();
            let shear = young / (2.0 * (1.0 + poisson));
            let formula = 4.0 * shear * wide * (3.0 - 4.0 * poisson).ln() / (1.0 - 2.0 * poisson) * depth;
            println!(
                "{modes} modes, a / cell {reach}: {} places, {:.3} of the full solution, {:.3} of a half-space, which the full solution is {:.3} of",
                touched.len(),
                got / want,
                got / formula,
                want / formula,
            );
            assert!((got / want - 1.0).abs() < 0.055, "{modes}, {reach}: {got} {want}");
            // Where the punch has enough places and the block is large against it.
            if touched.len() == 21 {
                assert!((got / formula - 1.0).abs() < 0.07, "{modes}: {got} {formula}");
            }
        }
    }
}

/// I. N. Sneddon, *The relation between load and penetration in the axisymmetric Boussinesq problem
/// for a punch of arbitrary profile* (1965): a punch without friction has the force `2 E* a d`.
#[test]
fn a_punch_without_friction_is_as_stiff_as_a_half_space_says() {
    let (young, poisson, size) = (1e5, 0.3f64, 0.2);
    let cell = size / 8.0;
    // The base, which is held, makes up for the sides, which are free: the full solution of a punch
    // that sticks is 0.99 of its formula on this block.
    let mesh = shapes::bar([8, 4, 8], [size, 0.5 * size, size]).unwrap();
    let anchor: Anchor = "y<1e-6".parse().unwrap();
    for modes in [30, 100] {
        let anchors = vec![anchor];
        let config = BakeConfig { modes, young, poisson, anchors, ..BakeConfig::linear() };
        let model = Arc::new(bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model);
        let (center, radius, depth) = ([0.5 * size; 2], 2.3 * cell, 1e-4 * size);
        let settings = StepSettings { damping_scale: 20.0, ..StepSettings::default() };
        let mut body = Body::new(model.clone(), settings.into()).unwrap();
        body.set_friction(0.0).unwrap();
        body.set_obstacles(vec![Arc::new(Punch { center, radius, height: 0.5 * size - depth })]).unwrap();
        for _ in 0..1200 {
            body.step().unwrap();
        }
        let got = -body.contacts().report().force[1];
        let places = body.contacts().report().contacts;
        // The circle of the area that the touching sites stand for.
        let wide = (places as f64 * cell * cell / std::f64::consts::PI).sqrt();
        let want = 2.0 * young / (1.0 - poisson * poisson) * wide * depth;
        println!("{modes} modes: {places} places, {:.3} of a half-space", got / want);
        assert_eq!(places, 21);
        assert!((got / want - 1.0).abs() < 0.05, "{modes}: {got} {want}");
    }
}
