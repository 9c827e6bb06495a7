//! Tests against published values and full solutions: Demarest's cube, Lamb's sphere, Timoshenko's
//! beam and axial modes of rods.

use pliant_mesh::{TetMesh, shapes};
use pliant_modal::Patch;

use crate::bake::{accuracy, elimination_order, law};
use crate::fem::{ANCHORED, FeMesh};
use crate::rigid::MassProperties;
use crate::solver::Solver;
use crate::surface::Skin;
use crate::symbolic::Symbolic;
use crate::{Anchor, BakeConfig, flexibility, lanczos, support};
use pliant_modal::Element;

/// Returns the angular frequencies of the lowest elastic modes, rad/s.
fn omegas(mesh: &TetMesh, element: Element, config: &BakeConfig, average: Option<bool>) -> Vec<f64> {
    let fe = FeMesh::new(mesh, element);
    let mut law = law(config);
    law.average_pressure = average.unwrap_or(law.average_pressure);
    let graph = fe.graph(law.average_pressure);
    let held = support::anchored_nodes(&fe, config).unwrap();
    let (number, ordered) = elimination_order(&fe, &graph, &held);
    let matrix = fe.assemble(&law, &number, &ordered);
    let rigid = config.anchors.is_empty().then(|| {
        let mut positions = vec![[0.0; 3]; fe.nodes.len()];
        for (&row, &p) in number.iter().zip(&fe.nodes) {
            positions[row as usize] = p;
        }
        MassProperties::new(&fe, config.density).rigid_modes(positions.into_iter())
    });
    let solver = Solver::new(&matrix, Symbolic::new(&ordered), rigid).unwrap();
    let modes = lanczos::lowest(&solver, config.modes, &mut |_| ()).unwrap();
    let (residual, orthonormality) = accuracy(&matrix, &modes);
    assert!(residual < 1e-8 && orthonormality < 1e-12, "{residual:e} {orthonormality:e}");
    modes.lambda.iter().map(|l| l.sqrt()).collect()
}

/// Makes a configuration with `mu = 1` and `rho = 1`.
fn unit_shear(poisson: f64, modes: usize) -> BakeConfig {
    BakeConfig { young: 2.0 * (1.0 + poisson), poisson, density: 1.0, modes, ..BakeConfig::linear() }
}

fn worst(got: &[f64], expected: &[f64]) -> f64 {
    got.iter().zip(expected).map(|(g, e)| (g / e - 1.0).abs()).fold(0.0, f64::max)
}

/// Tests a cube of side 1 with `mu = rho = 1`, where omega is Demarest's Omega.
///
/// The reference is Legendre-Ritz of order 12 (REFERENCES). The same program gave the values
/// for 0.49 and 0.499.
#[test]
fn free_cube_has_demarests_frequencies_at_any_poisson_ratio() {
    for (nu, exact) in [
        (0.3, [2.85608, 3.84599, 3.91127, 4.44288, 4.57281]),
        (0.49, [2.85681, 3.88706, 3.92285, 4.44288, 5.01353]),
        (0.499, [2.85684, 3.88865, 3.92330, 4.44288, 5.02274]),
    ] {
        let expected = [0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4].map(|i| exact[i]);
        // The mesh has 6,591 degrees of freedom. The measured error is at most 0.26 %.
        let got = omegas(&shapes::cube(6, 1.0).unwrap(), Element::Tet10, &unit_shear(nu, 14), None);
        assert!(worst(&got, &expected) < 0.004, "tet10 at {nu}: {got:?}");
    }
    // Averaging the pressure must reduce the mean error of linear tetrahedra at 0.499, which is 13
    // % without averaging.
    let mesh = shapes::cube(8, 1.0).unwrap();
    let expected = [2.85684, 2.85684, 3.88865, 3.88865, 3.88865, 3.92330, 3.92330, 3.92330];
    let mean = |got: &[f64]| {
        got.iter().zip(&expected).map(|(g, e)| (g / e - 1.0).abs()).sum::<f64>() / expected.len() as f64
    };
    let averaged = mean(&omegas(&mesh, Element::Tet4, &unit_shear(0.499, 8), Some(true)));
    let locked = mean(&omegas(&mesh, Element::Tet4, &unit_shear(0.499, 8), Some(false)));
    assert!(averaged < 0.04 && locked > 0.10, "{averaged} {locked}");
}

