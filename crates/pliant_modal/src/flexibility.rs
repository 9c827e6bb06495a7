//! Residual flexibility of any patch, interpolated from the baked sites.

use nalgebra::Matrix3;

use crate::{ModalModel, ModelError, Patch, SurfaceMesh};

/// Number of sites to blend if no site lies at the center of the patch.
const NEAREST: usize = 4;

/// Largest number of vertices for which the sharpness of a patch sums over all vertex pairs.
const PAIRS: usize = 200;

impl ModalModel {
    /// Residual flexibility (3x3, m/N, body axes) of a patch if the first `kept` modes are kept.
    ///
    /// The result is exact at the baked places and radii. Between two baked radii it is linear in
    /// the sharpness of the patch. The sharpness is one over the extent, computed from the vertices
    /// and weights. The compliance of a loaded patch is proportional to it (Boussinesq:
    /// `(1 - nu^2) / (E a)` for a patch of extent `a`). Between baked places, the four nearest
    /// sites are blended by inverse squared distance, each scaled to the sharpness of the patch.
    /// The contribution of the modes beyond `kept` is added. A model without sites gets the
    /// half-space estimate `(1 - nu^2) / (2 E r)`.
    ///
    /// # Errors
    /// Returns [`ModelError::Vertex`] if the patch belongs to another surface and has a vertex that
    /// this surface does not have.
    pub fn residual_flexibility(&self, patch: &Patch, kept: usize) -> Result<[[f64; 3]; 3], ModelError> {
        let count = self.surface().positions().len();
        match patch.entries().iter().enumerate().find(|(_, (vertex, _))| *vertex as usize >= count) {
            Some((index, &(vertex, _))) => Err(ModelError::Vertex { what: "patch", index, vertex, count }),
            None => Ok(self.flexibility_of(patch, kept)),
        }
    }

    /// Computes [`residual_flexibility`](Self::residual_flexibility) without checking the vertices
    /// of the patch.
    pub(crate) fn flexibility_of(&self, patch: &Patch, kept: usize) -> [[f64; 3]; 3] {
        let mut flexibility = self.baked_flexibility(patch);
        for mode in kept..self.mode_count() {
            let mut phi = nalgebra::Vector3::zeros();
            for &(v, w) in patch.entries() {
                for axis in 0..3 {
                    phi[axis] += w * f64::from(self.displacement_row(v, axis, mode));
                }
            }
            flexibility += phi * phi.transpose() / self.omega()[mode].powi(2);
        }
        std::array::from_fn(|i| std::array::from_fn(|j| flexibility[(i, j)]))
    }

    /// Residual flexibility (3x3, m/N) of a patch of this surface, and its sharpness (1/m): that of
    /// each vertex with the others, and that of the vertices with themselves.
    pub(crate) fn flexibility_and_sharpness(&self, patch: &Patch, kept: usize) -> (Matrix3<f64>, [f64; 2]) {
        let flexibility = Matrix3::from(self.flexibility_of(patch, kept)).transpose();
        let pairs = patch.entries().len() <= PAIRS;
        let [own, others] = terms(self.surface(), patch, pairs);
        // Without pairs a disc has 1 / sqrt(A), and with them 16 / (3 pi a).
        let disc = 16.0 / (3.0 * std::f64::consts::PI.sqrt());
        (flexibility, if pairs { [others, own] } else { [disc * own.sqrt(), 0.0] })
    }

    fn baked_flexibility(&self, patch: &Patch) -> Matrix3<f64> {
        let info = self.info();
        let radii = self.site_radii();
        let estimate = || {
            let radius = patch.radius().max(1e-3 * self.size()).max(f64::MIN_POSITIVE);
            Matrix3::identity() * ((1.0 - info.poisson * info.poisson) / (2.0 * info.young * radius))
        };
        // The two baked radii around the radius of the patch. Beyond the largest or smallest baked
        // radius these are the two nearest.
        let above = radii.partition_point(|&r| r < patch.radius());
        let (a, b) = match radii.len() {
            0 => return estimate(),
            1 => (0, 0),
            n => (above.clamp(1, n - 1) - 1, above.clamp(1, n - 1)),
        };
        // Sharpnesses are compared with one another, so all must be measured in the same way.
        let vertices =
            Patch::around(self.surface(), patch.center(), radii[b]).map_or(0, |p| p.entries().len());
        let pairs = vertices.max(patch.entries().len()) <= PAIRS;
        let sharpness = sharpness(self.surface(), patch, pairs);
        let (Some((sa, fa)), Some((sb, fb))) =
            (self.baked_at(patch, radii[a], pairs), self.baked_at(patch, radii[b], pairs))
        else {
            return estimate();
        };
        if above == 0 || above == radii.len() || sa <= sb * (1.0 + 1e-9) {
            // The radius is beyond the baked radii, or both radii are so small that the patches are
            // the same single vertex. The flexibility is then proportional to the sharpness.
            let (s, f) = if above == 0 { (sa, fa) } else { (sb, fb) };
            return f * (sharpness / s).clamp(0.125, 8.0);
        }
        let t = ((sharpness - sb) / (sa - sb)).clamp(0.0, 1.0);
        // A mean of two positive semi-definite matrices is positive semi-definite.
        fa * t + fb * (1.0 - t)
    }

