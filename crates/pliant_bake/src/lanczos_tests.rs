use super::*;
use crate::element::Element;
use crate::factor::tests::bar;

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
    // Room for five blocks only: it must restart several times.
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
