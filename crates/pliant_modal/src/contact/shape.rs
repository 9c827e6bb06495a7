//! A body in a certain state, as something that other bodies touch.

use std::cell::Cell;

use nalgebra::{Matrix3, Vector3};

use super::{
    ContactSites,
    surface_field::{ALONG, Carriers, Cloud, Place, SMOOTH, Side, SurfaceField},
};
use crate::{
    HeldPatch,
    step::{Frame, Six, Tangent, displacement, tangent},
};

/// Rounds of the search for the place of the rest shape that lies nearest to a point.
const ROUNDS: usize = 6;

/// How far beyond the edge of a face a contact with this face may lie, as a share of the body's
/// size. Without it the corners of equal bodies in a stack would touch in one step and not in the
/// next.
const SHELF: f64 = 0.01;

/// Distance by which a contact may leave its triangle before it changes to another, as a share of
/// the body's size. Without it a contact at a vertex would change its normal from step to step.
const KEPT: f64 = 1e-4;

/// The six numbers of a body's sites at one state, as far as they were asked for.
#[derive(Debug, Clone, Default)]
pub(crate) struct Sixes {
    stamp: Cell<u32>,
    list: Vec<Cell<(u32, Six)>>,
    /// Where all sites are, if it was asked for, with the stamp of the six numbers.
    cloud: Cloud,
    placed: u32,
}

impl Sixes {
    /// Makes room for the sites of a body and forgets all.
    pub(crate) fn prepare(&mut self, sites: usize) {
        self.list.clear();
        self.list.resize(sites, Cell::new((0, Six::zeros())));
        self.stamp.set(1);
        self.placed = 0;
    }

    /// Finds where all sites of a body are.
    pub(crate) fn place_all(&mut self, sites: &ContactSites, field: &SurfaceField, q: &[f64], warps: bool) {
        if self.placed != self.stamp.get() {
            self.placed = self.stamp.get();
            sites.place(field, q, warps, &mut self.cloud);
        }
    }

    /// Where all sites are, after [`Sixes::place_all`].
    pub(crate) fn cloud(&self) -> Option<&Cloud> {
        (self.placed == self.stamp.get()).then_some(&self.cloud)
    }

    /// Forgets all.
    pub(crate) fn forget(&self) {
        self.stamp.set(self.stamp.get() + 1);
    }
}

/// A body at some coordinates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shape<'a> {
    pub(crate) sixes: Option<&'a Sixes>,
    pub(crate) sites: &'a ContactSites,
    pub(crate) field: &'a SurfaceField,
    pub(crate) warps: bool,
    pub(crate) frame: &'a Frame,
    pub(crate) q: &'a [f64],
    /// Size of the body, m.
    pub(crate) size: f64,
    /// Bound on the displacements at these coordinates, m.
    pub(crate) bound: f64,
    /// Where all sites are, if it is known, and how far they may be from there, m.
    pub(crate) cloud: Option<(&'a Cloud, f64)>,
}

/// What is known of a place before the search for it.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Guess {
    None,
    /// A place that is near.
    Place(Place),
    /// A site of the body that is near.
    Site(usize),
}

/// A place of a body's surface near a point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Near {
    pub(crate) place: Place,
    /// Position of the place's material, m, world axes.
    pub(crate) at: Vector3<f64>,
    /// Outward normal, world axes.
    pub(crate) normal: Vector3<f64>,
    /// Signed distance of the point to the surface, m.
    pub(crate) distance: f64,
}

