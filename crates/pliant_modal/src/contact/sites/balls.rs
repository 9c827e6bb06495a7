//! Balls: parts of a surface that are parts of a sphere, and touch an obstacle at one place.

use nalgebra::{Matrix3, Vector3};

use super::{ContactSites, ROUND, Site};
use crate::{
    HeldPatch, ModalModel, Patch, StepError,
    contact::{
        indent::Softness,
        surface_field::{Carriers, MAX_CARRIERS},
    },
};

/// Difference of the centers and radii of sites of one ball, as a share of the radius.
const ALIKE: f64 = 0.1;

/// Distance of the neighbors of a site that must belong to its ball, and the one over which the
/// contact point of a leading site slides, as multiples of the spacing.
const NEIGHBORS: f64 = 1.7;
const COVERS: f64 = 1.25;

/// Distance of the sites that carry the place of a ball, as a multiple of the spacing, and the
/// smallest spread of them, so that sites along a line do.
const AROUND: f64 = 1.5;
const RIDGE: f64 = 1e-3;

/// Distance by which another site must be nearer to lead, as a multiple of the spacing.
const STAYS: f64 = 0.1;

/// Smallest radius of the patch whose flexibility says what the shape of the body adds to a
/// half-space, as a multiple of the spacing, and the wanted one, as a share of the ball's radius.
const WIDE: [f64; 2] = [1.5, 0.5];

/// Sharpness of a load of the size of a site, times the spacing, and the smallest share of its
/// compliance that a wide contact has.
const SITE: f64 = 2.0;
const LEFT: f64 = 0.1;

/// Ratio of two moduli from which on they are of different materials. Coarse elements alone make
/// 1.6.
const OTHER: f64 = 3.0;

/// The ball of a site: a part of the surface that is a part of a sphere.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ball {
    /// Number of the ball.
    pub(crate) number: usize,
    /// Whether the site may lead.
    pub(crate) leads: bool,
    /// Cosine of the angle up to which the contact point slides where the site leads.
    pub(super) reach: f64,
    /// Compliance without the half-space, along the normal and across it, at the baked stiffness,
    /// m/N.
    fixed: [f64; 2],
}

/// All sites of a ball, and how its surface gives way.
#[derive(Debug, Default)]
pub(crate) struct Sphere {
    /// The sites that may lead, and all that carry its places.
    leaders: Vec<u32>,
    carriers: Vec<u32>,
    /// Factor of the compliance of the half-space at the baked stiffness, m^2/N, see
    /// [`Indent`](super::Indent).
    pub(crate) slope: [f64; 2],
}

impl ContactSites {
    /// The site of a ball that is nearest to a direction from its center (body axes). The site
    /// `now` stays where another is not much nearer.
    pub(crate) fn leader(&self, ball: &Ball, toward: &Vector3<f64>, now: usize) -> usize {
        let radius = self.sites[now].radius;
        let margin = STAYS * self.spacing / radius;
        let distance = |site: usize| (self.sites[site].outward - toward).norm();
        let (mut best, mut least) = (now, distance(now) - margin);
        for site in self.balls[ball.number].leaders.iter().map(|&site| site as usize) {
            let distance = distance(site);
            if distance < least {
                (best, least) = (site, distance);
            }
        }
        best
    }

    /// Finds how all balls give way: what wide patches around their leaders say, with what the
    /// modes have at the sites that carry a place, in place of what they have in the patch.
    pub(super) fn soften(&mut self, wide: Vec<(Matrix3<f64>, HeldPatch)>) {
        let mut wide = wide.into_iter();
        for number in 0..self.balls.len() {
            for index in self.balls[number].leaders.clone() {
                let index = index as usize;
                let site = &self.sites[index];
                let (Some(ball), Some((mut fixed, patch))) = (&site.ball, wide.next()) else { return };
                let carriers = self.carriers(ball, &site.outward, index);
                for (mode, omega) in self.omega.iter().enumerate() {
                    let of = |patch: &HeldPatch| {
                        Vector3::from_fn(|axis, _| patch.rows().displacement(axis)[mode] / omega)
                    };
                    let (there, mut here) = (of(&patch), Vector3::zeros());
                    for (site, weight) in carriers.iter() {
                        here += weight * of(&self.sites[site].patch);
                    }
                    fixed += there * there.transpose() - here * here.transpose();
                }
                let along = site.outward.dot(&(fixed * site.outward));
                let fixed = [along, 0.5 * (fixed.trace() - along)];
                if let Some(ball) =
                    self.sites[index].ball.as_mut().filter(|_| fixed.iter().all(|x| x.is_finite()))
                {
                    ball.fixed = fixed;
                }
            }
        }
    }