    /// Returns the sharpness of a patch of the baked `radius` at this place and its flexibility.
    fn baked_at(&self, patch: &Patch, radius: f64, pairs: bool) -> Option<(f64, Matrix3<f64>)> {
        let sites = &self.parts().sites;
        let positions = self.surface().positions();
        let sharpness = |vertex: u32| {
            let patch = Patch::around(self.surface(), vertex, radius).ok()?;
            Some(sharpness(self.surface(), &patch, pairs))
        };
        let here = sharpness(patch.center())?;
        let center = positions[patch.center() as usize];
        let mut nearest = [(f64::INFINITY, usize::MAX); NEAREST];
        for (index, site) in sites.iter().enumerate().filter(|(_, s)| s.radius == radius) {
            let p = positions[site.vertex as usize];
            let d2: f64 = (0..3).map(|k| f64::from(p[k] - center[k]).powi(2)).sum();
            if d2 < nearest[NEAREST - 1].0 {
                nearest[NEAREST - 1] = (d2, index);
                nearest.sort_by(|a, b| a.0.total_cmp(&b.0));
            }
        }
        let of = |index: usize| Matrix3::from_fn(|i, j| sites[index].flexibility[i][j]);
        if nearest[0].0 == 0.0 {
            return Some((here, of(nearest[0].1)));
        }
        let (mut sum, mut total) = (Matrix3::zeros(), 0.0);
        for &(d2, index) in nearest.iter().filter(|(d2, _)| d2.is_finite()) {
            let weight = 1.0 / d2.max(f64::MIN_POSITIVE);
            sum += of(index) * (weight * here / sharpness(sites[index].vertex)?);
            total += weight;
        }
        (total > 0.0).then(|| (here, sum / total))
    }
}

/// Sharpness of a patch, 1/m.
///
/// With `pairs` it is the energy of the weights under the kernel of the half-space, `sum w w' / d`.
/// The term of a vertex with itself is that of a disc with the area of the vertex (`16 / (3 pi a)`,
/// so `3 / sqrt(A)`). Without `pairs`, for large patches, it is one over the root of the area that
/// carries the force, `sqrt(sum w^2 / A)`. Anchored vertices cannot move and do not count.
fn sharpness(surface: &SurfaceMesh, patch: &Patch, pairs: bool) -> f64 {
    let [own, others] = terms(surface, patch, pairs);
    let sharpness = if pairs { own + others } else { own.sqrt() };
    sharpness.max(f64::MIN_POSITIVE)
}

/// The terms of the sharpness: of vertices with themselves, and with each other.
fn terms(surface: &SurfaceMesh, patch: &Patch, pairs: bool) -> [f64; 2] {
    let moving = || patch.entries().iter().filter(|(v, _)| !surface.anchored()[*v as usize]);
    let at = |v: u32| surface.positions()[v as usize].map(f64::from);
    let mut own = 0.0;
    let mut others = 0.0;
    for (k, &(v, weight)) in moving().enumerate() {
        let area = surface.area_around(v);
        if area > 0.0 {
            own += if pairs { 3.0 * weight * weight / area.sqrt() } else { weight * weight / area };
        }
        if pairs {
            let p = at(v);
            for &(other, w) in moving().take(k) {
                let q = at(other);
                let d2: f64 = (0..3).map(|k| (p[k] - q[k]).powi(2)).sum();
                if d2 > 0.0 {
                    others += 2.0 * weight * w / d2.sqrt();
                }
            }
        }
    }
    [own, others]
}
