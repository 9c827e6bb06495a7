//! Where bodies touch: the contacts that go on, the new ones, and their gaps after a step.

use nalgebra::{Matrix3, Vector3};

use super::{
    group::{Group, Member, View},
    touch::{Located, look},
};
use crate::{
    StepError,
    contact::{
        Carriers, ContactSites, Far, Guess, Near, ObstacleShape, Place, Shape, Site, SurfacePoint, Touched,
        Touching,
    },
    step::{Frame, State, Tangent},
};

mod attached;
mod begin;
mod detect;
mod drill;
mod pass;
mod probes;
mod rigid;

pub(super) use attached::{begin_attached, rub};
pub(super) use begin::begin;
pub(super) use detect::detect;
pub(super) use drill::drill;
use pass::march;
pub(super) use probes::{begin_probes, detect_probes, fill_probe_rows, keep_at_probe, pull_on_probe};
pub(super) use rigid::{begin_supports, fill_rows, respond, set_arms, support, take_supports, write_forces};

/// Share of a penetration that a step takes back, and the fastest way back, body sizes per second.
const RECOVERED: f64 = 0.2;
pub(super) const RECOVERY_SPEED: f64 = 0.5;

/// Depth below the surface of another body down to which sites are pushed out, as a share of the
/// size of the smaller body.
const DEEP: f64 = 0.1;

/// Largest radius of a contact that is at one place when a ball begins to touch, as a share of the
/// ball's radius. Softer or faster balls touch with all of their sites, until they touch no more.
const NARROW: f64 = 0.35;

/// Distance of two directions from the center of a ball below which they are those of one contact.
/// A contact of the widest circle has sites that are deep up to half of the radius beside its
/// place.
const NEAR: f64 = 0.6;

fn carried(obstacle: &dyn ObstacleShape, point: &Vector3<f64>, h: f64) -> Result<Vector3<f64>, StepError> {
    let velocity = obstacle.velocity(point);
    crate::error::finite("velocity of an obstacle", velocity.as_slice())?;
    Ok(h * velocity)
}

/// The smallest gap that is allowed at the end of a step that begins with `gap`.
fn floor(gap: f64, most: f64, recovers: bool) -> f64 {
    if gap >= 0.0 {
        0.0
    } else if recovers {
        gap + (RECOVERED * -gap).min(most)
    } else {
        gap
    }
}

/// The share of a step's way after which a gap that ends at `distance` closes.
fn share(gap: f64, distance: f64) -> f64 {
    if gap <= 0.0 {
        0.0
    } else if distance < 0.0 {
        gap / (gap - distance)
    } else {
        1.0
    }
}

/// The member with this key.
fn find<P: Member>(group: &Group<'_, P>, key: u64) -> Option<usize> {
    (0..group.who.len()).find(|&member| group.view(member).contacts.key == key)
}

/// Friction between two members.
fn friction(a: &View<'_>, b: &View<'_>) -> f64 {
    (a.contacts.friction() * b.contacts.friction()).sqrt()
}

/// Friction of a body or a probe at an obstacle.
fn friction_at(own: f64, obstacle: &dyn ObstacleShape) -> f64 {
    let other = obstacle.friction().filter(|other| *other >= 0.0 && other.is_finite());
    other.map_or(own, |other| (own * other).sqrt())
}

/// Compliance of a place of another body, m/N, world axes.
fn far_compliance(view: &View<'_>, sites: &ContactSites, state: &State, far: &Far) -> Matrix3<f64> {
    carrier_compliance(view, sites, (&state.frame, &state.q), &far.carriers)
}

/// Compliance of a place of a body at a frame and coordinates, m/N, world axes.
fn carrier_compliance(
    view: &View<'_>,
    sites: &ContactSites,
    (frame, q): (&Frame, &[f64]),
    carriers: &Carriers,
) -> Matrix3<f64> {
    let site = carriers.largest().and_then(|site| sites.sites.get(site));
    site.map_or_else(Matrix3::zeros, |site| view.kernel.site_compliance(site, frame, q))
}

