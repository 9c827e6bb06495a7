//! Tests the public bake: the contents of a model, the refused inputs, and bit-identical results
//! for the same input.

use pliant_bake::{Anchor, Bake, BakeConfig, BakeError, bake};
use pliant_mesh::{MeshError, Surface, TetMesh, shapes};
use pliant_modal::{Damping, Element, ModalModel};

fn anchor(text: &str) -> Vec<Anchor> {
    vec![text.parse().unwrap()]
}

fn run(mesh: &TetMesh, config: &BakeConfig) -> Result<Bake, BakeError> {
    bake(mesh, None, config, &mut |_, _| ())
}

fn bar() -> TetMesh {
    shapes::bar([10, 2, 2], [1.0, 0.2, 0.2]).unwrap()
}

/// Returns the largest |difference| of two models' mode shapes at the given vertex pairs, relative
/// to the largest entry.
fn shape_difference(a: &ModalModel, b: &ModalModel, pairs: &[(u32, u32)]) -> f64 {
    let (mut worst, mut largest): (f64, f64) = (0.0, 0.0);
    for mode in 0..a.mode_count() {
        for &(v, w) in pairs {
            for axis in 0..3 {
                let (x, y) = (a.displacement_row(v, axis, mode), b.displacement_row(w, axis, mode));
                worst = worst.max(f64::from((x - y).abs()));
                largest = largest.max(f64::from(x.abs()));
            }
        }
    }
    worst / largest
}

#[test]
fn the_same_bits_whatever_the_threads() {
    let mesh = shapes::bar([14, 5, 5], [1.0, 0.3, 0.3]).unwrap();
    for (element, anchors, poisson) in
        [(Element::Tet4, anchor("x<0.01"), 0.3), (Element::Tet10, vec![], 0.3), (Element::Tet4, vec![], 0.48)]
    {
        let config = BakeConfig { element, anchors, poisson, modes: 20, ..BakeConfig::linear() };
        let hashes = [1, 2, 5].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| run(&mesh, &config).unwrap().model.hash())
        });
        assert!(hashes.iter().all(|h| *h == hashes[0]), "{element:?}: {hashes:?}");
    }
}

#[test]
fn small_regular_meshes_are_never_refused_as_inaccurate() {
    for cells in 1..=4 {
        for across in 1..=3 {
            for modes in [6, 12, 24] {
                for (anchors, young) in
                    [(anchor("x<0.001"), 1e5), (anchor("x<0.001"), 1e9), (vec![], 1e5), (vec![], 1e9)]
                {
                    let mesh = shapes::bar([cells, across, across], [0.2, 0.12, 0.12]).unwrap();
                    let config = BakeConfig { modes, anchors, young, sites: Some(1), ..BakeConfig::linear() };
                    match run(&mesh, &config) {
                        Ok(made) => assert!(made.model.info().residual_max <= 1e-7),
                        // The smallest meshes have fewer coordinates.
                        Err(error) => assert!(
                            matches!(error, BakeError::Modes { .. }),
                            "{cells} x {across} x {across}, {modes} modes, {young:e} Pa: {error}"
                        ),
                    }
                }
            }
        }
    }
}

