//! The exponential of a 3 x 3 matrix and its integral, by scaling and squaring.
//!
//! Each squaring doubles the relative error, and a stiff mode takes forty squarings. Double
//! precision would keep a third of the digits, and an undamped mode would gain or lose energy. With
//! pairs of doubles (106 bits) the error does not appear in the result.
//!
//! Sources: C. Moler, C. Van Loan, *Nineteen dubious ways to compute the exponential of a matrix*,
//! SIAM Review 45(1), 2003, method 3; T. J. Dekker, *A floating-point technique for extending the
//! available precision*, Numer. Math. 18, 1971.

/// An unevaluated sum of two doubles. The second is at most half a unit in the last place of the
/// first.
#[derive(Clone, Copy, Default)]
struct DoubleDouble(f64, f64);

impl DoubleDouble {
    fn plus(self, other: Self) -> Self {
        let sum = self.0 + other.0;
        let part = sum - self.0;
        let error = (self.0 - (sum - part)) + (other.0 - part);
        Self::renormalized(sum, error + (self.1 + other.1))
    }

    fn times(self, other: Self) -> Self {
        let product = self.0 * other.0;
        let error = self.0.mul_add(other.0, -product);
        Self::renormalized(product, error + (self.0 * other.1 + self.1 * other.0))
    }

    fn over(self, by: f64) -> Self {
        let first = self.0 / by;
        let rest = first.mul_add(-by, self.0) + self.1;
        Self::renormalized(first, rest / by)
    }

    fn renormalized(high: f64, low: f64) -> Self {
        let sum = high + low;
        Self(sum, low - (sum - high))
    }
}

type Square = [[DoubleDouble; 3]; 3];

fn product(a: &Square, b: &Square) -> Square {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            (0..3).fold(DoubleDouble::default(), |sum, k| sum.plus(a[i][k].times(b[k][j])))
        })
    })
}

fn image(a: &Square, x: &[DoubleDouble; 3]) -> [DoubleDouble; 3] {
    std::array::from_fn(|i| (0..3).fold(DoubleDouble::default(), |sum, k| sum.plus(a[i][k].times(x[k]))))
}

/// Computes `exp(A)` and `integral from 0 to 1 of exp(A s) ds b`.
///
/// `A` must be finite and its exponential must not grow.
pub(crate) fn exponential(a: [[f64; 3]; 3], b: [f64; 3]) -> ([[f64; 3]; 3], [f64; 3]) {
    let norm = a.iter().map(|row| row.iter().map(|x| x.abs()).sum::<f64>()).fold(0.0, f64::max);
    let mut squarings = 0;
    let mut scale = 1.0;
    while norm * scale > 0.125 {
        scale *= 0.5;
        squarings += 1;
    }
    let a: Square = a.map(|row| row.map(|x| DoubleDouble(x * scale, 0.0)));
    let b: [DoubleDouble; 3] = b.map(|x| DoubleDouble(x * scale, 0.0));
    // In the Taylor series at a norm of 1/8, the seventeenth term is below 1e-30.
    let mut term: Square =
        std::array::from_fn(|i| std::array::from_fn(|j| DoubleDouble(f64::from(u8::from(i == j)), 0.0)));
    let mut e = term;
    let mut g = b;
    for n in 1..=17u8 {
        term = product(&term, &a).map(|row| row.map(|x| x.over(f64::from(n))));
        let integrated = image(&term, &b);
        for i in 0..3 {
            for j in 0..3 {
                e[i][j] = e[i][j].plus(term[i][j]);
            }
            g[i] = g[i].plus(integrated[i].over(f64::from(n) + 1.0));
        }
    }
    for _ in 0..squarings {
        let more = image(&e, &g);
        g = std::array::from_fn(|i| g[i].plus(more[i]));
        e = product(&e, &e);
    }
    (e.map(|row| row.map(|x| x.0)), g.map(|x| x.0))
}
