use super::*;
use crate::element::Element;
use crate::factor::tests::bar;
use crate::lanczos;
use crate::solver::Solver;

/// A relative distance from an eigenvalue at which counts were seen to be right, and the blur that was told there.
fn margins(cells: [usize; 3], element: Element, average: bool) -> Vec<(usize, f64, f64)> {
    let (_, matrix, symbolic) = bar(cells, element, average);
    let solver = Solver::new(&matrix, symbolic, None).unwrap();
    let wanted = 12;
    let modes = lanczos::lowest(&solver, wanted, &mut |_| ()).unwrap();
    let mut out = Vec::new();
    for mode in 0..wanted {
        let lambda = modes.lambda[mode];
        let apart = |other: usize| (modes.lambda[other] / lambda - 1.0).abs() > 1e-3;
        if (mode > 0 && !apart(mode - 1)) || (mode + 1 < wanted && !apart(mode + 1)) {
            continue;
        }
        // From afar to the place where the count is wrong.
        let (mut right, mut told) = (1.0, 0.0);
        for distance in (6..15).map(|digits| 10f64.powi(-digits)) {
            let shifts = [lambda * (1.0 - distance), lambda * (1.0 + distance)];
            let counts = shifts.map(|shift| Count::new(&solver.factor.symbolic, &matrix, shift).unwrap());
            if counts[0].below != mode || counts[1].below != mode + 1 {
                break;
            }
            let blur = |at: usize| counts[at].blur(&modes.phi, wanted, shifts[at]);
            (right, told) = (distance, f64::max(blur(0), blur(1)));
        }
        out.push((mode, right, told));
    }
    out
}

#[test]
fn counts_are_right_as_near_to_an_eigenvalue_as_they_say() {
    for (cells, element, average) in [
        ([9, 4, 3], Element::Tet4, false),
        ([9, 4, 3], Element::Tet4, true),
        ([12, 8, 7], Element::Tet4, false),
        ([5, 3, 2], Element::Tet10, false),
    ] {
        for (mode, right, told) in margins(cells, element, average) {
            println!("{cells:?} {element:?} mode {mode}: right at {right:.0e}, told {told:.1e}");
            assert!(right <= 1e-6 && told <= 1e-6 && right <= 10.0 * told, "{mode} {right:e} {told:e}");
        }
    }
}