/// Thirty-two equal bars have every mode of one bar 32 times, so their lowest twenty modes all
/// equal its lowest mode.
#[test]
fn equal_parts_have_equal_modes_all_of_them() {
    let one = shapes::bar([4, 1, 1], [1.0, 0.25, 0.25]).unwrap();
    let mut many = TetMesh::default();
    for copy in 0..32 {
        let first = many.nodes.len() as u32;
        many.nodes.extend(one.nodes.iter().map(|&[x, y, z]| [x, y + f64::from(copy), z]));
        many.tets.extend(one.tets.iter().map(|tet| tet.map(|node| first + node)));
    }
    let config = BakeConfig { modes: 20, anchors: anchor("x<0.001"), ..BakeConfig::linear() };
    let lowest = run(&one, &config).unwrap().model.omega()[0];
    let first = run(&many, &config).unwrap().model;
    for omega in first.omega() {
        assert!((omega / lowest - 1.0).abs() < 1e-9, "{omega} {lowest}");
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let again = pool.install(|| run(&many, &config).unwrap().model);
    assert_eq!(first.hash(), again.hash());
}

#[test]
fn mass_properties_are_those_of_the_bar() {
    let config = BakeConfig { modes: 4, density: 500.0, ..BakeConfig::linear() };
    let model = run(&bar(), &config).unwrap().model;
    assert!((model.mass() - 20.0).abs() < 1e-10);
    for (got, expected) in model.center_of_mass().iter().zip([0.5, 0.1, 0.1]) {
        assert!((got - expected).abs() < 1e-12);
    }
    // The inertia about each axis is m (b^2 + c^2) / 12.
    let inertia = model.inertia();
    for (axis, expected) in
        [20.0 * 0.08 / 12.0, 20.0 * 1.04 / 12.0, 20.0 * 1.04 / 12.0].into_iter().enumerate()
    {
        assert!((inertia[axis][axis] / expected - 1.0).abs() < 1e-10, "{inertia:?}");
    }
    assert!(inertia[0][1].abs() < 1e-10 && inertia[0][2].abs() < 1e-10 && inertia[1][2].abs() < 1e-10);
    assert_eq!(model.rigid_modes(), 6);
    assert!(model.participation().iter().flatten().all(|&p| p == 0.0));
}

/// Tests the stretch of a hanging bar that cannot contract (nu = 0).
///
/// Under its own weight the bar stretches by `rho g L^2 / (2 E)`. The modes give
/// `sum_i phi_i(tip) p_i g / omega_i^2`.
#[test]
fn gravity_participation_stretches_the_hanging_bar() {
    let mesh = shapes::bar([12, 1, 1], [1.0, 0.3, 0.3]).unwrap();
    let (young, density, g) = (1e5, 1000.0, 9.81);
    let config = BakeConfig {
        young,
        density,
        poisson: 0.0,
        modes: 60,
        anchors: anchor("x<0.001"),
        ..BakeConfig::linear()
    };
    let model = run(&mesh, &config).unwrap().model;
    let tip = model.surface().positions().iter().position(|p| p[0] > 0.999).unwrap() as u32;
    let stretch: f64 = (0..model.mode_count())
        .map(|i| {
            f64::from(model.displacement_row(tip, 0, i)) * model.participation()[i][0] * g
                / model.omega()[i].powi(2)
        })
        .sum();
    let exact = density * g / (2.0 * young);
    assert!((stretch / exact - 1.0).abs() < 0.01, "{stretch} {exact}");
}

/// The first bending mode of a slender cantilever turns its tip by 1.37650 w / L (Euler-Bernoulli).
#[test]
fn rotation_basis_is_the_slope_of_the_bending_mode() {
    let mesh = shapes::bar([30, 1, 1], [3.0, 0.1, 0.1]).unwrap();
    let config = BakeConfig { poisson: 0.0, modes: 2, anchors: anchor("x<0.001"), ..BakeConfig::linear() };
    let model = run(&mesh, &config).unwrap().model;
    for mode in 0..2 {
        for (v, p) in model.surface().positions().iter().enumerate().filter(|(_, p)| p[0] > 2.999) {
            let row = |axis| f64::from(model.displacement_row(v as u32, axis, mode));
            let turn = |axis| f64::from(model.rotation_row(v as u32, axis, mode));
            // A deflection w(x) along y turns about z by w', and one along z turns about -y.
            for (deflection, slope) in [(row(1), turn(2)), (row(2), -turn(1))] {
                let scale = row(1).hypot(row(2));
                assert!((slope * 3.0 - 1.37650 * deflection).abs() < 0.02 * scale, "mode {mode} at {p:?}");
            }
        }
    }
}

#[test]
fn damping_follows_its_law() {
    let base = BakeConfig { modes: 5, anchors: anchor("x<0.001"), ..BakeConfig::linear() };
    let ratio = run(&bar(), &BakeConfig { damping: Damping::Ratio(0.05), ..base.clone() }).unwrap().model;
    let rayleigh = BakeConfig { damping: Damping::Rayleigh { alpha: 0.5, beta: 1e-3 }, ..base };
    let rayleigh = run(&bar(), &rayleigh).unwrap().model;
    for i in 0..5 {
        let omega = ratio.omega()[i];
        assert!((ratio.damping()[i] - 0.1 * omega).abs() < 1e-12 * omega);
        assert!((rayleigh.damping()[i] - (0.5 + 1e-3 * omega * omega)).abs() < 1e-12 * omega * omega);
    }
}

#[test]
fn a_skin_moves_with_the_tetrahedra() {
    let mesh = bar();
    let (boundary, _) = mesh.boundary();
    for element in [Element::Tet4, Element::Tet10] {
        let config = BakeConfig { element, modes: 8, anchors: anchor("x<0.001"), ..BakeConfig::linear() };
        let plain = run(&mesh, &config).unwrap().model;
        // The skin is the boundary itself, followed by the midpoints of the first edges of its
        // triangles.
        let mut skin = boundary.clone();
        let first = skin.positions.len() as u32;
        for t in &boundary.triangles {
            let [a, b] = [t[0], t[1]].map(|v| boundary.positions[v as usize]);
            skin.positions.push([0, 1, 2].map(|k| 0.5 * (a[k] + b[k])));
        }
        let dressed = bake(&mesh, Some(&skin), &config, &mut |_, _| ()).unwrap().model;
        let pairs: Vec<(u32, u32)> = (0..first).map(|v| (v, v)).collect();
        assert!(shape_difference(&plain, &dressed, &pairs) < 1e-5);
        assert_eq!(dressed.surface().positions().len(), skin.positions.len());
        if element == Element::Tet4 {
            for (index, t) in boundary.triangles.iter().enumerate() {
                for mode in 0..8 {
                    let ends = [t[0], t[1]].map(|v| dressed.displacement_row(v, 1, mode));
                    let middle = dressed.displacement_row(first + index as u32, 1, mode);
                    assert!((middle - 0.5 * (ends[0] + ends[1])).abs() < 1e-5);
                }
            }
        }
        for (v, p) in boundary.positions.iter().enumerate() {
            assert_eq!(plain.surface().anchored()[v], p[0] < 0.001);
            assert_eq!(dressed.surface().anchored()[v], p[0] < 0.001);
        }
    }
    let far = Surface {
        positions: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.5, 0.0]],
        triangles: vec![[0, 1, 2]],
        uvs: None,
    };
    let config = BakeConfig { modes: 2, ..BakeConfig::linear() };
    assert!(matches!(
        bake(&mesh, Some(&far), &config, &mut |_, _| ()),
        Err(BakeError::SkinFar { vertex: 2, .. })
    ));
}