/// Tests a sphere of radius 1 with `mu = rho = 1`, where omega is Lamb's eta.
///
/// Straight-sided elements leave out 1 % of the ball, which is 0.35 % in frequency.
#[test]
fn free_sphere_has_lambs_frequencies() {
    let mesh = shapes::sphere(10, 1.0).unwrap();
    let got = omegas(&mesh, Element::Tet10, &unit_shear(0.3, 32), None);
    let torsional = [2.50113; 5];
    let spheroidal = [2.64622; 5];
    assert!(worst(&got[..5], &torsional) < 0.005, "{:?}", &got[..5]);
    assert!(worst(&got[5..10], &spheroidal) < 0.005, "{:?}", &got[5..10]);
    let breathing = got.iter().map(|o| (o / 4.99551 - 1.0).abs()).fold(f64::INFINITY, f64::min);
    assert!(breathing < 0.005, "{got:?}");
}

/// Returns the frequencies of a clamped-free Timoshenko beam (rad/s) from the transfer matrix of
/// its equations.
///
/// The equations are
/// `w' = theta + V / (k G A)`, `theta' = M / (E I)`, `M' = -V - rho I w^2 theta`,
/// `V' = -rho A w^2 w`.
fn timoshenko(young: f64, poisson: f64, density: f64, length: f64, side: f64, count: usize) -> Vec<f64> {
    let (area, second) = (side * side, side.powi(4) / 12.0);
    let shear = 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson) * young / (2.0 * (1.0 + poisson)) * area;
    let free_end = |omega: f64| {
        let mut a = nalgebra::Matrix4::<f64>::zeros();
        a[(0, 1)] = 1.0;
        a[(0, 3)] = 1.0 / shear;
        a[(1, 2)] = 1.0 / (young * second);
        a[(2, 1)] = -density * second * omega * omega;
        a[(2, 3)] = -1.0;
        a[(3, 0)] = -density * area * omega * omega;
        let t = (a * length).exp();
        t[(2, 2)] * t[(3, 3)] - t[(2, 3)] * t[(3, 2)]
    };
    let slender = (young * second / (density * area)).sqrt() / (length * length);
    let mut out = Vec::new();
    let step = 0.05 * slender;
    let mut omega = step;
    while out.len() < count {
        let (mut low, mut high) = (omega, omega + step);
        if free_end(low) * free_end(high) < 0.0 {
            for _ in 0..60 {
                let middle = 0.5 * (low + high);
                if free_end(low) * free_end(middle) <= 0.0 { high = middle } else { low = middle }
            }
            out.push(low);
        }
        omega += step;
    }
    out
}

#[test]
fn the_beam_reference_tends_to_eulers() {
    // Euler's theory gives beta L = 1.875104 and 4.694091. The beam has an aspect ratio of 1000.
    let got = timoshenko(1e6, 0.3, 1e3, 10.0, 0.01, 2);
    let scale = (1e6 * 0.01f64.powi(2) / 12.0 / 1e3).sqrt() / 100.0;
    assert!((got[0] / (1.875104f64.powi(2) * scale) - 1.0).abs() < 1e-4);
    assert!((got[1] / (4.694091f64.powi(2) * scale) - 1.0).abs() < 1e-4);
}

