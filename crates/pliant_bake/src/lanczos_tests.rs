use pliant_mesh::{TetMesh, shapes};

use super::*;
use crate::bake::elimination_order;
use crate::factor::tests::bar;
use crate::fem::{FeMesh, Law, Lists};
use crate::rigid::MassProperties;
use crate::sparse::BlockCsr;
use crate::symbolic::Symbolic;
use pliant_modal::Element;

/// Returns the matrices of a mesh in elimination order, and the rigid modes if no node is held.
fn matrices(mesh: &TetMesh, held: impl Fn([f64; 3]) -> bool) -> (BlockCsr, Symbolic, Option<Vec<f64>>) {
    let fe = FeMesh::new(mesh, Element::Tet4);
    let held: Vec<bool> = fe.nodes.iter().map(|&p| held(p)).collect();
    let (number, ordered) = elimination_order(&fe, &fe.graph(false), &held);
    let law = Law { lambda: 1.0, mu: 1.0, density: 1.0, average_pressure: false };
    let matrix = fe.assemble(&law, &number, &ordered);
    let rigid = held.iter().all(|held| !held).then(|| {
        let mut positions = vec![[0.0; 3]; fe.nodes.len()];
        for (&row, &p) in number.iter().zip(&fe.nodes) {
            positions[row as usize] = p;
        }
        MassProperties::new(&fe, law.density).rigid_modes(positions.into_iter())
    });
    (matrix, Symbolic::new(&ordered), rigid)
}

/// Returns the lowest eigenvalues of a mesh that is held where `held` returns true.
fn modes_of(mesh: &TetMesh, wanted: usize, held: impl Fn([f64; 3]) -> bool) -> Vec<f64> {
    let (matrix, symbolic, rigid) = matrices(mesh, held);
    let solver = Solver::new(&matrix, symbolic, rigid).unwrap();
    let modes = lowest(&solver, wanted, &mut |_| ()).unwrap();
    let (residual, orthonormality) = crate::bake::accuracy(&matrix, &modes);
    assert!(residual < 1e-8 && orthonormality < 1e-10, "{residual:e} {orthonormality:e}");
    modes.lambda
}

/// Returns how many values differ from the expected ones.
///
/// The solver does not separate eigenvalues that are closer than its tolerance.
fn wrong(got: &[f64], expected: &[f64]) -> usize {
    assert_eq!(got.len(), expected.len());
    got.iter().zip(expected).filter(|(a, b)| (*a / *b - 1.0).abs() > 1e-8).count()
}

/// Makes `count` equal bars side by side that are not connected.
///
/// The coordinates are multiples of a quarter, so the bars are equal to the bit.
fn bars(count: usize, cells: [usize; 3]) -> TetMesh {
    let one = shapes::bar(cells, cells.map(|c| c as f64 / 4.0)).unwrap();
    let mut out = TetMesh::default();
    for copy in 0..count {
        let first = out.nodes.len() as u32;
        out.nodes.extend(one.nodes.iter().map(|&[x, y, z]| [x, y + 2.0 * copy as f64, z]));
        out.tets.extend(one.tets.iter().map(|tet| tet.map(|node| first + node)));
    }
    out
}

/// Returns the lowest eigenvalues of a body of `copies` equal parts from those of one part.
fn copied(one: &[f64], copies: usize, wanted: usize) -> Vec<f64> {
    one.iter().flat_map(|&x| std::iter::repeat_n(x, copies)).take(wanted).collect()
}

#[test]
fn equal_bars_have_every_mode_as_often_as_there_are_bars() {
    let cells = [4, 1, 1];
    let held = |p: [f64; 3]| p[0] == 0.0;
    // The bar has 48 degrees of freedom and is solved densely.
    let one = modes_of(&bars(1, cells), 12, held);
    let mut failed = Vec::new();
    for (count, wanted) in [(2, 20), (12, 20), (32, 20), (32, 60), (40, 100), (100, 30)] {
        let got = modes_of(&bars(count, cells), wanted, held);
        let wrong = wrong(&got, &copied(&one, count, wanted));
        if wrong > 0 {
            failed.push(format!("{count} bars: {wrong} of {wanted} modes wrong"));
        }
    }
    assert!(failed.is_empty(), "{failed:#?}");
}