impl Shape<'_> {
    fn turn(&self) -> Matrix3<f64> {
        *self.frame.rotation().to_rotation_matrix().matrix()
    }

    /// Position of a site's material point in the direction `toward`, m, and its derivative by the
    /// six numbers, world axes.
    pub(crate) fn site(&self, index: usize, toward: &Vector3<f64>) -> (Vector3<f64>, Tangent) {
        let rest = self.sites.sites.get(index).map_or_else(Vector3::zeros, |site| site.rest(toward));
        let (moved, tangent) = tangent(&self.six_of(index), self.warps);
        (self.frame.to_world(rest + moved), self.turn() * tangent)
    }

    /// Displacement of a site, m, body axes.
    pub(crate) fn moved(&self, index: usize) -> Vector3<f64> {
        displacement(&self.six_of(index), self.warps)
    }

    /// Outward normal of the surface at a site, world axes.
    pub(crate) fn facing(&self, index: usize) -> Vector3<f64> {
        let Some(site) = self.sites.sites.get(index) else { return Vector3::y() };
        let six = if self.warps { self.six_of(index) } else { site.patch.rows().reduce(self.q, true) };
        self.frame.rotation() * (HeldPatch::rotation_of(&six) * site.facing)
    }

    fn six(&self, carriers: impl Iterator<Item = (usize, f64)>) -> Six {
        carriers.fold(Six::zeros(), |sum, (site, weight)| sum + weight * self.six_of(site))
    }

    fn six_of(&self, index: usize) -> Six {
        let known = self.sixes.and_then(|sixes| Some((sixes.stamp.get(), sixes.list.get(index)?)));
        if let Some((stamp, cell)) = known
            && cell.get().0 == stamp
        {
            return cell.get().1;
        }
        let site = self.sites.sites.get(index);
        let six = site.map_or_else(Six::zeros, |site| site.patch.rows().reduce(self.q, self.warps));
        if let Some((stamp, cell)) = known {
            cell.set((stamp, six));
        }
        six
    }

    /// Position of a place's material, m, and its derivative by the six numbers, world axes.
    pub(crate) fn material(&self, place: &Place, carriers: &Carriers) -> (Vector3<f64>, Tangent) {
        let (moved, tangent) = tangent(&self.six(carriers.iter()), self.warps);
        (self.frame.to_world(self.field.rest(place) + moved), self.turn() * tangent)
    }

    /// Displacement of a place (m) and the gradient of the deformation of the surface there, body
    /// axes.
    fn deformed(&self, place: &Place) -> (Vector3<f64>, Matrix3<f64>) {
        let mut middle = Six::zeros();
        let mut corners = [Vector3::zeros(); 3];
        let rest = self.field.corners(place);
        for (k, (corner, weight)) in corners.iter_mut().zip(place.weights()).enumerate() {
            let carriers = self.field.corner_carriers(place, k).iter();
            let six = self.six(carriers.map(|(site, weight)| (*site as usize, *weight)));
            *corner = rest[k] + displacement(&six, self.warps);
            middle += weight * six;
        }
        let frame = |[a, b, c]: [Vector3<f64>; 3]| {
            let (ab, ac) = (b - a, c - a);
            let across = ab.cross(&ac);
            let length = across.norm();
            Matrix3::from_columns(&[ab, ac, if length > 0.0 { across / length } else { across }])
        };
        let before = frame(rest.map(|corner| *corner)).try_inverse();
        let gradient = before.map_or_else(Matrix3::identity, |inverse| frame(corners) * inverse);
        let gradient = if gradient.iter().all(|x| x.is_finite()) { gradient } else { Matrix3::identity() };
        (displacement(&middle, self.warps), gradient)
    }

    /// The distance of a point (m, world axes) to the smooth surface at a place.
    pub(crate) fn at(&self, place: &Place, point: &Vector3<f64>) -> Near {
        let (moved, gradient) = self.deformed(place);
        self.near(place, &moved, &gradient, point)
    }

    /// As [`Shape::at`], but beside an edge or a corner the normal leads to the point.
    pub(crate) fn beside(&self, place: &Place, point: &Vector3<f64>) -> Near {
        self.beyond(self.at(place, point), point)
    }

    /// Beside an edge or a corner where the surface is not smooth, no face looks at the point, and
    /// the nearest place is as far as the way to it.
    fn beyond(&self, near: Near, point: &Vector3<f64>) -> Near {
        let way = point - near.at;
        let (length, above) = (way.norm(), near.normal.dot(&way));
        let sharp = above > 0.0 && (above < SMOOTH * length || self.field.is_sharp(&near.place));
        if sharp { Near { normal: way / length, distance: length, ..near } } else { near }
    }

    fn near(
        &self,
        place: &Place,
        moved: &Vector3<f64>,
        gradient: &Matrix3<f64>,
        point: &Vector3<f64>,
    ) -> Near {
        let (smooth, _, rise) = self.field.normals(place);
        let normal = gradient.try_inverse().map_or(smooth, |inverse| inverse.tr_mul(&smooth));
        let normal = self.turn() * normal.try_normalize(1e-9).unwrap_or(smooth);
        let at = self.frame.to_world(self.field.rest(place) + moved);
        Near { place: *place, at, normal, distance: normal.dot(&(point - at)) - rise }
    }

    /// The place of the surface that is nearest to a point (m, world axes), no farther than
    /// `within` (m), where the surface looks at `facing`, an outward normal of another body in
    /// world axes. `kept` is the place that it had before. Without such a place the error is a
    /// distance that the point is away at least, m.
    ///
    /// The point is pulled back to the rest shape by the deformation of the triangle that is
    /// nearest there, and again until it stays.
    pub(crate) fn look(
        &self,
        point: &Vector3<f64>,
        facing: &Vector3<f64>,
        within: f64,
        kept: Option<&Place>,
        guess: Guess,
    ) -> Result<Near, f64> {
        let local = self.frame.to_local(point);
        let facing = self.turn().tr_mul(facing);
        // A body that hardly bends has no need of a search without direction.
        let stiff = self.bound < 0.05 * self.size;
        let (mut x, mut wanted) = (local, stiff.then_some(facing));
        let mut reach = within + self.bound;
        let near = 2.0 * within + 0.01 * self.size;
        let mut hint = None;
        match guess {
            Guess::None => {}
            Guess::Place(place) => hint = Some(place),
            Guess::Site(site) => {
                (x, reach) = (local - self.moved(site), near);
                hint = self.field.place_of(site);
            }
        }
        let kept = kept.filter(|kept| self.field.has(kept));
        if let Some((moved, gradient)) = kept.map(|kept| self.deformed(kept)) {
            let inverse = gradient.try_inverse().ok_or(0.0)?;
            let rest = kept.map_or(local, |kept| self.field.rest(kept));
            x = rest + inverse * (local - rest - moved);
            wanted = gradient.tr_mul(&facing).try_normalize(1e-9);
            reach = near;
        }
        for round in 0..ROUNDS {
            let kept = kept.and_then(|kept| self.field.on_same_triangle(kept, &x));
            let place = match kept {
                // Only what is nearer by more than the slack replaces the triangle.
                Some((place, distance)) if wanted.is_some() && distance < reach => {
                    let nearer = distance - KEPT * self.size;
                    let found = (nearer > 0.0).then(|| self.field.closest(&x, wanted.as_ref(), nearer, None));
                    found.flatten().unwrap_or(place)
                }
                _ => self.field.closest(&x, wanted.as_ref(), reach, hint.as_ref()).ok_or(within)?,
            };
            hint = Some(place);
            let (moved, gradient) = self.deformed(&place);
            let rest = self.field.rest(&place);
            let next = rest + gradient.try_inverse().ok_or(0.0)? * (local - rest - moved);
            let still = (next - x).norm() <= 1e-6 * self.size;
            if wanted.is_some() && (still || round + 1 == ROUNDS) {
                let near = self.near(&place, &moved, &gradient, point);
                let way = point - near.at;
                let across = (way - near.normal * near.normal.dot(&way)).norm();
                // Beyond the edge of all faces that look this way.
                let shelf = SHELF * self.size + 0.5 * near.distance.abs();
                return if across <= shelf { Ok(near) } else { Err(across - shelf) };
            }
            x = next;
            wanted = gradient.tr_mul(&facing).try_normalize(1e-9);
            reach = near;
        }
        Err(0.0)
    }

    /// The place of the surface that is nearest to a point (m, world axes), no farther than
    /// `within` (m), whichever way it looks. `kept` is a place that is near.
    ///
    /// Beside an edge or a corner, where the surface is not smooth, the normal leads to the point.
    pub(crate) fn nearest(&self, point: &Vector3<f64>, within: f64, kept: Option<&Place>) -> Option<Near> {
        self.nearest_of(point, &Side::All, within, kept)
    }

    /// As [`Shape::nearest`], on one side of a groove, whose normal is in world axes.
    pub(crate) fn nearest_of(
        &self,
        point: &Vector3<f64>,
        side: &Side,
        within: f64,
        kept: Option<&Place>,
    ) -> Option<Near> {
        // The normal in the axes of the rest shape.
        let rest = |gradient: &Matrix3<f64>| {
            let turned = |normal: &Vector3<f64>| {
                let normal = self.turn().tr_mul(normal);
                gradient.tr_mul(&normal).try_normalize(1e-9).unwrap_or(normal)
            };
            match side {
                Side::All => Side::All,
                Side::Along(normal) => Side::Along(turned(normal)),
                Side::Beside(normal) => Side::Beside(turned(normal)),
            }
        };
        let fits = |near: &Near| match side {
            Side::All => true,
            Side::Along(normal) => near.normal.dot(normal) >= ALONG && near.distance > 0.0,
            Side::Beside(normal) => near.normal.dot(normal) < ALONG && near.distance > 0.0,
        };
        let local = self.frame.to_local(point);
        let still = 1e-6 * self.size;
        let pulled = |place: &Place| {
            let (moved, gradient) = self.deformed(place);
            let rest = self.field.rest(place);
            Some((rest + gradient.try_inverse()? * (local - rest - moved), moved, gradient))
        };
        let mut hint = kept.filter(|kept| self.field.has(kept)).copied();
        let (mut x, mut reach, mut wanted) = (local, within + self.bound, rest(&Matrix3::identity()));
        if let Some(kept) = &hint {
            let (next, _, gradient) = pulled(kept)?;
            (x, reach, wanted) = (next, 2.0 * within + 0.01 * self.size, rest(&gradient));
        }
        for round in 0..ROUNDS {
            let place = self.field.closest_of(&x, &wanted, reach, hint.as_ref())?;
            hint = Some(place);
            let (next, moved, gradient) = pulled(&place)?;
            if (next - x).norm() <= still || round + 1 == ROUNDS {
                let near = self.near(&place, &moved, &gradient, point);
                let near = self.beyond(near, point);
                return (near.distance.abs() <= within && fits(&near)).then_some(near);
            }
            (x, wanted) = (next, rest(&gradient));
            reach = 2.0 * within + 0.01 * self.size;
        }
        None
    }

    /// Whether a point (m, world axes) is inside, or no farther from the surface than `within` (m).
    pub(crate) fn is_near(&self, point: &Vector3<f64>, within: f64) -> bool {
        let x = self.pull_back(point);
        let Some(place) = self.field.closest(&x, None, f64::MAX.sqrt(), None) else { return false };
        let near = self.at(&place, point);
        near.distance <= 0.0 || (point - near.at).norm() <= within
    }

    /// Follows the way of a ball's center (m, body axes at rest) until the ball touches the
    /// surface, and returns that place.
    pub(crate) fn sweep(&self, from: &Vector3<f64>, to: &Vector3<f64>, radius: f64) -> Option<Place> {
        const STEPS: usize = 64;
        let way = to - from;
        let length = way.norm();
        if length <= 0.0 || !length.is_finite() {
            return None;
        }
        let mut gone = 0.0;
        for _ in 0..STEPS {
            let x = from + way * (gone / length);
            let place = self.field.closest(&x, None, length - gone + radius, None)?;
            let (_, normal, _) = self.field.normals(&place);
            let off = x - self.field.rest(&place);
            let away = off.norm() - radius;
            if away <= 1e-3 * length {
                return (off.dot(&way) < 0.0 || normal.dot(&way) < 0.0).then_some(place);
            }
            if normal.dot(&off) <= 0.0 && gone <= 0.0 {
                // It begins deep inside.
                return None;
            }
            gone += away;
            if gone >= length {
                return None;
            }
        }
        None
    }

    /// A point (m, world axes) pulled back to the rest shape, m, body axes.
    pub(crate) fn pull_back(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let local = self.frame.to_local(point);
        let mut x = local;
        for _ in 0..2 {
            let Some(place) = self.field.closest(&x, None, f64::MAX.sqrt(), None) else { return local };
            let (moved, gradient) = self.deformed(&place);
            let rest = self.field.rest(&place);
            let Some(inverse) = gradient.try_inverse() else { return local };
            x = rest + inverse * (local - rest - moved);
        }
        x
    }

    /// Follows a way of the rest shape (m, body axes) from outside until it goes in, and returns
    /// that place. `facing` is in body axes at rest.
    pub(crate) fn march(
        &self,
        from: &Vector3<f64>,
        to: &Vector3<f64>,
        facing: &Vector3<f64>,
    ) -> Option<Place> {
        const STEPS: usize = 32;
        let way = to - from;
        let length = way.norm();
        if length <= 0.0 || !length.is_finite() {
            return None;
        }
        let mut gone = 0.0;
        for _ in 0..STEPS {
            let x = from + way * (gone / length);
            let place = self.field.closest(&x, Some(facing), length - gone, None)?;
            let (_, normal, _) = self.field.normals(&place);
            let off = x - self.field.rest(&place);
            let distance = off.norm();
            if distance <= 1e-3 * length {
                return (normal.dot(&way) < 0.0).then_some(place);
            }
            // It begins inside, or has come in through a face that looks elsewhere.
            if normal.dot(&off) <= 0.0 {
                return None;
            }
            gone += distance;
            if gone >= length {
                return None;
            }
        }
        None
    }
}