#[test]
fn bad_numbers_are_refused_by_name() {
    let ok = BakeConfig { modes: 3, ..BakeConfig::linear() };
    for young in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let refused = run(&bar(), &BakeConfig { young, ..ok.clone() });
        assert!(matches!(refused, Err(BakeError::Parameter { name: "Young's modulus", .. })), "{young}");
    }
    for poisson in [-1.0, 0.5, 0.7, f64::NAN] {
        let refused = run(&bar(), &BakeConfig { poisson, ..ok.clone() });
        assert!(matches!(refused, Err(BakeError::Parameter { name: "Poisson ratio", .. })), "{poisson}");
    }
    for density in [0.0, -5.0, f64::NAN] {
        let refused = run(&bar(), &BakeConfig { density, ..ok.clone() });
        assert!(matches!(refused, Err(BakeError::Parameter { name: "density", .. })), "{density}");
    }
    for damping in [Damping::Ratio(-0.1), Damping::Rayleigh { alpha: f64::NAN, beta: 0.0 }] {
        assert!(matches!(
            run(&bar(), &BakeConfig { damping, ..ok.clone() }),
            Err(BakeError::Parameter { .. })
        ));
    }
    let tiny = shapes::cube(1, 1.0).unwrap();
    let all = BakeConfig { element: Element::Tet4, ..ok.clone() };
    // The cube has 8 nodes, so 24 degrees of freedom and 18 elastic modes.
    assert_eq!(run(&tiny, &BakeConfig { modes: 18, ..all.clone() }).unwrap().model.mode_count(), 18);
    assert!(matches!(
        run(&tiny, &BakeConfig { modes: 19, ..all.clone() }),
        Err(BakeError::Modes { most: 18, dofs: 24, .. })
    ));
    assert!(run(&tiny, &BakeConfig { modes: 0, ..all }).is_err());
}

