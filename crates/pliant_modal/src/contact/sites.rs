//! The places at which a body may touch.

use std::sync::OnceLock;

use nalgebra::{Matrix3, Vector3};

use super::{
    indent::Softness,
    surface_field::{Carriers, Cloud, MAX_CARRIERS, SurfaceField},
};
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

/// The ball of a site: a part of the surface that is a part of a sphere.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ball {
    /// Number of the ball.
    pub(crate) number: usize,
    /// Whether the site may lead.
    pub(crate) leads: bool,
    /// Cosine of the angle up to which the contact point slides where the site leads.
    reach: f64,
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
        let (balls, wide) = find_balls(model, modes, spacing, &positions, &mut sites)?;
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
    fn soften(&mut self, wide: Vec<(Matrix3<f64>, HeldPatch)>) {
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

/// Finds the balls of a surface, and the sites that belong to them. Their neighbors' contact points
/// must be theirs too: the sphere may end beyond the last site.
fn find_balls(
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
