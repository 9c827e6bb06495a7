//! The places at which a body may touch.

mod balls;

use std::sync::OnceLock;

use nalgebra::{Matrix3, Vector3};

pub(crate) use balls::{Ball, Sphere};

use super::surface_field::{Cloud, SurfaceField};
use crate::{
    HeldPatch, ModalModel, Patch, StepError,
    step::{Six, displacement},
};

/// Largest number of contact sites of a body.
const MAX_SITES: usize = 384;

/// Largest radius of a round site, as a multiple of the body's size. Flatter sites count as flat.
const FLAT: f64 = 4.0;

/// Distance over which the contact point of a round site slides, as a share of the spacing of the
/// sites.
///
/// With three quarters a ball would roll as on a sphere, but neighbors would share the load at one
/// point and be too stiff: 1.7 to 2.6 times the force of Hertz. With none a ball would roll as a
/// polyhedron and lose 7 % of its speed in a second.
const SLIDE: f64 = 0.25;

/// Tolerance of the fit of a round site, as a share of the depth of its cap.
const ROUND: f64 = 0.05;

/// A patch of the surface that may touch an obstacle.
///
/// Where the surface is locally a part of a sphere, the contact point slides over that sphere, so
/// that a ball rolls as a ball and not as a polyhedron. Elsewhere it is the vertex at the center.
#[derive(Debug)]
pub(crate) struct Site {
    pub(crate) vertex: u32,
    pub(crate) patch: HeldPatch,
    /// Center of the sphere, m, body axes. It is the vertex where the radius is zero.
    pub(crate) center: Vector3<f64>,
    /// Radius of the sphere, m.
    pub(crate) radius: f64,
    /// Direction from the center to the vertex, and the cosine of the angle up to which the contact
    /// point slides.
    pub(crate) outward: Vector3<f64>,
    pub(crate) reach: f64,
    /// Farthest distance of a contact point from the vertex, m.
    pub(crate) slides: f64,
    /// The ball to which the site belongs. If all of its neighbors do, it may lead the ball, and
    /// the center and the radius are those of the ball.
    pub(crate) ball: Option<Ball>,
    /// Outward normal of the surface at the vertex, body axes.
    pub(crate) facing: Vector3<f64>,
}

impl Site {
    /// The direction from the center to the contact point for an obstacle that lies in the
    /// direction `wanted` (body axes).
    pub(crate) fn toward(&self, wanted: &Vector3<f64>) -> Vector3<f64> {
        self.within(wanted, self.reach)
    }

    /// The same where the site leads its ball, if it has one.
    pub(crate) fn leading(&self, wanted: &Vector3<f64>) -> Vector3<f64> {
        self.within(wanted, self.ball.as_ref().map_or(self.reach, |ball| ball.reach))
    }

    fn within(&self, wanted: &Vector3<f64>, reach: f64) -> Vector3<f64> {
        let cosine = self.outward.dot(wanted);
        if cosine >= reach {
            return *wanted;
        }
        let across = wanted - cosine * self.outward;
        let length = across.norm();
        if length.is_nan() || length < 1e-12 {
            return self.outward;
        }
        let sine = (1.0 - reach * reach).max(0.0).sqrt();
        reach * self.outward + (sine / length) * across
    }

    /// The point of the rest shape in the direction `toward` from the center, m, body axes.
    pub(crate) fn rest(&self, toward: &Vector3<f64>) -> Vector3<f64> {
        self.center + self.radius * toward
    }
}

/// All contact sites of a model.
#[derive(Debug)]
pub(crate) struct ContactSites {
    pub(crate) sites: Vec<Site>,
    /// Largest displacement of a site per unit of each coordinate, kg^-1/2.
    pub(crate) largest: Vec<f64>,
    /// Angular frequencies of the model, rad/s.
    omega: Vec<f64>,
    /// Largest modal flexibility of a site, summed over the axes, m/N.
    softest: f64,
    /// Largest distance of a site from the center of mass at rest, m.
    pub(crate) radius: f64,
    /// Mean distance between neighboring sites, m.
    pub(crate) spacing: f64,
    /// All balls.
    pub(crate) balls: Vec<Sphere>,
    /// The six rows of all sites, for each mode those of one number for all sites after another.
    rows: Vec<f64>,
    /// The surface that other bodies touch, made at the first request.
    field: OnceLock<SurfaceField>,
}

