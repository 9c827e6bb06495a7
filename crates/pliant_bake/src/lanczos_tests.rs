use super::*;
use crate::element::Element;
use crate::factor::tests::{Cpu, bar};

fn check(solver: &Solver, modes: &Modes) -> (f64, f64) {
    let n = solver.dofs();
    let count = modes.lambda.len();
    let (mut k, mut m) = (vec![0.0; n * count], vec![0.0; n * count]);
    solver.matrix.stiffness_times(&modes.phi, count, &mut k);
    solver.matrix.mass_times(&modes.phi, count, &mut m);
    let mut worst: f64 = 0.0;
    for j in 0..count {
        let (mut r, mut s) = (0.0, 0.0);
        for i in 0..n {
            r += (k[i * count + j] - modes.lambda[j] * m[i * count + j]).powi(2);
            s += k[i * count + j].powi(2);
        }
        worst = worst.max((r / s).sqrt());
    }
    let gram = blocks::gram(Tall::new(&modes.phi, count), Tall::new(&m, count));
    let mut off: f64 = 0.0;
    for i in 0..count {
        for j in 0..count {
            off = off.max((gram[(i, j)] - if i == j { 1.0 } else { 0.0 }).abs());
        }
    }
    (worst, off)
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
    let (residual, orthonormality) = check(&solver, &modes);
    assert!(residual < 1e-8 && orthonormality < 1e-10, "{residual:e} {orthonormality:e}");
}

#[test]
#[ignore = "a measurement"]
fn speed() {
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| {
        for (cells, element) in [([20, 20, 20], Element::Tet4), ([40, 15, 15], Element::Tet4), ([12, 12, 12], Element::Tet10)] {
            let (_, matrix, symbolic) = bar(cells, element, false);
            let t = Cpu::now();
            let solver = Solver::new(&matrix, symbolic, None).unwrap();
            let f = t.elapsed();
            let t = Cpu::now();
            let modes = lowest(&solver, 60, &mut |_| ()).unwrap();
            let e = t.elapsed();
            println!("factor {f:?} modes {e:?} {:?}", check(&solver, &modes));
        }
    });
}