#[test]
fn cantilever_bends_as_timoshenko_says() {
    let (young, nu, density) = (2e6, 0.3, 1000.0);
    let mesh = shapes::bar([40, 3, 3], [2.0, 0.15, 0.15]).unwrap();
    let config = BakeConfig {
        young,
        poisson: nu,
        density,
        modes: 8,
        anchors: vec!["x<=0".parse().unwrap()],
        ..BakeConfig::linear()
    };
    let got = omegas(&mesh, Element::Tet10, &config, None);
    let exact = timoshenko(young, nu, density, 2.0, 0.15, 3);
    // Each bending mode occurs twice. The clamped root cannot contract, which adds 0.2 %.
    let pairs = [got[0], got[1], got[2], got[3]];
    assert!(worst(&pairs, &[exact[0], exact[0], exact[1], exact[1]]) < 0.005, "{got:?} {exact:?}");
    assert!((got[1] / got[0] - 1.0).abs() < 1e-3 && (got[3] / got[2] - 1.0).abs() < 1e-3, "{got:?}");
}

/// Tests a rod that cannot contract sideways (nu = 0). Its exact axial modes are
/// `(2k - 1) / (4 L) sqrt(E / rho)`.
#[test]
fn rod_has_its_axial_modes() {
    let (young, density, length): (f64, f64, f64) = (1e6, 1000.0, 1.0);
    let mesh = shapes::bar([12, 2, 2], [length, 0.25, 0.25]).unwrap();
    let config = BakeConfig {
        young,
        poisson: 0.0,
        density,
        modes: 30,
        anchors: vec!["x<=0".parse().unwrap()],
        ..BakeConfig::linear()
    };
    let got = omegas(&mesh, Element::Tet10, &config, None);
    for k in 1..=2 {
        let exact = f64::from(2 * k - 1) * std::f64::consts::FRAC_PI_2 / length * (young / density).sqrt();
        let nearest = got.iter().map(|o| (o / exact - 1.0).abs()).fold(f64::INFINITY, f64::min);
        assert!(nearest < 1e-4, "axial mode {k}: {nearest}");
    }
}

/// Modes and residual flexibility together equal the full static solution at a patch, exactly by
/// definition.
#[test]
fn modes_and_residual_flexibility_make_the_full_static_stiffness() {
    let mesh = shapes::bar([10, 3, 3], [1.0, 0.3, 0.3]).unwrap();
    for anchors in [vec![], vec!["x<=0".parse::<Anchor>().unwrap()]] {
        let config = BakeConfig { modes: 12, anchors, ..BakeConfig::linear() };
        let fe = FeMesh::new(&mesh, Element::Tet10);
        let graph = fe.graph(false);
        let held = support::anchored_nodes(&fe, &config).unwrap();
        let (number, ordered) = elimination_order(&fe, &graph, &held);
        let matrix = fe.assemble(&law(&config), &number, &ordered);
        let properties = MassProperties::new(&fe, config.density);
        let rigid = config.anchors.is_empty().then(|| {
            let mut positions = vec![[0.0; 3]; fe.nodes.len()];
            for (&row, &p) in number.iter().zip(&fe.nodes) {
                positions[row as usize] = p;
            }
            properties.rigid_modes(positions.into_iter())
        });
        let solver = Solver::new(&matrix, Symbolic::new(&ordered), rigid).unwrap();
        let modes = lanczos::lowest(&solver, config.modes, &mut |_| ()).unwrap();
        let skin = Skin::new(&mesh, &fe, None, &number).unwrap();
        let bake = |count, radii: &[f64]| {
            flexibility::sites(&solver, &modes, &skin, &number, count, radii, &mut |_| ()).unwrap()
        };
        // A few sites are solved one by one through the factor, and all sites are solved together.
        let mut sites = bake(Some(6), &[0.1, 0.25]);
        assert_eq!(sites.len(), 12);
        let every = bake(None, &[0.0, 0.1, 0.25]);
        let moving = skin.mesh.anchored().iter().filter(|anchored| !**anchored).count();
        assert_eq!(every.len(), 3 * moving);
        sites.extend(every.into_iter().step_by(7));
        for site in &sites {
            let patch = Patch::around(&skin.mesh, site.vertex, site.radius).unwrap();
            let mut loads = vec![0.0; 3 * matrix.dofs()];
            for &(vertex, weight) in patch.entries() {
                skin.spread(vertex, weight, &mut |node, weight| {
                    if number[node as usize] != ANCHORED {
                        for axis in 0..3 {
                            loads[(3 * number[node as usize] as usize + axis) * 3 + axis] += weight;
                        }
                    }
                });
            }
            let mut full = loads.clone();
            solver.solve(&mut full, 3);
            let inner = |a: &[f64], b: &[f64], i: usize, j: usize, wa: usize, wb: usize| -> f64 {
                (0..matrix.dofs()).map(|dof| a[dof * wa + i] * b[dof * wb + j]).sum()
            };
            for i in 0..3 {
                for j in 0..3 {
                    let exact = inner(&loads, &full, i, j, 3, 3);
                    let modal: f64 = (0..config.modes)
                        .map(|m| {
                            inner(&loads, &modes.phi, i, m, 3, config.modes)
                                * inner(&loads, &modes.phi, j, m, 3, config.modes)
                                / modes.lambda[m]
                        })
                        .sum();
                    let scale = inner(&loads, &full, i, i, 3, 3).max(inner(&loads, &full, j, j, 3, 3));
                    let difference = (modal + site.flexibility[i][j] - exact).abs() / scale;
                    assert!(difference < 1e-9, "{site:?} ({i}, {j}): {difference:e}");
                }
                assert!(site.flexibility[i][i] > 0.0, "{site:?}");
            }
        }
    }
}

