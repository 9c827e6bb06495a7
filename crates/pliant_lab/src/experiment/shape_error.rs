//! Distance between two shapes on the surface.

use pliant_modal::ModalModel;

/// Approximate number of surface vertices at which shapes are compared.
const SAMPLES: usize = 48;

/// Compares shapes at evenly chosen surface vertices. The shapes are unwarped, so that the same
/// difference of coordinates counts the same in every shape.
pub(super) struct ShapeError {
    rows: Vec<Vec<[f64; 3]>>,
}

impl ShapeError {
    pub(super) fn new(model: &ModalModel) -> Self {
        let vertices = model.surface().positions().len();
        let row = |v: usize, mode: usize| -> [f64; 3] {
            std::array::from_fn(|a| f64::from(model.displacement_row(v as u32, a, mode)))
        };
        let modes = model.mode_count();
        let step = (vertices / SAMPLES).max(1);
        Self { rows: (0..vertices).step_by(step).map(|v| (0..modes).map(|m| row(v, m)).collect()).collect() }
    }

    /// Number of compared vertices.
    pub(super) fn places(&self) -> f64 {
        self.rows.len().max(1) as f64
    }

    /// Sum and largest of the squared differences at the compared vertices, m^2. Missing
    /// coordinates count as 0.
    pub(super) fn compare(&self, a: &[f64], b: &[f64]) -> (f64, f64) {
        let (mut sum, mut largest) = (0.0, 0.0_f64);
        for rows in &self.rows {
            let mut u = [0.0; 3];
            for (k, row) in rows.iter().enumerate() {
                let d = a.get(k).copied().unwrap_or(0.0) - b.get(k).copied().unwrap_or(0.0);
                for x in 0..3 {
                    u[x] += row[x] * d;
                }
            }
            let s = u.iter().map(|x| x * x).sum::<f64>();
            sum += s;
            largest = largest.max(s);
        }
        (sum, largest)
    }
}
