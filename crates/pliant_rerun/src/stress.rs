//! The stress in a body's skin, computed from the strain of its triangles.

use pliant_modal::SurfaceMesh;

/// The rest shape of a surface's triangles, from which strains are measured.
///
/// A free surface carries no pressure, so its skin is in plane stress, and the strain within a
/// triangle is sufficient. `F` is the deformation of a triangle in its own plane. Green's strain
/// `E = (F^T F - 1) / 2` does not depend on rotations. Hooke's law in two dimensions gives
/// `s_xx = Y / (1 - nu^2) (E_xx + nu E_yy)` and `s_xy = Y / (1 + nu) E_xy` (Y: Young's modulus).
/// Under a hand, where the surface carries a pressure, this is only a part of the stress.
#[derive(Debug)]
pub(crate) struct StressSkin {
    triangles: Vec<Option<Rest>>,
    /// Sum of the areas around each vertex.
    around: Vec<f32>,
}

/// A triangle at rest in its own plane: the inverse of its edges, which is an upper triangular
/// matrix, and its area.
#[derive(Debug, Clone, Copy)]
struct Rest {
    inverse: [f32; 3],
    area: f32,
}

fn minus(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl StressSkin {
    pub fn new(surface: &SurfaceMesh) -> Self {
        let at = |v: u32| surface.positions().get(v as usize).copied().unwrap_or_default();
        let mut around = vec![0.0; surface.positions().len()];
        let triangles = surface
            .triangles()
            .iter()
            .map(|corners| {
                let [a, b, c] = corners.map(at);
                let (e, f) = (minus(b, a), minus(c, a));
                // In the plane of the triangle, e = (x, 0) and f = (y, z).
                let x = dot(e, e).sqrt();
                let y = dot(e, f) / x;
                let z = (dot(f, f) - y * y).max(0.0).sqrt();
                let area = 0.5 * x * z;
                // Slivers give no usable strain.
                let sound = area.is_finite() && area > 1e-6 * dot(e, e).max(dot(f, f));
                sound.then(|| {
                    for &v in corners {
                        if let Some(sum) = around.get_mut(v as usize) {
                            *sum += area;
                        }
                    }
                    Rest { inverse: [1.0 / x, -y / (x * z), 1.0 / z], area }
                })
            })
            .collect();
        Self { triangles, around }
    }

    /// Writes the von Mises stress at each vertex, Pa, the mean of the adjacent triangles, to
    /// `out`.
    ///
    /// Returns the largest stress.
    pub fn stress(
        &self,
        surface: &SurfaceMesh,
        positions: &[[f32; 3]],
        young: f32,
        poisson: f32,
        out: &mut Vec<f32>,
    ) -> f32 {
        out.clear();
        out.resize(positions.len(), 0.0);
        let direct = young / (1.0 - poisson * poisson);
        let shear = young / (1.0 + poisson);
        let at = |v: u32| positions.get(v as usize).copied().unwrap_or_default();
        for (corners, rest) in surface.triangles().iter().zip(&self.triangles) {
            let Some(Rest { inverse: [p, q, r], area }) = *rest else { continue };
            let [a, b, c] = corners.map(at);
            let (e, f) = (minus(b, a), minus(c, a));
            let first = e.map(|x| x * p);
            let second: [f32; 3] = std::array::from_fn(|k| e[k] * q + f[k] * r);
            let exx = 0.5 * (dot(first, first) - 1.0);
            let eyy = 0.5 * (dot(second, second) - 1.0);
            let exy = 0.5 * dot(first, second);
            let (sxx, syy) = (direct * (exx + poisson * eyy), direct * (eyy + poisson * exx));
            let sxy = shear * exy;
            let mises = (sxx * sxx - sxx * syy + syy * syy + 3.0 * sxy * sxy).sqrt();
            for &v in corners {
                if let Some(sum) = out.get_mut(v as usize) {
                    *sum += area * mises;
                }
            }
        }
        let mut largest = 0.0f32;
        for (stress, area) in out.iter_mut().zip(&self.around) {
            *stress = if *area > 0.0 { *stress / area } else { 0.0 };
            largest = largest.max(*stress);
        }
        largest
    }
}