impl ContactSites {
    /// Chooses the sites of a model for its first `modes` modes. The choice is deterministic: each
    /// next site is the vertex that is farthest from all sites so far.
    pub(crate) fn new(model: &ModalModel, modes: usize) -> Result<Self, StepError> {
        let surface = model.surface();
        let positions: Vec<Vector3<f64>> =
            surface.positions().iter().map(|p| Vector3::from(p.map(f64::from))).collect();
        let com = Vector3::from(model.center_of_mass());
        // Vertices of anchored parts cannot move and touch nothing. Of vertices at one place, the
        // first counts.
        let mut seen = vec![false; surface.welded_count()];
        let usable: Vec<bool> = (0..positions.len())
            .map(|v| {
                let first = !std::mem::replace(&mut seen[surface.welded()[v] as usize], true);
                first && !surface.anchored()[v]
            })
            .collect();
        let farthest = |nearest: &[f64]| {
            let mut best = None;
            for (v, distance) in nearest.iter().enumerate() {
                if usable[v] && best.is_none_or(|(_, most)| *distance > most) {
                    best = Some((v, *distance));
                }
            }
            best
        };
        let mut nearest: Vec<f64> = positions.iter().map(|p| (p - com).norm_squared()).collect();
        let mut chosen = Vec::new();
        while chosen.len() <= MAX_SITES {
            let Some((vertex, distance)) = farthest(&nearest) else { break };
            if distance <= 0.0 && !chosen.is_empty() {
                break;
            }
            if chosen.is_empty() {
                nearest.fill(f64::INFINITY);
            }
            if chosen.len() == MAX_SITES {
                break;
            }
            chosen.push(vertex);
            for (nearest, position) in nearest.iter_mut().zip(&positions) {
                *nearest = nearest.min((position - positions[vertex]).norm_squared());
            }
        }
        let area: f64 =
            (0..positions.len()).filter(|&v| usable[v]).map(|v| surface.area_around(v as u32)).sum();
        let spacing = (area / chosen.len().max(1) as f64).sqrt();
        let slide = SLIDE * spacing;
        let spread = |vertex: usize| {
            let near = |p: &&Vector3<f64>| (**p - positions[vertex]).norm() < 2.0 * spacing;
            positions.iter().filter(near).copied().collect::<Vec<_>>()
        };
        let mut normals = vec![[0.0; 3]; positions.len()];
        surface.normals(surface.positions(), &mut normals, &mut Vec::new());
        let mut sites = Vec::with_capacity(chosen.len());
        for &vertex in &chosen {
            let patch = Patch::around(surface, vertex as u32, spacing)
                .map_err(|_| StepError::Vertex { vertex: vertex as u32, count: positions.len() })?;
            let patch = HeldPatch::new(model, &patch, modes)?;
            let at = positions[vertex];
            let ball = fit(&at, &spread(vertex), model.size()).filter(|(_, radius)| *radius > slide);
            let (center, radius) = ball.unwrap_or((at, 0.0));
            let outward = if radius > 0.0 { (at - center) / radius } else { Vector3::y() };
            let reach = if radius > 0.0 { (slide / radius).min(1.5).cos() } else { 1.0 };
            let facing = Vector3::from(normals[vertex].map(f64::from));
            let slides = radius * (2.0 - 2.0 * reach).max(0.0).sqrt();
            let vertex = vertex as u32;
            let ball = None;
            sites.push(Site { vertex, patch, center, radius, outward, reach, slides, facing, ball });
        }
        let (balls, wide) = balls::find_balls(model, modes, spacing, &positions, &mut sites)?;
        let omega = model.omega()[..modes.min(model.mode_count())].to_vec();
        let mut softest = 0.0f64;
        let mut largest = vec![0.0f64; modes.min(model.mode_count())];
        for site in &sites {
            let rows = [0, 1, 2].map(|axis| site.patch.rows().displacement(axis));
            let mut flexibility = 0.0;
            for (mode, (most, omega)) in largest.iter_mut().zip(&omega).enumerate() {
                let square = rows.iter().map(|row| row[mode] * row[mode]).sum::<f64>();
                *most = most.max(square.sqrt());
                flexibility += square / (omega * omega);
            }
            softest = softest.max(flexibility);
        }
        let radius = sites.iter().map(|s| (positions[s.vertex as usize] - com).norm()).fold(0.0, f64::max);
        let mut rows = Vec::with_capacity(6 * sites.len() * largest.len());
        for mode in 0..largest.len() {
            for number in 0..6 {
                rows.extend(sites.iter().map(|site| site.patch.rows().of(number)[mode]));
            }
        }
        let field = OnceLock::new();
        let mut all = Self { sites, largest, omega, softest, radius, spacing, balls, rows, field };
        all.soften(wide);
        Ok(all)
    }

