//! The sites that touch at the end of a step and have no contact yet.

use nalgebra::{Matrix3, Vector3};

use super::super::{
    group::{Group, Member, View},
    touch::{Located, look},
};
use super::pass::{PARTS, march, pass};
use super::{
    DEEP, NARROW, NEAR, carried, far_compliance, far_side, friction, friction_at, locate_at_body, rigid,
    share,
};
use crate::{
    StepError,
    contact::{Clearance, ContactPoint, ContactSites, Guess, Look, ObstacleShape, Touched, Touching},
    step::Frame,
};

/// Distance of a site to those of the other body below which it is not needed, as a share of the
/// distance between sites.
const COVERED: f64 = 0.75;

/// Share of the depth [`DEEP`] up to which a place is searched for a point that is outside.
const SHALLOW: f64 = 0.25;

/// Difference of two distances that count as the same, as a share of the depth [`DEEP`].
const SAME: f64 = 1e-3;

/// The way from the axes of one body to those of another.
struct Relative {
    turn: Matrix3<f64>,
    offset: Vector3<f64>,
}

impl Relative {
    fn of(own: &Frame, other: &Frame) -> Self {
        let turn = other.rotation().inverse() * own.rotation();
        let offset = other.to_local(&own.to_world(Vector3::zeros()));
        Self { turn: *turn.to_rotation_matrix().matrix(), offset }
    }

    fn at(&self, local: &Vector3<f64>) -> Vector3<f64> {
        self.turn * local + self.offset
    }
}

/// Adds points for the sites that touch at the end of the step. Returns whether it found any that
/// penetrate, and the number of sites that were looked at.
pub(in super::super) fn detect<P: Member>(
    group: &mut Group<'_, P>,
    work: &mut Touching,
    band: f64,
) -> Result<(bool, usize), StepError> {
    let (mut penetrates, mut candidates) = (false, 0);
    list_looks(group, work, band);
    for member in 0..group.who.len() {
        let view = group.view(member);
        let Some(sites) = view.sites() else { continue };
        let travel = travel(&view, sites);
        for index in 0..view.contacts.obstacles().len() {
            detect_at_obstacle(
                group,
                (member, &view, sites, travel),
                index,
                work,
                band,
                (&mut penetrates, &mut candidates),
            )?;
        }
    }
    work.heads.clear();
    work.heads.extend(work.points.iter().map(head));
    let looks = std::mem::take(&mut work.looks);
    for look in &looks {
        penetrates |= detect_at_body(group, look, work, band, &mut candidates);
    }
    work.looks = looks;
    Ok((penetrates, candidates))
}

/// Lists the pairs of bodies that may have come near each other, and finds where the sites of these
/// bodies are.
fn list_looks<P: Member>(group: &mut Group<'_, P>, work: &mut Touching, band: f64) {
    work.looks.clear();
    for member in 0..group.who.len() {
        if group.pairs.iter().flatten().any(|&paired| paired as usize == member) {
            group.follow_sites(member);
        }
    }
    for pair in group.pairs {
        let [a, b] = pair.map(|member| member as usize);
        // The body with the denser sites comes first, and the other adds what is missing.
        let spacing = |member| group.view(member).sites().map_or(f64::INFINITY, |sites| sites.spacing);
        let order = if spacing(b) < spacing(a) { [[b, a], [a, b]] } else { [[a, b], [b, a]] };
        for members in order {
            let [view, far] = members.map(|member| group.view(member));
            let (Some(sites), Some(far_sites)) = (view.sites(), far.sites()) else { continue };
            let [bound, far_bound] = [sites.bound(&view.state.q), far_sites.bound(&far.state.q)];
            let ways = [travel(&view, sites)[0], travel(&far, far_sites)[0]];
            let reach = bound + far_bound + band + ways[0] + ways[1];
            let [from, to] = [&view, &far].map(|view| Vector3::from(view.state.frame.center()));
            // Comparisons with no number are false, and such bodies do not touch.
            let near = (from - to).norm() <= sites.radius + far_sites.radius + reach;
            if !near {
                continue;
            }
            let clear = work.clearance([view.contacts.key, far.contacts.key]);
            if !spend_clearance(&mut work.clear[clear], [&view, &far], sites, bound, band) {
                continue;
            }
            work.looks.push(Look { members });
            let frames = [&view, &far].map(|view| [&view.kernel.before.frame, &view.state.frame]);
            let way = relative_travel(frames[0], frames[1], sites.radius + bound)
                + sites.travel_bound(&view.kernel.before.q, &view.state.q)
                + far_sites.travel_bound(&far.kernel.before.q, &far.state.q);
            let size = view.kernel.model.size().min(far.kernel.model.size());
            if band > 0.0 && way > DEEP * size {
                members.into_iter().for_each(|member| group.place_start(member));
            }
        }
    }
}

