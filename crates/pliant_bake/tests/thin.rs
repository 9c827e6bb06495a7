//! Blades that are about as thin as the tetrahedra vibrate as they should.
//!
//! The frequency of a blade is proportional to its thickness, so the 2 % by which a filled volume
//! may be off allow 2 % of the frequency. Half of it is asked: thickness must also be where it is.

use std::f64::consts::TAU;

use pliant_bake::{BakeConfig, bake};
use pliant_mesh::{StuffOptions, Surface, TetMesh, sdf::SurfaceDistance, shapes, stuff};

const TETS: usize = 8000;

/// Without lateral contraction a wide plate bends as a beam does.
fn config() -> BakeConfig {
    BakeConfig { modes: 6, young: 1e7, poisson: 0.0, sites: Some(16), ..BakeConfig::linear() }
}

/// Returns a cube whose points are moved, as its own tetrahedra.
fn moved_cube(cells: [usize; 3], to: impl Fn([f64; 3]) -> [f64; 3]) -> TetMesh {
    let mut cube = shapes::bar(cells, [1.0; 3]).unwrap();
    cube.nodes.iter_mut().for_each(|p| *p = to(*p));
    cube
}

/// Returns the lowest frequency of a free body, Hz.
fn lowest(mesh: &TetMesh) -> f64 {
    bake(mesh, None, &config(), &mut |_, _| ()).unwrap().model.omega()[0] / TAU
}

fn filled(surface: &Surface) -> TetMesh {
    stuff(&SurfaceDistance::new(surface).unwrap(), &StuffOptions::with_target(TETS), &mut |_| ()).unwrap()
}

/// Largest error of a frequency, as a fraction.
const BOUND: f64 = 0.01;

/// Returns the lowest bending frequency of a free beam of 1 m, Hz.
///
/// Euler and Bernoulli's frequency with the root 4.730 of cos x cosh x = 1, less what rotary
/// inertia and shear take in first order (Timoshenko): with the radius of gyration r and the mode
/// w of unit mean square, the square falls by r^2 times the mean of w'^2 (49.48) and E / (k G)
/// times the mean of w'''^2 over that of w''^2 (12.30). Here E / G = 2 and k = 5 / 6.
fn free_beam(thickness: f64) -> f64 {
    let config = config();
    let gyration = thickness / 12.0_f64.sqrt();
    let slender = 4.730_041_f64.powi(2) / TAU * (config.young / config.density).sqrt() * gyration;
    slender * (1.0 - 0.5 * gyration.powi(2) * (49.48 + 2.4 * 12.30))
}

#[test]
fn a_thin_blade_bends_at_the_frequency_of_a_free_beam() {
    for thickness in [0.02, 0.01] {
        let blade = moved_cube([50, 10, 2], |[x, y, z]| [x, 0.2 * y, thickness * z]);
        let found = lowest(&filled(&blade.boundary().0));
        let exact = free_beam(thickness);
        let error = found / exact - 1.0;
        println!("{thickness} m: {found:.4} Hz, beam {exact:.4} Hz, {:+.2} %", 100.0 * error);
        assert!(error.abs() < BOUND, "{thickness} m: {:+.2} %", 100.0 * error);
    }
}

#[test]
fn a_bent_and_tapered_blade_has_the_frequency_of_a_mesh_that_follows_it() {
    let saber = |cells| {
        moved_cube(cells, |[x, y, z]| {
            let radius = 1.0 / 1.2 + (0.03 - 0.024 * y) * (z - 0.5);
            [radius * (1.2 * x).sin(), 0.2 * y, radius * (1.2 * x).cos()]
        })
    };
    let following = saber([60, 12, 2]);
    let exact = lowest(&following);
    let found = lowest(&filled(&following.boundary().0));
    let error = found / exact - 1.0;
    println!("tapered: {found:.4} Hz, following mesh {exact:.4} Hz, {:+.2} %", 100.0 * error);
    assert!(error.abs() < BOUND, "{:+.2} %", 100.0 * error);
}
