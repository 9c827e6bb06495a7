//! The small system of all pulls, `(A + C) pull = gap`, solved in place.

/// Solves `M x = b` for a symmetric `M`, given by its lower triangle row by row, in place. A direction that rounding has
/// eaten (two hands on one spot, more rows than modes) gets no share of its own and leaves the solution of the others
/// standing, as in the body's own solve. False when a number is not finite.
pub(crate) fn solve_lower(m: &mut [f64], x: &mut [f64]) -> bool {
    let n = x.len();
    for j in 0..n {
        let diagonal = m[j * n + j];
        let square: f64 = m[j * n..j * n + j].iter().map(|a| a * a).sum();
        let pivot = diagonal - square;
        if pivot.is_nan() {
            return false;
        }
        if pivot <= 1e-13 * diagonal.abs() {
            for i in j + 1..n {
                m[i * n + j] = 0.0;
            }
            m[j * n + j] = f64::MAX.sqrt();
            continue;
        }
        let root = pivot.sqrt();
        m[j * n + j] = root;
        for i in j + 1..n {
            let (above, below) = m.split_at_mut(i * n);
            let (other, row) = (&above[j * n..j * n + j], &mut below[..n]);
            let sum: f64 = row[..j].iter().zip(other).map(|(a, b)| a * b).sum();
            row[j] = (row[j] - sum) / root;
        }
    }
    for j in 0..n {
        let sum: f64 = m[j * n..j * n + j].iter().zip(x.iter()).map(|(a, b)| a * b).sum();
        x[j] = (x[j] - sum) / m[j * n + j];
    }
    for j in (0..n).rev() {
        let sum: f64 = (j + 1..n).map(|k| m[k * n + j] * x[k]).sum();
        x[j] = (x[j] - sum) / m[j * n + j];
    }
    x.iter().all(|x| x.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_positive_definite_systems_and_survives_lost_rank() {
        // M = [[4, 2, 0], [2, 5, 3], [0, 3, 6]], x = (1, -2, 3): M x = (0, 1, 12).
        let mut m = [4.0, 0.0, 0.0, 2.0, 5.0, 0.0, 0.0, 3.0, 6.0];
        let mut x = [0.0, 1.0, 12.0];
        assert!(solve_lower(&mut m, &mut x));
        for (got, want) in x.iter().zip([1.0, -2.0, 3.0]) {
            assert!((got - want).abs() < 1e-14, "{x:?}");
        }
        // Rows 0 and 2 are one row: the shares still solve it.
        let full = [[4.0, 1.0, 4.0], [1.0, 3.0, 1.0], [4.0, 1.0, 4.0]];
        let mut m = full.as_flattened().to_vec();
        let mut x = [1.0, 2.0, 1.0];
        assert!(solve_lower(&mut m, &mut x));
        for (row, want) in full.iter().zip([1.0, 2.0, 1.0]) {
            let got: f64 = row.iter().zip(&x).map(|(a, b)| a * b).sum();
            assert!((got - want).abs() < 1e-12, "{got} and {want}");
        }
        assert!(!solve_lower(&mut [f64::NAN], &mut [1.0]));
        assert!(solve_lower(&mut [], &mut []));
    }
}