#[test]
fn bad_meshes_and_anchors_are_refused_by_name() {
    let ok = BakeConfig { modes: 3, ..BakeConfig::linear() };
    let with = |anchors: &[&str]| BakeConfig {
        anchors: anchors.iter().map(|a| a.parse().unwrap()).collect(),
        ..ok.clone()
    };
    let mut flat = bar();
    let [a, b, c, _] = flat.tets[7];
    let middle = [0, 1, 2]
        .map(|k| (flat.nodes[a as usize][k] + flat.nodes[b as usize][k] + flat.nodes[c as usize][k]) / 3.0);
    flat.nodes.push(middle);
    flat.tets[7][3] = flat.nodes.len() as u32 - 1;
    assert!(matches!(run(&flat, &ok), Err(BakeError::Mesh(MeshError::FlatTet { tet: 7, .. }))));

    assert!(matches!(run(&bar(), &with(&["x<0.001", "y>7"])), Err(BakeError::AnchorHoldsNothing { .. })));
    assert!(matches!(run(&bar(), &with(&["x<2"])), Err(BakeError::AnchorHoldsEverything { .. })));
    assert!(matches!(run(&bar(), &with(&["x<0.5", "x>=0.5"])), Err(BakeError::AnchorHoldsEverything { .. })));
    // The bar is rotated to stand on its edge, so that the anchor contains only that edge.
    let mut wedge = bar();
    for p in &mut wedge.nodes {
        *p = [p[0], p[1] - p[2], p[1] + p[2]];
    }
    wedge.orient();
    assert!(matches!(run(&wedge, &with(&["z<0.001"])), Err(BakeError::AnchorTooThin { .. })));

    let mut two = bar();
    let offset = two.nodes.len() as u32;
    let other = bar();
    two.nodes.extend(other.nodes.iter().map(|p| [p[0] + 5.0, p[1], p[2]]));
    two.tets.extend(other.tets.iter().map(|t| t.map(|n| n + offset)));
    assert!(matches!(run(&two, &ok), Err(BakeError::LooseParts { parts: 2, .. })));
    assert!(matches!(run(&two, &with(&["x<0.001"])), Err(BakeError::LooseParts { parts: 2, .. })));
    assert!(run(&two, &with(&["x<0.001", "x>5.999"])).is_ok());
}

#[test]
fn exported_matrices_hold_the_mass_and_know_no_force_in_translation() {
    let folder = std::env::temp_dir().join(format!("pliant-export-{}", std::process::id()));
    let config = BakeConfig { modes: 3, export_matrices: Some(folder.clone()), ..BakeConfig::linear() };
    let model = run(&bar(), &config).unwrap().model;
    for (name, expected) in [("K.mtx", 0.0), ("M.mtx", model.mass())] {
        let text = std::fs::read_to_string(folder.join(name)).unwrap();
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some("%%MatrixMarket matrix coordinate real symmetric"));
        let head: Vec<usize> = lines.next().unwrap().split(' ').map(|x| x.parse().unwrap()).collect();
        assert_eq!(head[..2], [3 * model.info().nodes, 3 * model.info().nodes]);
        let (mut count, mut sum) = (0, 0.0);
        for line in lines {
            let parts: Vec<&str> = line.split(' ').collect();
            let (row, column): (usize, usize) = (parts[0].parse().unwrap(), parts[1].parse().unwrap());
            assert!(column <= row && row <= head[0]);
            let value: f64 = parts[2].parse().unwrap();
            count += 1;
            // A translation along x uses the rows and columns 3 i + 1.
            if row % 3 == 1 && column % 3 == 1 {
                sum += if row == column { value } else { 2.0 * value };
            }
        }
        assert_eq!(count, head[2]);
        assert!((sum - expected).abs() < 1e-6 * model.mass(), "{name}: {sum}");
    }
    std::fs::remove_dir_all(folder).unwrap();
}