/// Makes a diagonal pencil with three eigenvalues on each node and different masses.
fn diagonal(values: &[f64]) -> (BlockCsr, Symbolic) {
    let nodes = values.len() / 3;
    let graph = Lists { offsets: (0..=nodes).collect(), items: (0..nodes as u32).collect::<Vec<u32>>() };
    let mut matrix = BlockCsr::zeros(&graph);
    for (node, values) in values.chunks_exact(3).enumerate() {
        // The masses are powers of two, so the quotients equal the values to the bit.
        let mass = [0.25, 0.5, 1.0, 2.0][node % 4];
        matrix.mass[node] = mass;
        for (axis, value) in values.iter().enumerate() {
            matrix.stiffness[9 * node + 4 * axis] = value * mass;
        }
    }
    (matrix, Symbolic::new(&graph))
}

#[test]
fn known_multiplicities_come_out_whole() {
    let near = 1.0 + 1e-9;
    let mut failed = Vec::new();
    for (name, clusters) in [
        ("apart", vec![(1.0, 1), (2.0, 9), (3.0, 40), (5.0, 3)]),
        ("1e-9 apart", vec![(1.0, 1), (near, 9), (near * near, 40), (near * near * near, 3)]),
        ("1e-9 apart, lowest alone", vec![(1.0, 1), (2.0, 9), (2.0 * near, 40), (2.5, 3)]),
        ("one of 60", vec![(1.0, 60)]),
    ] {
        let mut values: Vec<f64> =
            clusters.iter().flat_map(|&(value, copies)| std::iter::repeat_n(value, copies)).collect();
        let few = values.len();
        values.extend((0..900 - few).map(|i| 6.0 + 0.37 * i as f64));
        let expected = values.clone();
        // 900 and 497 have no common divisor, so this permutation spreads the values over the
        // degrees of freedom.
        let spread: Vec<f64> = (0..900).map(|i| values[i * 497 % 900]).collect();
        let (matrix, symbolic) = diagonal(&spread);
        let solver = Solver::new(&matrix, symbolic, None).unwrap();
        for wanted in [5, 12, 30, few, few + 10] {
            let modes = lowest(&solver, wanted, &mut |_| ()).unwrap();
            let wrong = wrong(&modes.lambda, &expected[..wanted]);
            if wrong > 0 {
                failed.push(format!("{name}: {wrong} of {wanted} values wrong"));
            }
        }
    }
    assert!(failed.is_empty(), "{failed:#?}");
}

/// Makes a comb: a back with equal teeth.
fn comb(teeth: usize, back: f64) -> TetMesh {
    let cells = [5, 2 * teeth - 1, 1];
    let mut mesh = shapes::bar(cells, cells.map(|c| c as f64)).unwrap();
    let nodes = mesh.nodes.clone();
    mesh.tets.retain(|tet| {
        let middle = [0, 1].map(|k| tet.iter().map(|&n| nodes[n as usize][k]).sum::<f64>() / 4.0);
        middle[0] < back || middle[1] % 2.0 < 1.0
    });
    mesh.drop_unused_nodes();
    mesh
}

#[test]
fn a_body_with_equal_parts_equals_the_dense_solution() {
    for (mesh, wanted, held) in [
        (comb(2, 1.0), 12, 0.0),
        (comb(14, 1.0), 40, 0.0),
        (comb(14, 1.0), 60, 1.0),
        // A negative bound leaves the body free.
        (comb(14, 1.0), 40, -1.0),
        (comb(9, 2.0), 60, -1.0),
    ] {
        let (matrix, symbolic, rigid) = matrices(&mesh, |p| p[0] <= held);
        let solver = Solver::new(&matrix, symbolic, rigid).unwrap();
        let exact = dense(&solver, wanted).unwrap();
        let got = lowest(&solver, wanted, &mut |_| ()).unwrap();
        let wrong = wrong(&got.lambda, &exact.lambda);
        assert_eq!(wrong, 0, "{} dofs: {:?} {:?}", matrix.dofs(), got.lambda, exact.lambda);
    }
}