/// Bound on the way of every site in the step, m, and on the displacements at its end.
fn travel(view: &View<'_>, sites: &ContactSites) -> [f64; 2] {
    let (before, now) = (&view.kernel.before, view.state);
    let (from, to) = (&before.frame, &now.frame);
    let turned = (from.rotation().inverse() * to.rotation()).angle();
    let (bound, start) = (sites.bound(&now.q), sites.bound(&before.q));
    let swing = 2.0 * (0.5 * turned.min(std::f64::consts::PI)).sin() * (sites.radius + bound.max(start));
    let bent = sites.travel_bound(&before.q, &now.q);
    let way = (Vector3::from(to.center()) - Vector3::from(from.center())).norm();
    [way + swing + bent, bound]
}

/// Site and bodies of a point.
fn head(point: &ContactPoint) -> [usize; 3] {
    [point.site, point.member, point.far.map_or(usize::MAX, |far| far.member)]
}

/// Marks the sites of a member that have a point with something.
fn mark(work: &mut Touching, member: usize, other: Touched) -> u32 {
    work.stamp = work.stamp.wrapping_add(1);
    for point in work.points.iter().filter(|point| point.member == member && point.other == other) {
        if let Some(mark) = work.marks.get_mut(point.site) {
            *mark = work.stamp;
        }
    }
    work.stamp
}