    /// How the surface gives way at a place of a ball that these sites carry.
    pub(crate) fn softness(&self, ball: &Ball, carriers: &Carriers) -> Softness {
        let slope = self.balls[ball.number].slope;
        let (mut fixed, mut sum) = ([0.0; 2], 0.0);
        for (site, weight) in carriers.iter() {
            if let Some(ball) = self.sites[site].ball.filter(|ball| ball.leads && weight > 0.0) {
                fixed = [0, 1].map(|k| fixed[k] + weight * ball.fixed[k]);
                sum += weight;
            }
        }
        let fixed = if sum > 0.0 { fixed.map(|fixed| fixed / sum) } else { ball.fixed };
        // A load of the size of the sites has this beyond the modes, of which something is left.
        let sharpness = SITE / self.spacing;
        let fixed = [0, 1].map(|k| fixed[k].max(-0.9 * sharpness * slope[k]));
        let least = |k: usize| LEFT * sharpness - (1.0 - LEFT) * fixed[k] / slope[k];
        Softness { fixed, slope, least: least(0).max(least(1)).max(LEFT * sharpness) }
    }

    /// Whether a direction from the center of a ball (body axes) is one in which it touches at one
    /// place, and whether a site leads it there: the nearest one.
    pub(crate) fn leads(&self, ball: &Ball, toward: &Vector3<f64>, site: usize) -> [bool; 2] {
        let own = self.sites[site].outward.dot(toward);
        let (mut reached, mut nearest) = (false, ball.leads);
        for &other in &self.balls[ball.number].leaders {
            let other = other as usize;
            let cosine = self.sites[other].outward.dot(toward);
            reached |= self.sites[other].ball.is_some_and(|ball| cosine >= ball.reach);
            nearest &= !(cosine > own || (cosine == own && other < site));
            if reached && !nearest {
                break;
            }
        }
        [reached, reached && nearest]
    }

    /// The sites around the place of a ball in a direction from its center (body axes), with
    /// weights such that they change smoothly along the ball, and that a linear field is exact
    /// (moving least squares).
    pub(crate) fn carriers(&self, ball: &Ball, toward: &Vector3<f64>, site: usize) -> Carriers {
        let radius = self.sites[site].radius;
        let mut near = [(site, Vector3::zeros(), 0.0f64); MAX_CARRIERS];
        for &other in &self.balls[ball.number].carriers {
            let other = other as usize;
            let way = (radius / (AROUND * self.spacing)) * (self.sites[other].outward - toward);
            let left = 1.0 - way.norm_squared();
            // The farthest one has the smallest weight. It gives way where there are too many.
            let far = near.iter_mut().min_by(|a, b| a.2.total_cmp(&b.2));
            if let Some(far) = far.filter(|far| left > 0.0 && left * left > far.2) {
                *far = (other, way, left * left);
            }
        }
        let (mut sum, mut mean, mut square) = (0.0, Vector3::zeros(), RIDGE * Matrix3::identity());
        for (_, way, weight) in &near {
            sum += weight;
            mean += *weight * way;
            square += *weight * way * way.transpose();
        }
        let slope = square.cholesky().map_or_else(Vector3::zeros, |factor| -factor.solve(&mean));
        let total = sum + slope.dot(&mean);
        // Only where there is one site alone.
        if total.is_nan() || total <= 0.1 * sum {
            return Carriers::new(std::iter::once((site, 1.0)));
        }
        let weights =
            near.iter().map(|(other, way, weight)| (*other, weight * (1.0 + slope.dot(way)) / total));
        Carriers::new(weights)
    }
}