#[test]
fn pseudo_inverse_of_a_free_body_ignores_rigid_motion() {
    let mesh = shapes::bar([4, 2, 2], [1.0, 0.4, 0.5]).unwrap();
    let fe = FeMesh::new(&mesh, Element::Tet10);
    let graph = fe.graph(false);
    let held = vec![false; fe.nodes.len()];
    let (number, ordered) = elimination_order(&fe, &graph, &held);
    let config = BakeConfig::default();
    let matrix = fe.assemble(&law(&config), &number, &ordered);
    let mut positions = vec![[0.0; 3]; fe.nodes.len()];
    for (&row, &p) in number.iter().zip(&fe.nodes) {
        positions[row as usize] = p;
    }
    let rigid = MassProperties::new(&fe, config.density).rigid_modes(positions.into_iter());
    // The rigid modes are M-orthonormal and have no elastic energy.
    let (mut k, mut m) = (vec![0.0; rigid.len()], vec![0.0; rigid.len()]);
    matrix.stiffness_times(&rigid, 6, &mut k);
    matrix.mass_times(&rigid, 6, &mut m);
    for i in 0..6 {
        for j in 0..6 {
            let product: f64 = (0..matrix.dofs()).map(|dof| rigid[6 * dof + i] * m[6 * dof + j]).sum();
            assert!((product - f64::from(u8::from(i == j))).abs() < 1e-12, "({i}, {j}): {product}");
        }
    }
    let solver = Solver::new(&matrix, Symbolic::new(&ordered), Some(rigid)).unwrap();
    let largest = k.iter().fold(0.0f64, |a, x| a.max(x.abs()));
    assert!(largest < 1e-9 * config.young, "{largest:e}");
    // The pseudo-inverse of K x returns x once the rigid part is removed.
    let mut x: Vec<f64> = (0..matrix.dofs()).map(|i| ((i * 37 % 101) as f64 - 50.0) / 50.0).collect();
    solver.remove_rigid(&mut x, 1);
    let mut f = vec![0.0; x.len()];
    matrix.stiffness_times(&x, 1, &mut f);
    solver.solve(&mut f, 1);
    let worst = x.iter().zip(&f).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst < 1e-9, "{worst:e}");
}