fn detect_at_obstacle<P: Member>(
    group: &Group<'_, P>,
    (member, view, sites, [travel, bound]): (usize, &View<'_>, &ContactSites, [f64; 2]),
    index: usize,
    work: &mut Touching,
    band: f64,
    (penetrates, candidates): (&mut bool, &mut usize),
) -> Result<(), StepError> {
    let Some(obstacle) = view.contacts.obstacles().get(index).map(|obstacle| &**obstacle) else {
        return Ok(());
    };
    // Where forces have moved it, and where it would be without them.
    let (pushed, free) = (rigid::pushed(group, obstacle), obstacle);
    let obstacle: &dyn ObstacleShape = &pushed;
    let kernel = view.kernel;
    let (before, state) = (&kernel.before, view.state);
    let (from, to) = (&before.frame, &state.frame);
    if look(obstacle, &Vector3::from(to.center()))?.distance > sites.radius + bound + band + travel {
        return Ok(());
    }
    let other = Touched::Obstacle(index);
    let stamp = mark(work, member, other);
    let cloud = view.contacts.cloud(&state.q);
    let mut directions = Directions::default();
    for (number, site) in sites.sites.iter().enumerate() {
        if work.marks[number] == stamp {
            continue;
        }
        let (at, slack) = match cloud {
            Some((cloud, slack)) => (cloud.sites[number], slack),
            None => (site.rest(&site.outward) + site.patch.displacement(&state.q, kernel.warps()), 0.0),
        };
        // The contact point of a round site is not farther from it than this.
        let rough = look(obstacle, &to.to_world(at))?.distance - site.slides - slack;
        if rough > band + travel {
            continue;
        }
        if rough > band {
            // To pass through, it must go to the obstacle and away from it again.
            let begun =
                from.to_world(site.rest(&site.outward) + site.patch.displacement(&before.q, kernel.warps()));
            let way = (to.to_world(at) - begun).norm() + 2.0 * site.slides + slack;
            let begun = look(obstacle, &begun)?.distance - site.slides;
            if begun > 0.0 && way < begun + rough {
                continue;
            }
        }
        *candidates += 1;
        let mut located = kernel.locate((sites, site), obstacle, to, &state.q, None)?;
        let mut leads = None;
        if let Some(ball) = &site.ball {
            let wanted = directions.of(ball.number, located.wanted);
            let [reached, nearest] = sites.leads(ball, &wanted, number);
            if reached {
                match known(work, (member, other), sites, ball.number, &wanted) {
                    // The ball touches here already.
                    Some(true) => continue,
                    Some(false) => {}
                    None if is_narrow(view, sites, ball.number, site.radius, free, &located) => {
                        if !nearest {
                            continue;
                        }
                        let carriers = sites.carriers(ball, &wanted, number);
                        let at = (sites, site);
                        let led = kernel.locate(at, obstacle, to, &state.q, Some(&carriers))?;
                        if led.found.distance < band {
                            (located, leads) = (led, Some(carriers));
                        }
                    }
                    None => {}
                }
            }
        }
        let (start, tangent) =
            kernel.material((sites, site), &located.toward, from, &before.q, leads.as_ref());
        let moved = located.point - start;
        let mut found = located.found;
        let mut hit = false;
        if found.distance >= band {
            // A site that moves far may have passed through the obstacle.
            let begin = look(obstacle, &start)?;
            if begin.distance >= moved.norm() || begin.distance <= 0.0 {
                continue;
            }
            let Some(passed) = march(obstacle, &start, &moved, begin)? else { continue };
            found = passed;
            hit = true;
        }
        let friction = friction_at(view.contacts.friction(), free);
        let mut point = ContactPoint::new(member, number, other, friction);
        (point.first, point.last, point.start) = (located.toward, located.toward, start);
        point.tangent = tangent;
        let by_itself = carried(free, &located.point, kernel.h)?;
        point.gap = look(free, &(start + by_itself))?.distance;
        point.carried = by_itself + pushed.displacement(&located.point);
        let way = located.point - start - point.carried;
        point.anchor = start + point.carried + share(point.gap, found.distance) * way;
        point.rigid = rigid::side(group, free, &point, by_itself);
        point.indent = leads.and_then(|carriers| kernel.indent((sites, number), carriers, free));
        if hit {
            // The plane at the place where the site went in.
            point.turn(&found.normal);
            point.passed = true;
        }
        *penetrates |= found.distance < 0.0 || hit;
        work.points.push(point);
    }
    Ok(())
}

/// Directions from the centers of balls to an obstacle, body axes. All sites of a ball must agree
/// on which of them leads, and each has its own displacement.
#[derive(Default)]
struct Directions {
    list: [(usize, Vector3<f64>); 8],
    count: usize,
}

impl Directions {
    /// The direction in which a site of the ball was found first, if it is near this one.
    fn of(&mut self, ball: usize, wanted: Vector3<f64>) -> Vector3<f64> {
        let near = |(of, known): &&(usize, Vector3<f64>)| *of == ball && (known - wanted).norm() < NEAR;
        if let Some((_, known)) = self.list[..self.count].iter().find(near) {
            return *known;
        }
        if let Some(entry) = self.list.get_mut(self.count) {
            *entry = (ball, wanted);
            self.count += 1;
        }
        wanted
    }
}

/// How a ball touches an obstacle already near the direction `wanted` from its center (body axes):
/// at one place, with its sites, or not at all.
fn known(
    work: &Touching,
    (member, other): (usize, Touched),
    sites: &ContactSites,
    ball: usize,
    wanted: &Vector3<f64>,
) -> Option<bool> {
    let same = |point: &&ContactPoint| {
        let is_of = || {
            let of = sites.sites.get(point.site).and_then(|site| site.ball);
            of.is_some_and(|of| of.leads && of.number == ball)
        };
        point.member == member && point.other == other && (point.last - wanted).norm() < NEAR && is_of()
    };
    work.points.iter().filter(same).map(|point| point.indent.is_some()).reduce(|a, b| a || b)
}

/// Whether a ball that begins to touch will touch at one place: under the weight of the body, and
/// by its speed (K. L. Johnson, *Contact Mechanics*, 1985, 11.4) with all of its mass behind it.
fn is_narrow(
    view: &View<'_>,
    sites: &ContactSites,
    ball: usize,
    radius: f64,
    obstacle: &dyn ObstacleShape,
    located: &Located,
) -> bool {
    let (kernel, model) = (view.kernel, &view.kernel.model);
    if !model.is_free() {
        return false;
    }
    let normal = &located.found.normal;
    let theirs = obstacle.velocity(&located.point);
    let frame = &kernel.before.frame;
    let arm = located.point - Vector3::from(frame.center());
    let own = Vector3::from(frame.velocity()) + frame.angular_velocity(model).cross(&arm);
    let speed = normal.dot(&(own - theirs));
    let speed = if speed < 0.0 { speed } else { 0.0 };
    let weight = model.mass() * Vector3::from(kernel.settings.gravity).norm();
    let plain = kernel.settings.stiffness_scale / (std::f64::consts::PI * sites.balls[ball].slope[0]);
    let resting = (0.75 * weight * radius / plain).cbrt();
    let depth = (15.0 * model.mass() * speed * speed / (16.0 * radius.sqrt() * plain)).powf(0.4);
    resting < NARROW * radius && (radius * depth).sqrt() < NARROW * radius
}

fn detect_at_body<P: Member>(
    group: &Group<'_, P>,
    look: &Look,
    work: &mut Touching,
    band: f64,
    candidates: &mut usize,
) -> bool {
    let [member, other] = look.members;
    let [view, far] = look.members.map(|member| group.view(member));
    let [Some([own_start, own]), Some([start, end])] = &look.members.map(|member| group.shapes(member))
    else {
        return false;
    };
    let (sites, far_sites) = (own.sites, end.sites);
    let clear = work.clearance([view.contacts.key, far.contacts.key]);
    let touched = Touched::Body(far.contacts.key);
    work.stamp = work.stamp.wrapping_add(1);
    let stamp = work.stamp;
    work.covered.clear();
    for (index, &[site, of, at]) in work.heads.iter().enumerate() {
        if [of, at] == [member, other] {
            work.marks[site] = stamp;
        } else if [of, at] == [other, member] && work.points[index].pushed[0] > 0.0 {
            work.covered.push(work.points[index].place);
        }
    }
    let distant = COVERED * sites.spacing.max(far_sites.spacing);
    let deep = DEEP * view.kernel.model.size().min(far.kernel.model.size());
    let (was, now) = (Relative::of(own_start.frame, start.frame), Relative::of(own.frame, end.frame));
    let within = deep.max(band);
    // A site that moves far may have passed through the other body. Where that one bends far, its
    // own sites do. Forces only make ways shorter.
    let clouds = own.cloud.zip(end.cloud);
    // Without where the sites were, no site moves far.
    let bent = match (own_start.cloud, start.cloud, clouds) {
        (Some((own, _)), Some((far, _)), Some(((own_end, a), (far_end, b)))) if band > 0.0 => {
            Some(own_end.way(own) + far_end.way(far) + 2.0 * (a + b))
        }
        _ => None,
    };
    // How far a ball around sites is at least from the other body, and whether it passes it.
    let away = |center: &Vector3<f64>, radius: f64| {
        let (came, local) = (was.at(center), now.at(center));
        let way = (local - came).norm() + 2.0 * radius;
        let Some(((_, slack), (far, far_slack))) = clouds else {
            return (f64::NEG_INFINITY, false, Guess::None);
        };
        let (away, leaf) = end.field.away(far, &local);
        let ball = radius + slack + far_slack;
        // Balls around all places of the way.
        let fast = bent.filter(|_| way > within).is_some_and(|bent| {
            let reach = 0.5 / f64::from(PARTS) * (local - came).norm() + ball + bent;
            let mut parts = (0..PARTS).map(|k| (f64::from(k) + 0.5) / f64::from(PARTS));
            parts.any(|share| end.field.away(far, &came.lerp(&local, share)).0 <= reach)
        });
        let site = (radius == 0.0).then(|| end.field.nearest_site(far, leaf, &local)).flatten();
        (away - ball, fast, site.map_or(Guess::None, Guess::Site))
    };
    let mut penetrates = false;
    let clusters = own.field.clusters();
    let mut stack = [0; 64];
    let mut depth = usize::from(!clusters.is_empty());
    while depth > 0 {
        depth -= 1;
        let node = stack[depth];
        let cluster = &clusters[node];
        let numbers = own.field.sites_of(cluster);
        // Nearly all sites end here.
        let open = |number: &u32| {
            let number = *number as usize;
            let is_far = work.clear[clear].sites[number] > band;
            work.marks[number] != stamp && !is_far
        };
        if !numbers.iter().any(open) {
            continue;
        }
        if let Some(((cloud, _), _)) = clouds {
            let [low, high]: [Vector3<f64>; 2] = cloud.boxes[node];
            let (middle, radius) = (0.5 * (low + high), 0.5 * (high - low).norm());
            let (away, fast, _) = away(&middle, radius);
            if away > band && !fast {
                for &number in numbers {
                    let clear = &mut work.clear[clear].sites[number as usize];
                    *clear = clear.max(away);
                }
                continue;
            }
        }
        if let Some(second) = cluster.second {
            for child in [second, node + 1] {
                if depth < stack.len() {
                    stack[depth] = child;
                    depth += 1;
                }
            }
            continue;
        }
        for number in numbers.iter().map(|&number| number as usize) {
            if work.marks[number] == stamp || work.clear[clear].sites[number] > band {
                continue;
            }
            let site = &sites.sites[number];
            let at = match clouds {
                Some(((cloud, _), _)) => cloud.sites[number],
                None => site.rest(&site.outward) + own.moved(number),
            };
            let world = own.frame.to_world(at);
            if work.covered.iter().any(|place| (place - world).norm() < distant) {
                continue;
            }
            let (distance, fast, guess) = away(&at, 0.0);
            if distance > band && !fast {
                work.clear[clear].sites[number] = distance;
                continue;
            }
            *candidates += 1;
            let found = if distance > band {
                Err(distance)
            } else {
                // A point that is well outside needs no search for deep places.
                let outside = match guess {
                    Guess::Site(near) => {
                        let way = now.at(&at)
                            - (far_sites.sites[near].rest(&far_sites.sites[near].outward) + end.moved(near));
                        far_sites.sites[near].facing.dot(&way) > 0.5 * way.norm()
                    }
                    _ => false,
                };
                let within = if outside { SHALLOW * within } else { within };
                locate_at_body((own, number, site), end, within, None, guess)
            };
            let distance = found.as_ref().map_or_else(|away| *away, |(_, near)| near.distance);
            work.clear[clear].sites[number] = distance;
            let found = found.ok().filter(|(_, near)| near.distance < band);
            let passed = found.is_none() && fast;
            let shapes = [[own_start, own], [start, end]];
            let found = if passed { pass((number, site), shapes) } else { found };
            let Some((located, near)) = found else { continue };
            let near_other = |point: &ContactPoint| {
                point.member == other
                    && point.far.is_some_and(|far| far.member == member)
                    && (point.pushed[0] > 0.0 || point.off[0] <= near.distance.max(0.0) + SAME * deep)
                    && (point.place - located.point).norm() < distant
            };
            let heads = work.heads.iter().zip(&work.points);
            if heads.filter(|([_, of, _], _)| *of == other).any(|(_, point)| near_other(point)) {
                continue;
            }
            let toward = if site.radius > 0.0 { located.toward } else { site.outward };
            let (begun, tangent) = own_start.site(number, &toward);
            let mut point = ContactPoint::new(member, number, touched, friction(&view, &far));
            (point.first, point.last) = (located.toward, located.toward);
            (point.start, point.tangent, point.place) = (begun, tangent, located.point);
            let mut side = far_side(other, &near, start);
            side.passed = passed;
            side.compliance = far_compliance(&far, far_sites, &far.kernel.before, &side);
            let ended = end.material(&near.place, &side.carriers).0;
            point.gap = start.at(&near.place, &begun).distance;
            let moved = (located.point - begun) - (ended - side.start);
            side.anchor = begun + share(point.gap, near.distance) * moved;
            point.far = Some(side);
            // What later sites look at before the gaps are taken anew.
            point.off[0] = near.distance;
            penetrates |= near.distance < 0.0;
            work.heads.push(head(&point));
            work.points.push(point);
        }
    }
    penetrates
}

/// Bound on the travel of the points within a radius of the center of one frame relative to another
/// frame, m.
fn relative_travel(own: [&Frame; 2], other: [&Frame; 2], radius: f64) -> f64 {
    let [from, to] = [0, 1].map(|k| {
        let turn = other[k].rotation().inverse();
        (other[k].to_local(&Vector3::from(own[k].center())), turn * own[k].rotation())
    });
    let turned = from.1.angle_to(&to.1).min(std::f64::consts::PI);
    (to.0 - from.0).norm() + 2.0 * (0.5 * turned).sin() * radius
}

/// Takes the relative travel of two bodies since the last search from their clearances. Returns
/// whether any site may be nearer than `band`.
fn spend_clearance(
    clear: &mut Clearance,
    views: [&View<'_>; 2],
    sites: &ContactSites,
    bound: f64,
    band: f64,
) -> bool {
    let frames = views.map(|view| view.state.frame);
    let ways = views.map(|view| view.contacts.bent.way);
    let count = sites.sites.len();
    if clear.sites.len() == count {
        let [own, far] = &clear.frames;
        // The bound covers the shape before too, as the way of bending is counted apart.
        let turning = relative_travel([own, &frames[0]], [far, &frames[1]], sites.radius + bound);
        let way = turning + (ways[0] - clear.ways[0]) + (ways[1] - clear.ways[1]);
        // A way that is no number leaves no clearance.
        let way = if way.is_nan() { f64::INFINITY } else { way };
        clear.sites.iter_mut().for_each(|away| *away -= way);
    } else {
        clear.sites.clear();
        clear.sites.resize(count, f64::NEG_INFINITY);
    }
    (clear.frames, clear.ways) = (frames, ways);
    clear.sites.iter().any(|&away| away <= band)
}