/// The side at another body as it is before a first look at the end of the step.
fn far_side(member: usize, near: &Near, shape: &Shape<'_>) -> Far {
    let carriers = shape.field.carriers(&near.place);
    let (start, tangent) = shape.material(&near.place, &carriers);
    let zero = Vector3::zeros();
    Far {
        member,
        place: near.place,
        passed: false,
        carriers,
        start,
        end: start,
        tangent,
        mean: None,
        middle: start,
        arm: zero,
        compliance: Matrix3::zeros(),
        anchor: start,
    }
}

/// A site at a state, and the place of another body that it may touch.
fn locate_at_body(
    (own, index, site): (&Shape<'_>, usize, &Site),
    shape: &Shape<'_>,
    within: f64,
    kept: Option<&Place>,
    guess: Guess,
) -> Result<(Located, Near), f64> {
    let (frame, facing) = (own.frame, own.facing(index));
    // The center of the sphere of a round site, or its vertex.
    let center = site.center + own.moved(index);
    let (middle, mut toward) = (frame.to_world(center), Vector3::zeros());
    let mut point = middle + frame.rotation() * (site.radius * site.outward);
    let mut near = shape.look(&point, &facing, within, kept, guess)?;
    if site.radius > 0.0 {
        toward = site.toward(&-(frame.rotation().inverse() * near.normal));
        point = middle + frame.rotation() * (site.radius * toward);
        near = shape.look(&point, &facing, within, kept, Guess::Place(near.place))?;
    }
    let found = SurfacePoint { distance: near.distance, normal: near.normal };
    let (_, tangent) = own.site(index, &site.outward);
    Ok((Located { tangent, toward, wanted: Vector3::zeros(), center, point, found }, near))
}

/// Takes the gaps of all points at the end of the computed step. Where forces act over the step is
/// taken from there too, once and for all rounds, if `settles`, and from its beginning otherwise.
pub(super) fn linearize<P: Member>(
    group: &Group<'_, P>,
    work: &mut Touching,
    recovers: bool,
    settles: bool,
) -> Result<(), StepError> {
    for point in &mut work.points {
        if point.probe.is_some() {
            probes::linearize_at_probe(group, point, recovers)?;
            continue;
        }
        if let Some(at) = point.attached {
            attached::linearize_attached(group, point, at, recovers, settles);
            continue;
        }
        if let Some(at) = point.support {
            rigid::linearize_support(group, point, at);
            continue;
        }
        let view = group.view(point.member);
        let Some(sites) = view.sites() else { continue };
        let Some(site) = sites.sites.get(point.site) else { continue };
        let (kernel, state) = (view.kernel, view.state);
        let mut size = kernel.model.size();
        let own = kernel.site_compliance(site, &state.frame, &state.q);
        let (located, distance) = match (point.other, &mut point.far) {
            (Touched::Obstacle(index), _) => {
                let Some(obstacle) = view.contacts.obstacles().get(index) else { continue };
                let obstacle = rigid::pushed(group, &**obstacle);
                let leads = point.indent.as_ref().map(|indent| &indent.carriers);
                let at = (sites, site);
                let located = kernel.locate(at, &obstacle, &state.frame, &state.q, leads)?;
                let (mut distance, mut normal) = (located.found.distance, located.found.normal);
                if point.passed {
                    // The site passed through: it is as far behind the place where it went in as it
                    // went on.
                    normal = point.axes.row(0).transpose();
                    let way = located.point - point.start;
                    let begin = look(&obstacle, &point.start)?;
                    let through = march(&obstacle, &point.start, &way, begin)?;
                    distance = through.map_or(distance, |found| found.distance);
                }
                point.compliance = own;
                point.turn(&normal);
                if let Some(far) = &mut point.rigid {
                    point.carried = far.carried + obstacle.displacement(&located.point);
                    point.anchor = far.anchor + point.carried;
                    if point.mean.is_none() {
                        let end = if settles { located.point } else { point.start };
                        far.middle = 0.5 * (point.start + end);
                    }
                } else if point.mean.is_none() {
                    point.arm = if settles {
                        located.point - Vector3::from(state.frame.center())
                    } else {
                        point.start - Vector3::from(kernel.before.frame.center())
                    };
                }
                (located, distance)
            }
            (Touched::Body(_), Some(far)) => {
                let other = group.view(far.member);
                let Some(sites) = other.sites() else { continue };
                size = size.min(other.kernel.model.size());
                let (Some([_, at]), Some(shapes)) = (group.shapes(point.member), group.shapes(far.member))
                else {
                    continue;
                };
                let (located, near) = follow((&at, point.site, site), &shapes, far, size, settles);
                far.compliance = far_compliance(&other, sites, other.state, far);
                if point.mean.is_none() {
                    // The middle of the step, as that of both centers of mass.
                    far.middle = if settles {
                        0.25 * (point.start + located.point + far.start + far.end)
                    } else {
                        0.5 * (point.start + far.start)
                    };
                }
                point.carried = far.end - far.start;
                point.anchor = far.anchor + point.carried;
                point.compliance = own + far.compliance;
                point.turn(&near.normal);
                (located, near.distance)
            }
            (Touched::Body(_), None) | (Touched::Probe(_) | Touched::Attachment(_), _) => continue,
        };
        point.floor = floor(point.gap, RECOVERY_SPEED * size * group.h, recovers);
        point.last = located.toward;
        point.place = located.point;
        point.end = state.frame.to_world(located.center + site.radius * point.first);
        let offset = point.axes * (point.end - point.anchor);
        let shift = point.indent.map_or(0.0, |indent| indent.shift);
        point.off = Vector3::new(distance - point.floor + shift, offset[1], offset[2]);
        point.linearize(point.pushed[0]);
        // The middle of the step gives the work of a force on a shape that bends. With the mean and
        // the arm of every round the rounds of a soft or heavily loaded body would not converge.
        let start = point.tangent;
        if settles {
            point.mean.get_or_insert_with(|| 0.5 * (start + located.tangent));
        }
    }
    Ok(())
}

/// Finds a site of a contact with another body, and the place that it touches, after a step.
fn follow(
    (own, index, site): (&Shape<'_>, usize, &Site),
    [start, end]: &[Shape<'_>; 2],
    far: &mut Far,
    size: f64,
    settles: bool,
) -> (Located, Near) {
    let look = || locate_at_body((own, index, site), end, DEEP * size, Some(&far.place), Guess::None);
    let (located, near) = (!far.passed).then(look).and_then(Result::ok).unwrap_or_else(|| {
        let (mut point, tangent) = own.site(index, &site.outward);
        let turn = own.frame.rotation();
        let middle = point - turn * (site.radius * site.outward);
        let mut near = end.at(&far.place, &point);
        let mut toward = Vector3::zeros();
        if site.radius > 0.0 {
            toward = site.toward(&-(turn.inverse() * near.normal));
            point = middle + turn * (site.radius * toward);
            near = end.at(&far.place, &point);
        }
        if !far.passed {
            // The site has left the faces of the other body.
            near.distance = size;
        }
        let found = SurfacePoint { distance: near.distance, normal: near.normal };
        let center = own.frame.to_local(&middle);
        (Located { tangent, toward, wanted: Vector3::zeros(), center, point, found }, near)
    });
    far.place = near.place;
    if far.mean.is_none() {
        far.carriers = end.field.carriers(&near.place);
    }
    let carriers = end.field.carriers(&near.place);
    let ((begun, _), (ended, _)) =
        (start.material(&near.place, &carriers), end.material(&near.place, &carriers));
    (far.start, far.end) = (begun, ended);
    if far.mean.is_none() && settles {
        let [(_, from), (_, to)] = [start, end].map(|shape| shape.material(&near.place, &far.carriers));
        let mean: Tangent = 0.5 * (from + to);
        far.mean = Some(mean);
    }
    (located, near)
}