/// Finds the balls of a surface, and the sites that belong to them. Their neighbors' contact points
/// must be theirs too: the sphere may end beyond the last site.
pub(super) fn find_balls(
    model: &ModalModel,
    modes: usize,
    spacing: f64,
    positions: &[Vector3<f64>],
    sites: &mut [Site],
) -> Result<(Vec<Sphere>, Vec<(Matrix3<f64>, HeldPatch)>), StepError> {
    let at: Vec<Vector3<f64>> = sites.iter().map(|site| positions[site.vertex as usize]).collect();
    let mut of = vec![usize::MAX; sites.len()];
    let mut balls = Vec::new();
    for first in 0..sites.len() {
        if sites[first].radius <= 0.0 || of[first] != usize::MAX {
            continue;
        }
        let number = balls.len();
        let (center, radius) = (sites[first].center, sites[first].radius);
        let alike = |site: &Site| {
            site.radius > 0.0
                && (site.radius - radius).abs() <= ALIKE * radius
                && (site.center - center).norm() <= ALIKE * radius
        };
        // Another piece of the same sphere would do as well.
        let members: Vec<usize> =
            (0..sites.len()).filter(|&site| of[site] == usize::MAX && alike(&sites[site])).collect();
        let count = members.len() as f64;
        let center: Vector3<f64> =
            members.iter().map(|&site| sites[site].center).sum::<Vector3<f64>>() / count;
        let radius = members.iter().map(|&site| (at[site] - center).norm()).sum::<f64>() / count;
        members.iter().for_each(|&site| of[site] = number);
        balls.push((center, radius));
    }
    let mut list: Vec<Sphere> = balls.iter().map(|_| Sphere::default()).collect();
    for (site, &number) in of.iter().enumerate().filter(|(_, number)| **number < balls.len()) {
        list[number].carriers.push(site as u32);
        sites[site].ball = Some(Ball { number, leads: false, reach: sites[site].reach, fixed: [0.0; 2] });
    }
    let mut all = Vec::new();
    for number in 0..list.len() {
        let (center, radius) = balls[number];
        let mut grain = None;
        for index in list[number].carriers.clone() {
            let index = index as usize;
            let near = |&other: &usize| (at[other] - at[index]).norm() < NEIGHBORS * spacing;
            // Twice what the fit of a single site allows.
            let off = ((at[index] - center).norm() - radius).abs();
            let lies_on_it = off <= 2.0 * ROUND * 2.0 * spacing * spacing / radius;
            if !lies_on_it || !(0..sites.len()).filter(near).all(|other| of[other] == number) {
                continue;
            }
            let site = &mut sites[index];
            let wide = (WIDE[1] * radius).clamp(WIDE[0] * spacing, 2.0 * WIDE[0] * spacing);
            let patch = Patch::around(model.surface(), site.vertex, wide)
                .map_err(|_| StepError::Vertex { vertex: site.vertex, count: positions.len() })?;
            let grain = grain.get_or_insert_with(|| Grain::of(model, site.vertex, modes, radius));
            let outward = (at[index] - center).normalize();
            let (fixed, slope) = indentation(model, &patch, modes, &outward, grain);
            if !fixed.iter().chain(&slope).all(|x| x.is_finite()) {
                continue;
            }
            all.push((fixed, HeldPatch::new(model, &patch, modes)?));
            let reach = (COVERS * spacing / radius).min(1.5).cos();
            (site.center, site.radius, site.outward) = (center, radius, outward);
            site.slides = radius * (2.0 - 2.0 * reach).max(0.0).sqrt();
            site.ball = Some(Ball { number, leads: true, reach, fixed: [0.0; 2] });
            list[number].leaders.push(index as u32);
            list[number].slope = slope;
        }
    }
    Ok((list, all))
}