#[test]
fn equals_the_dense_solution() {
    let (_, matrix, symbolic) = bar([6, 3, 3], Element::Tet4, false);
    let solver = Solver::new(&matrix, symbolic, None).unwrap();
    let modes = lowest(&solver, 20, &mut |_| ()).unwrap();
    let exact = dense(&solver, 20).unwrap();
    for (a, b) in modes.lambda.iter().zip(&exact.lambda) {
        assert!((a / b - 1.0).abs() < 1e-11, "{a} {b}");
    }
    let (residual, orthonormality) = crate::bake::accuracy(&matrix, &modes);
    assert!(residual < 1e-8 && orthonormality < 1e-10, "{residual:e} {orthonormality:e}");
}

#[test]
fn restarts_when_its_space_is_full() {
    let (_, matrix, symbolic) = bar([9, 5, 5], Element::Tet4, false);
    let solver = Solver::new(&matrix, symbolic, None).unwrap();
    let mut lanczos = Lanczos::new(&solver, 12);
    // The space has room for five blocks only, so the iteration must restart several times.
    lanczos.stride = 5 * lanczos.width;
    lanczos.basis.truncate(matrix.dofs() * lanczos.stride);
    lanczos.projected = Mat::zeros(lanczos.stride, lanczos.stride);
    let ritz = lanczos.run(&mut |_| ()).unwrap();
    let modes = polish(&solver, &ritz, 12).unwrap();
    let roomy = lowest(&solver, 12, &mut |_| ()).unwrap();
    for (a, b) in modes.lambda.iter().zip(&roomy.lambda) {
        assert!((a / b - 1.0).abs() < 1e-11, "{a} {b}");
    }
    let (residual, _) = crate::bake::accuracy(&matrix, &modes);
    assert!(residual < 1e-8, "{residual:e}");
}

/// Tests a free body, whose rigid motion is deflated, among equal parts that are held.
#[test]
fn rigid_modes_are_counted_as_such() {
    let (copies, wanted, cells) = (33, 50, [4, 1, 1]);
    let alone = |p: [f64; 3]| p[1] < 1.0;
    let fe = FeMesh::new(&bars(copies, cells), Element::Tet4);
    let held: Vec<bool> = fe.nodes.iter().map(|&p| p[0] == 0.0 && !alone(p)).collect();
    let (number, ordered) = elimination_order(&fe, &fe.graph(false), &held);
    let law = Law { lambda: 1.0, mu: 1.0, density: 1.0, average_pressure: false };
    let matrix = fe.assemble(&law, &number, &ordered);
    let mut positions = vec![[0.0; 3]; matrix.nodes()];
    for ((&row, &p), _) in number.iter().zip(&fe.nodes).zip(&held).filter(|(_, held)| !**held) {
        positions[row as usize] = p;
    }
    let one = FeMesh::new(&bars(1, cells), Element::Tet4);
    let mut rigid = MassProperties::new(&one, law.density).rigid_modes(positions.iter().copied());
    for (rows, &p) in rigid.chunks_exact_mut(18).zip(&positions) {
        if !alone(p) {
            rows.fill(0.0);
        }
    }
    let mut expected = copied(&modes_of(&bars(1, cells), 12, |p| p[0] == 0.0), copies - 1, 300);
    expected.extend(modes_of(&bars(1, cells), 12, |_| false));
    expected.sort_by(f64::total_cmp);
    let solver = Solver::new(&matrix, Symbolic::new(&ordered), Some(rigid)).unwrap();
    let got = lowest(&solver, wanted, &mut |_| ()).unwrap();
    assert_eq!(wrong(&got.lambda, &expected[..wanted]), 0, "{:?}", got.lambda);
}

/// Tests a rod so slender that its first mode is lost in rounding. The solver must return an error
/// instead of unverified modes.
#[test]
fn what_cannot_be_counted_is_an_error() {
    let (matrix, symbolic, _) = matrices(&bars(1, [3000, 1, 1]), |p| p[0] == 0.0);
    let solver = Solver::new(&matrix, symbolic, None).unwrap();
    let failure = lowest(&solver, 1, &mut |_| ()).unwrap_err();
    assert!(matches!(failure, Failure::Uncounted { .. }), "{failure:?}");
}
