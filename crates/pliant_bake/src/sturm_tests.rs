use super::*;
use crate::factor::tests::bar;
use crate::lanczos;
use crate::solver::Solver;
use pliant_modal::Element;

/// Returns for each isolated mode the smallest relative distance from the eigenvalue at which the
/// counts are right, and the blur there.
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
        // The distance decreases until a count is wrong.
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

/// Makes a small generator of numbers in -1 to 1.
fn numbers(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

/// Tests shifts anywhere in the spectrum, where up to half of the pivots are negative and already
/// the first fronts are indefinite.
#[test]
fn counts_are_those_of_all_eigenvalues() {
    for (cells, element, average) in [
        ([4, 3, 3], Element::Tet4, false),
        ([4, 3, 2], Element::Tet4, true),
        ([2, 2, 1], Element::Tet10, false),
    ] {
        let (_, matrix, symbolic) = bar(cells, element, average);
        let n = matrix.dofs();
        let solver = Solver::new(&matrix, symbolic, None).unwrap();
        let all = lanczos::lowest(&solver, n, &mut |_| ()).unwrap();
        let mut random = numbers(7);
        for at in 0..200 {
            let place = (random() + 1.0) / 2.0;
            let shift = all.lambda[0] * (0.5 * all.lambda[n - 1] / all.lambda[0]).powf(place);
            let count = Count::new(&solver.factor.symbolic, &matrix, shift).unwrap();
            let blur = count.blur(&all.phi, n, shift);
            let nearest = all.lambda.iter().map(|l| (l / shift - 1.0).abs()).fold(1.0, f64::min);
            let below = all.lambda.iter().filter(|&&l| l < shift).count();
            assert!(blur < 1e-7, "{at}: {blur:e}");
            assert!(count.below == below || blur > nearest, "{at}: {} {below} {blur:e}", count.below);
        }
    }
}

/// The pivots of one and two columns multiply to the block.
#[test]
fn pivots_make_the_block_again() {
    let mut random = numbers(3);
    for (n, filled) in [(1, true), (2, false), (7, true), (40, false), (128, true)] {
        let mut block = Mat::zeros(n, n);
        for i in 0..n {
            // An empty diagonal requires pivots of two columns.
            for j in 0..if filled { i + 1 } else { i } {
                let x = random();
                (block[(i, j)], block[(j, i)]) = (x, x);
            }
        }
        let mut factored = block.clone();
        let pivots = Pivots::new(factored.as_mut()).unwrap();
        let two = pivots.turn.iter().flatten().count();
        assert!(filled || two > 0);
        // For any rows B below the block, the result must give B A^-1 B^T.
        let rows = Mat::from_fn(5, n, |_, _| random());
        let mut applied = rows.clone();
        pivots.apply(factored.as_ref(), applied.as_mut());
        let flags: Vec<bool> = pivots.values.iter().map(|&value| value < 0.0).collect();
        let right = signed(applied.as_ref(), &flags);
        let right = right.as_ref().unwrap_or(&applied);
        // The reference A^-1 B^T uses all eigenvectors.
        let (values, vectors) = crate::blocks::symmetric_eigen(block.as_ref()).unwrap();
        let along = &rows * &vectors;
        let negative = values.iter().filter(|&&value| value < 0.0).count();
        assert_eq!(negative, pivots.negative().count());
        let divided = Mat::from_fn(5, n, |i, j| along[(i, j)] / values[j]);
        let expected = &divided * along.transpose();
        let got = &applied * right.transpose();
        let (mut off, mut size): (f64, f64) = (0.0, 0.0);
        for i in 0..5 {
            for j in 0..5 {
                off = off.max((expected[(i, j)] - got[(i, j)]).abs());
                size = size.max(expected[(i, j)].abs());
            }
        }
        assert!(off < 1e-9 * size, "{n}: {off:e} of {size:e}");
        // The diagonal equals the squares of all pivots minus twice those of the negative ones.
        for (i, square) in pivots.squares(factored.as_ref()).into_iter().enumerate() {
            assert!(square >= -2.0 * block[(i, i)] - 1e-9, "{n}: {square} {}", block[(i, i)]);
        }
    }
    assert!(Pivots::new(Mat::<f64>::zeros(3, 3).as_mut()).is_err());
}

#[test]
fn counts_are_equal_to_the_bit_whatever_the_threads() {
    let (_, matrix, symbolic) = bar([9, 6, 5], Element::Tet4, false);
    let count = |threads: usize, shift: f64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let count = pool.install(|| Count::new(&symbolic, &matrix, shift).unwrap());
        (count.below, count.squares.iter().map(|x| x.to_bits()).collect::<Vec<u64>>())
    };
    for shift in [0.01, 1.0, 20.0] {
        assert!(count(1, shift) == count(4, shift), "{shift}");
    }
}

/// Measures the time of a count.
///
/// `cargo test -p pliant_bake --lib what_counting_costs -- --ignored --nocapture`
#[test]
#[ignore = "a measurement"]
fn what_counting_costs() {
    for (cells, element, wanted) in [
        ([40, 5, 5], Element::Tet4, 60),
        ([42, 9, 9], Element::Tet4, 60),
        ([21, 13, 12], Element::Tet4, 60),
        ([21, 13, 12], Element::Tet4, 20),
        ([40, 5, 5], Element::Tet10, 60),
        ([42, 9, 9], Element::Tet10, 60),
    ] {
        let (fe, matrix, symbolic) = bar(cells, element, false);
        let (mut factor, mut modes, mut count) = (Vec::new(), Vec::new(), Vec::new());
        let mut told = String::new();
        for _ in 0..5 {
            let clock = std::time::Instant::now();
            let solver = Solver::new(&matrix, symbolic.clone(), None).unwrap();
            factor.push(clock.elapsed().as_secs_f64());
            let clock = std::time::Instant::now();
            let found = lanczos::lowest(&solver, wanted, &mut |_| ()).unwrap();
            modes.push(clock.elapsed().as_secs_f64());
            let clock = std::time::Instant::now();
            let shift = (1.0 - 1e-6) * found.lambda[wanted - 1];
            let counted = Count::new(&symbolic, &matrix, shift).unwrap();
            let blur = counted.blur(&found.phi, wanted, shift);
            count.push(clock.elapsed().as_secs_f64());
            told = format!("{} below {shift:.4}, blur {blur:.1e}", counted.below);
        }
        let [factor, modes, count] = [factor, modes, count].map(|mut times| {
            times.sort_by(f64::total_cmp);
            times[2]
        });
        println!(
            "{} tetrahedra, {element:?}, {wanted} modes: factor {factor:.3} s, modes {modes:.3} s, of which the count \
             {count:.3} s: {:.1} % more than both without; {told}",
            fe.elements().len(),
            100.0 * count / (factor + modes - count)
        );
    }
}
