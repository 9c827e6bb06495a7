//! The first moments of the modes, with which a turning frame drives them.

use nalgebra::{DMatrix, Matrix3};

use crate::ModalModel;

/// How the turning of the anchors drives each mode.
#[derive(Debug)]
pub(crate) struct Moments {
    /// `integral of rho phi r^T` of each mode, kg^1/2 m, with `r` from the model's origin.
    pub(crate) first: Vec<Matrix3<f64>>,
    /// Largest distance of the surface from the origin, m.
    pub(crate) reach: f64,
}

impl Moments {
    /// Most vertices from which the moments are fitted.
    const SAMPLES: usize = 2_000;

    /// Share of the modes' mass that is added to the fit, so that shapes that hardly differ on the
    /// surface do not get large and opposite moments.
    const RIDGE: f64 = 1e-4;

    /// Finds the moments of a model.
    ///
    /// A model has its modes at the surface only, where the integrals would give the skin too much
    /// weight. The modes are orthonormal in mass, so their moments are the coefficients with which
    /// they make up the fields `r_b e_a`. These are fitted at the surface, weighted by area. The
    /// coefficients are right wherever the modes can show the field, whatever the weights.
    pub(crate) fn new(model: &ModalModel) -> Self {
        let (surface, modes) = (model.surface(), model.mode_count());
        let positions = surface.positions();
        let reach = positions.iter().map(|p| p.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>());
        let reach = reach.fold(0.0, f64::max).sqrt();
        let sampled: Vec<u32> =
            (0..positions.len() as u32).step_by(positions.len().div_ceil(Self::SAMPLES).max(1)).collect();
        let areas: Vec<f64> = sampled.iter().map(|&vertex| surface.area_around(vertex)).collect();
        let whole: f64 = areas.iter().sum();
        let roots: Vec<f64> = areas.iter().map(|area| (model.mass() * area / whole).sqrt()).collect();
        let rows = 3 * sampled.len();
        let shapes = DMatrix::from_fn(rows, modes, |row, mode| {
            roots[row / 3] * f64::from(model.displacement_row(sampled[row / 3], row % 3, mode))
        });
        // Column `3 b + a` is the field `r_b e_a`, as the columns of a matrix are stored.
        let fields = DMatrix::from_fn(rows, 9, |row, column| {
            let along = positions[sampled[row / 3] as usize][column / 3];
            if row % 3 == column % 3 { roots[row / 3] * f64::from(along) } else { 0.0 }
        });
        // Products of columns have the same bits on every processor, unlike those of matrices.
        let product = |a: &DMatrix<f64>, i: usize, b: &DMatrix<f64>, j: usize| a.column(i).dot(&b.column(j));
        let mut gram = DMatrix::zeros(modes, modes);
        for i in 0..modes {
            for j in 0..=i {
                let sum = product(&shapes, j, &shapes, i) + if i == j { Self::RIDGE } else { 0.0 };
                (gram[(i, j)], gram[(j, i)]) = (sum, sum);
            }
        }
        let right = DMatrix::from_fn(modes, 9, |mode, field| product(&shapes, mode, &fields, field));
        // A surface without area gives no numbers, and a model without moments still bends as it
        // is accelerated.
        let fitted = gram.cholesky().map(|gram| gram.solve(&right));
        let fitted = fitted.filter(|fitted| fitted.iter().all(|x| x.is_finite()));
        let moment = |mode: usize| {
            fitted
                .as_ref()
                .map_or_else(Matrix3::zeros, |fitted| Matrix3::from_fn(|a, b| fitted[(mode, 3 * b + a)]))
        };
        Self { first: (0..modes).map(moment).collect(), reach }
    }
}
