//! Eight double-precision numbers at once, and 3x3 matrices of them, in loops that vectorize.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// Number of lanes.
pub(crate) const LANES: usize = 8;

/// One number in each lane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lane(pub(crate) [f64; LANES]);

macro_rules! elementwise {
    ($($trait:ident $method:ident $op:tt),*) => {$(
        impl $trait for Lane {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                let mut out = self;
                for l in 0..LANES {
                    out.0[l] = self.0[l] $op other.0[l];
                }
                out
            }
        }
    )*};
}

elementwise!(Add add +, Sub sub -, Mul mul *, Div div /);

impl Neg for Lane {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        let mut out = self;
        out.0.iter_mut().for_each(|x| *x = -*x);
        out
    }
}

impl Mul<Lane> for f64 {
    type Output = Lane;
    #[inline(always)]
    fn mul(self, other: Lane) -> Lane {
        let mut out = other;
        out.0.iter_mut().for_each(|x| *x *= self);
        out
    }
}

/// A number, or one in each lane, for formulas that serve both.
pub(crate) trait Number:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    fn of(x: f64) -> Self;
}

impl Number for f64 {
    #[inline(always)]
    fn of(x: f64) -> Self {
        x
    }
}

impl Number for Lane {
    #[inline(always)]
    fn of(x: f64) -> Self {
        Self::splat(x)
    }
}

impl Lane {
    #[inline(always)]
    pub(crate) fn splat(x: f64) -> Self {
        Self([x; LANES])
    }

    /// Computes `self + by * x` with one rounding.
    #[inline(always)]
    pub(crate) fn plus(self, by: f64, x: Self) -> Self {
        let mut out = self;
        for l in 0..LANES {
            out.0[l] = by.mul_add(x.0[l], out.0[l]);
        }
        out
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        let mut out = self;
        out.0.iter_mut().for_each(|x| *x = x.sqrt());
        out
    }

    #[inline(always)]
    pub(crate) fn abs(self) -> Self {
        let mut out = self;
        out.0.iter_mut().for_each(|x| *x = x.abs());
        out
    }

    #[inline(always)]
    pub(crate) fn max(self, other: f64) -> Self {
        let mut out = self;
        out.0.iter_mut().for_each(|x| *x = if *x > other { *x } else { other });
        out
    }

    /// Whether all lanes are larger than those of `other`. NaN is not.
    #[inline(always)]
    pub(crate) fn all_above(&self, other: &Self) -> bool {
        let mut all = true;
        for l in 0..LANES {
            all &= self.0[l] > other.0[l];
        }
        all
    }

    /// Lanes of `yes` where `self < other`, of `no` elsewhere.
    #[inline(always)]
    pub(crate) fn if_less(self, other: Self, yes: Self, no: Self) -> Self {
        let mut out = no;
        for l in 0..LANES {
            out.0[l] = if self.0[l] < other.0[l] { yes.0[l] } else { no.0[l] };
        }
        out
    }
}

/// A vector of three in each lane.
pub(crate) type Vector = [Lane; 3];

#[inline(always)]
pub(crate) fn dot(a: &Vector, b: &Vector) -> Lane {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross(a: &Vector, b: &Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
pub(crate) fn scaled(by: Lane, a: &Vector) -> Vector {
    [by * a[0], by * a[1], by * a[2]]
}

/// Eigenvalues and eigenvectors of symmetric matrices by four sweeps of cyclic Jacobi rotations.
///
/// `a` holds the entries 00, 11, 22, 01, 02, 12. The vectors are `[vector][axis]`.
#[inline(always)]
pub(crate) fn eigen(a: [Lane; 6]) -> (Vector, [Vector; 3]) {
    const SWEEPS: usize = 4;
    let (zero, one) = (Lane::splat(0.0), Lane::splat(1.0));
    let mut d = [a[0], a[1], a[2]];
    // The entry beside the axes p and q lies at 2 - r of the other axis r.
    let mut off = [a[5], a[4], a[3]];
    let mut v = [[one, zero, zero], [zero, one, zero], [zero, zero, one]];
    for _ in 0..SWEEPS {
        for (p, q, r) in [(0, 1, 2), (0, 2, 1), (1, 2, 0)] {
            let apq = off[r];
            let gap = d[q] - d[p];
            let size = gap.abs() + (gap * gap + 4.0 * (apq * apq)).sqrt() + Lane::splat(f64::MIN_POSITIVE);
            let t = 2.0 * apq / size;
            let t = gap.if_less(zero, -t, t);
            let c = one / (one + t * t).sqrt();
            let s = t * c;
            d[p] = d[p] - t * apq;
            d[q] = d[q] + t * apq;
            off[r] = zero;
            // The entries (r, p) and (r, q) lie at the other axes q and p.
            let (rp, rq) = (off[q], off[p]);
            off[q] = c * rp - s * rq;
            off[p] = s * rp + c * rq;
            let (x, y) = (v[p], v[q]);
            v[p] = [c * x[0] - s * y[0], c * x[1] - s * y[1], c * x[2] - s * y[2]];
            v[q] = [s * x[0] + c * y[0], s * x[1] + c * y[1], s * x[2] + c * y[2]];
        }
    }
    (d, v)
}