/// How a surface gives way around a place, as the bake has it.
#[derive(Debug, Clone, Copy)]
struct Grain {
    /// Softness of the material there relative to the base material's.
    softness: f64,
    /// Sharpness of a load on one vertex, as a multiple of that of a disc with the area of the
    /// vertex. Finite elements decide it.
    vertex: f64,
}

impl Grain {
    /// Fits the flexibility of a place at all baked radii: `fixed + softness (others + vertex own)`
    /// with the sharpness of vertices with each other and with themselves.
    fn of(model: &ModalModel, vertex: u32, modes: usize, widest: f64) -> Self {
        let even = Self { softness: 1.0, vertex: 1.0 };
        let [along, across] = softness(model);
        let points = |radius: &f64| {
            let patch = Patch::around(model.surface(), vertex, *radius).ok()?;
            let (flexibility, [others, own]) = model.flexibility_and_sharpness(&patch, modes);
            // All of it, with what the modes have.
            let rows = HeldPatch::new(model, &patch, modes).ok()?;
            let soft = |axis: usize| {
                let row = rows.rows().displacement(axis).iter().zip(model.omega());
                row.map(|(x, omega)| (x / omega).powi(2)).sum::<f64>()
            };
            let whole = flexibility.trace() + (0..3).map(soft).sum::<f64>();
            Some((whole / (along + 2.0 * across), others, own))
        };
        let radii = model.site_radii().iter().filter(|radius| **radius <= widest);
        let points: Vec<(f64, f64, f64)> = radii.filter_map(points).collect();
        if points.len() < 4 {
            return even;
        }
        let fit = |of: &dyn Fn(&(f64, f64, f64)) -> (f64, Vector3<f64>), ridge: &Vector3<f64>| {
            let mut matrix = Matrix3::from_diagonal(ridge);
            let mut right = Vector3::zeros();
            for point in &points {
                let (value, row) = of(point);
                matrix += row * row.transpose();
                right += value * row;
            }
            matrix.cholesky().map(|factor| factor.solve(&right))
        };
        let free = fit(&|(d, others, own)| (*d, Vector3::new(1.0, *others, *own)), &Vector3::zeros());
        let softness = free.map_or(1.0, |free| free[1]);
        // A number near one is that of the base material, and the rest is the elements'.
        let other = !(1.0 / OTHER..=OTHER).contains(&softness) && (0.0..).contains(&softness);
        let softness = if other { softness.clamp(1e-3, 1e3) } else { 1.0 };
        let known = |(d, others, own): &(f64, f64, f64)| {
            (*d - softness * *others, Vector3::new(1.0, softness * *own, 0.0))
        };
        let vertex = fit(&known, &Vector3::new(0.0, 0.0, 1.0)).map_or(1.0, |known| known[1]);
        Self { softness, vertex: if vertex.is_finite() { vertex.clamp(0.5, 4.0) } else { 1.0 } }
    }
}

/// How far a half-space moves under a unit force per sharpness of the load, m^2/N: along the normal
/// (Boussinesq), `(1 - nu^2) / (pi E)`, and across it (Cerruti, the mean over all directions),
/// `(1 + nu) (1 - nu / 2) / (pi E)`.
fn softness(model: &ModalModel) -> [f64; 2] {
    let info = model.info();
    let soft = (1.0 + info.poisson) / (std::f64::consts::PI * info.young);
    [soft * (1.0 - info.poisson), soft * (1.0 - 0.5 * info.poisson)]
}

/// Splits the residual flexibility of a patch into a part that depends on the size of the loaded
/// circle and one that does not: the shape of the body, less what the modes have. Returns that one,
/// and what the other has along and across the surface.
fn indentation(
    model: &ModalModel,
    patch: &Patch,
    modes: usize,
    outward: &Vector3<f64>,
    grain: &Grain,
) -> (Matrix3<f64>, [f64; 2]) {
    let (flexibility, [others, own]) = model.flexibility_and_sharpness(patch, modes);
    let [along, across] = softness(model).map(|soft| grain.softness * soft);
    let slope = across * Matrix3::identity() + (along - across) * outward * outward.transpose();
    (flexibility - (others + grain.vertex * own) * slope, [along, across])
}