    /// The patches of some sites with their weights.
    pub(crate) fn patches<I: Iterator<Item = (usize, f64)> + Clone>(
        &self,
        carriers: I,
    ) -> impl Iterator<Item = (&HeldPatch, f64)> + Clone + use<'_, I> {
        carriers.filter_map(|(site, weight)| Some((&self.sites.get(site)?.patch, weight)))
    }

    /// Finds where all sites are at the coordinates `q`.
    pub(crate) fn place(&self, field: &SurfaceField, q: &[f64], warps: bool, cloud: &mut Cloud) {
        let count = self.sites.len();
        let used = if warps { 6 } else { 3 } * count;
        cloud.sixes.clear();
        cloud.sixes.resize(6 * count, 0.0);
        let sums = &mut cloud.sixes[..used];
        for (row, q) in self.rows.chunks_exact((6 * count).max(1)).zip(q) {
            sums.iter_mut().zip(row).for_each(|(sum, row)| *sum += row * q);
        }
        let six = |site: usize| Six::from_fn(|number, _| cloud.sixes[number * count + site]);
        let place =
            |(number, site): (usize, &Site)| site.rest(&site.outward) + displacement(&six(number), warps);
        cloud.sites.clear();
        cloud.sites.extend(self.sites.iter().enumerate().map(place));
        field.enclose(cloud);
    }

    /// The surface that other bodies touch. It depends on the model alone.
    pub(crate) fn field(&self, model: &ModalModel) -> &SurfaceField {
        self.field.get_or_init(|| SurfaceField::new(model, &self.sites))
    }

    /// Bound on the displacement of every site at the coordinates `q`, m.
    pub(crate) fn bound(&self, q: &[f64]) -> f64 {
        self.bound_of(|k| q[k])
    }

    /// Bound on the travel of every site between two shapes, m. It holds up to the turn of the
    /// warp.
    pub(crate) fn travel_bound(&self, from: &[f64], to: &[f64]) -> f64 {
        self.bound_of(|k| to[k] - from[k])
    }

    /// The smaller of two bounds: the triangle inequality, and the flexibility of the softest site
    /// times the elastic energy.
    fn bound_of(&self, q: impl Fn(usize) -> f64) -> f64 {
        let (mut sum, mut energy) = (0.0, 0.0);
        for (k, (most, omega)) in self.largest.iter().zip(&self.omega).enumerate() {
            let q = q(k);
            sum += most * q.abs();
            energy += (omega * q) * (omega * q);
        }
        f64::min(sum, (energy * self.softest).sqrt())
    }
}

/// The sphere through `at` that fits the points around it, if they lie on one and it is convex.
fn fit(at: &Vector3<f64>, around: &[Vector3<f64>], size: f64) -> Option<(Vector3<f64>, f64)> {
    let (mut matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
    let mut deepest = 0.0f64;
    for point in around {
        let way = point - at;
        let d2 = way.norm_squared();
        // Points on a sphere obey `2 way . (center - at) = |way|^2`. Near points weigh as much.
        if d2 > 0.0 {
            matrix += way * way.transpose() / d2;
            right += 0.5 * way;
            deepest = deepest.max(d2);
        }
    }
    if around.len() < 6 {
        return None;
    }
    let inward = matrix.cholesky()?.solve(&right);
    let radius = inward.norm();
    if !(radius > 0.0 && radius < FLAT * size) {
        return None;
    }
    // A flat or sharp surface is not a part of a sphere. The cap's depth sets the scale.
    let center = at + inward;
    let depth = 0.5 * deepest / radius;
    let off = around.iter().map(|p| ((p - center).norm() - radius).abs()).fold(0.0, f64::max);
    (off <= ROUND * depth && depth < 0.6 * radius).then_some((center, radius))
}
