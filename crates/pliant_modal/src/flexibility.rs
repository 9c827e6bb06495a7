//! The residual flexibility of any patch, from the baked ones.

use nalgebra::Matrix3;

use crate::{ModalModel, ModelError, Patch, SurfaceMesh};

/// Sites that are blended where none lies at the patch itself.
const NEAREST: usize = 4;

/// Vertices up to which every pair of a patch counts in its sharpness.
const PAIRS: usize = 200;

impl ModalModel {
    /// Residual flexibility (3x3, m/N, body axes) of a patch, with `kept` of the modes kept.
    ///
    /// Exact at the baked places and radii. Between two radii it is linear in the patch's sharpness (one over its extent, as its vertices and
    /// their weights make it), which is what the compliance of a loaded patch goes by (Boussinesq: `(1 - nu^2) / (E a)` for a patch of
    /// extent `a`); between places, the four nearest are blended by inverse squared distance, each scaled to the patch's
    /// sharpness. What modes beyond `kept` would have given is added.
    /// A model without sites gets the half-space estimate `(1 - nu^2) / (2 E r)`.
    ///
    /// # Errors
    /// [`ModelError::Vertex`]: the patch is one of another surface, with a vertex that this one does not have.
    pub fn residual_flexibility(&self, patch: &Patch, kept: usize) -> Result<[[f64; 3]; 3], ModelError> {
        let count = self.surface().positions().len();
        match patch.entries().iter().enumerate().find(|(_, (vertex, _))| *vertex as usize >= count) {
            Some((index, &(vertex, _))) => Err(ModelError::Vertex { what: "patch", index, vertex, count }),
            None => Ok(self.flexibility_of(patch, kept)),
        }
    }

    /// [`residual_flexibility`](Self::residual_flexibility) of a patch whose vertices are known to be there.
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

    fn baked_flexibility(&self, patch: &Patch) -> Matrix3<f64> {
        let info = self.info();
        let radii = self.site_radii();
        let estimate = || {
            let radius = patch.radius().max(1e-3 * self.size()).max(f64::MIN_POSITIVE);
            Matrix3::identity() * ((1.0 - info.poisson * info.poisson) / (2.0 * info.young * radius))
        };
        // The pair of baked radii around the patch's own, or the two at the end that it lies beyond.
        let above = radii.partition_point(|&r| r < patch.radius());
        let (a, b) = match radii.len() {
            0 => return estimate(),
            1 => (0, 0),
            n => (above.clamp(1, n - 1) - 1, above.clamp(1, n - 1)),
        };
        // Sharpnesses are compared with one another, so all are measured alike.
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
            // Beyond the ends, or radii so small that both patches are the one vertex: in proportion.
            let (s, f) = if above == 0 { (sa, fa) } else { (sb, fb) };
            return f * (sharpness / s).clamp(0.125, 8.0);
        }
        let t = ((sharpness - sb) / (sa - sb)).clamp(0.0, 1.0);
        // A mean of two positive semi-definite matrices is one.
        fa * t + fb * (1.0 - t)
    }

    /// For one of the baked radii: the sharpness of a patch of that radius here, and its flexibility.
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

/// How sharp a patch is, 1/m. By `pairs` the energy of its weights under the kernel of the half-space, `sum w w' / d`, each vertex with itself as the
/// disc of its area (`16 / (3 pi a)`, so `3 / sqrt(A)`); else, for large patches, one over the root of the area that
/// carries the force, `sqrt(sum w^2 / A)`. What lies on an anchor is pressed in vain and does not count.
fn sharpness(surface: &SurfaceMesh, patch: &Patch, pairs: bool) -> f64 {
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
    let sharpness = if pairs { own + others } else { own.sqrt() };
    sharpness.max(f64::MIN_POSITIVE)
}
