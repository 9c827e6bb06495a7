//! Bodies that touch each other.

use std::time::Duration;

use nalgebra::Vector3;

use crate::{
    AttachedTo, Body, Probe, Rigid, StepError, StepReport,
    contact::{Sixes, Touched, Touching},
    step::group::{self, Member, Others, Parts, View},
};

/// A body that is stepped with others.
#[derive(Debug)]
pub struct Together<'a> {
    /// The body.
    pub body: &'a mut Body,
    /// Name of the body, which no other has, and which stays from step to step:
    /// [`Touched::Body`](crate::Touched::Body) has it.
    pub key: u64,
    /// Whether the body rests. A resting body is not stepped unless a body that moves is near it,
    /// directly or through others. [`Islands::step`] then sets this to false.
    pub resting: bool,
    /// Whether the body may touch others, or probes. One that may not costs no search for what is
    /// near it. Default: true.
    pub touches: bool,
    /// Set by a step: number of the body's island. Bodies with the same number may touch, directly
    /// or through others, and may come to rest only together.
    pub island: usize,
    /// Set by a step: what it reports.
    pub report: StepReport,
    /// Set by a step that fails: why.
    pub error: Option<StepError>,
    /// Time that the step of a lone body has taken, if whoever calls [`Islands::step_by`] measures
    /// it there. Default: zero.
    pub took: Duration,
    /// Whether the body is stepped now, and near no other body or probe.
    lone: bool,
}

impl<'a> Together<'a> {
    /// A body that moves and may touch others.
    pub fn new(key: u64, body: &'a mut Body) -> Self {
        Self {
            body,
            key,
            resting: false,
            touches: true,
            island: 0,
            report: StepReport::default(),
            error: None,
            took: Duration::ZERO,
            lone: false,
        }
    }

    /// Whether the body was stepped alone: near no other body, no probe and no rigid body that
    /// gives way.
    pub fn is_lone(&self) -> bool {
        self.lone
    }
}

impl Together<'_> {
    fn begin_step(&mut self) {
        self.report = StepReport::default();
        self.body.contacts_mut().key = self.key;
        self.body.begin_step();
    }

    fn step_alone(&mut self) {
        match self.body.step_alone() {
            Ok(report) => self.report = report,
            Err(error) => self.error = Some(error),
        }
    }
}

/// A member of an island while it is stepped.
impl Member for Together<'_> {
    fn parts(&mut self) -> Parts<'_> {
        self.body.parts(&mut self.report)
    }

    fn view(&self) -> View<'_> {
        self.body.view()
    }
}

/// Share of a body's size within which bodies count as near.
const MARGIN: f64 = 0.01;

/// The same for a body that hands hold, which may move it faster than it moves by itself.
const HELD_MARGIN: f64 = 0.1;

/// A ball around a body over the whole step.
#[derive(Debug, Clone, Copy)]
struct Ball {
    index: usize,
    center: Vector3<f64>,
    velocity: Vector3<f64>,
    radius: f64,
    step: f64,
}

impl Ball {
    fn of(index: usize, body: &Body) -> Self {
        let (model, frame, step) = (body.model(), body.frame(), body.config().step);
        let center = Vector3::from(frame.center());
        let (radius, bent) = match &body.contacts().places {
            Some(sites) => (sites.radius, sites.bound(body.q()) + step * sites.bound(body.v())),
            None => {
                // Without sites the size of the rest shape has to do.
                let [low, high] = model.surface().bounds().map(|at| Vector3::from(at.map(f64::from)));
                let com = Vector3::from(model.center_of_mass());
                let radius = (com - low).sup(&(high - com)).norm();
                (radius, radius)
            }
        };
        let turning = step * frame.angular_velocity(model).norm().min(1.0 / step) * radius;
        let margin = if body.grabs().next().is_some() { HELD_MARGIN } else { MARGIN };
        let radius = radius + bent + turning + margin * model.size();
        Self { index, center, velocity: frame.velocity().into(), radius, step }
    }

    /// Lowest and highest x of the ball during the step, m.
    fn ends(&self) -> [f64; 2] {
        let way = self.step * self.velocity.x.abs();
        [self.center.x - self.radius - way, self.center.x + self.radius + way]
    }

    /// Comparisons with no number are false, and such bodies touch nothing.
    fn meets(&self, other: &Self) -> bool {
        let way = self.step * (self.velocity - other.velocity).norm();
        self.step == other.step && (self.center - other.center).norm() <= self.radius + other.radius + way
    }
}

/// Steps bodies that touch each other.
///
/// Bodies that are near each other form an island, which is solved as one: the forces between two
/// bodies are equal and opposite, and both respond within the step. A body that is near no other is
/// stepped as by [`Body::step`]. It holds no state of the bodies, only memory: a step allocates
/// nothing once it has seen as many contacts.
///
/// The order of the bodies decides the order of the sums. The same order gives the same result to
/// the bit.
///
/// Two bodies touch only if they have the same step length. The friction between them is the
/// geometric mean of both coefficients.
#[derive(Debug, Clone, Default)]
pub struct Islands {
    work: Touching,
    sixes: Vec<[Sixes; 2]>,
    balls: Vec<Ball>,
    /// Pairs of bodies that are near each other, by index.
    pairs: Vec<[u32; 2]>,
    /// The first body of each body's island, and all bodies by island.
    first: Vec<usize>,
    order: Vec<usize>,
    local: Vec<u32>,
    members: Vec<[u32; 2]>,
    moves: Vec<bool>,
    /// The probes of the present island.
    held: Vec<usize>,
    /// The rigid bodies of other engines that give way in the next steps. A step writes what the
    /// contacts did to them. Those with a number that is not finite do not give way.
    pub rigids: Vec<Rigid>,
    /// The rigid bodies of the present island.
    pushed: Vec<usize>,
}

impl Islands {
    /// Performs one step of all bodies that move. `may_touch` says whether two bodies may touch, by
    /// their indices.
    ///
    /// Where the step of an island fails, all of its bodies have the error as their
    /// [`Together::error`], and are stepped as if they did not touch each other.
    pub fn step(&mut self, bodies: &mut [Together<'_>], may_touch: impl Fn(usize, usize) -> bool) {
        self.step_with(bodies, &mut [], 0.0, may_touch, |_, _| false);
    }

    /// Performs one step of `h` seconds of all bodies that move, and of all probes. `may_probe`
    /// says whether a probe may touch a body, by their indices. A body of another step length than
    /// `h` is not touched by probes. A probe wakes the bodies that it may reach in the step.
    ///
    /// Where the step of an island fails, its probes are at their targets and touch nothing.
    pub fn step_with(
        &mut self,
        bodies: &mut [Together<'_>],
        probes: &mut [Probe],
        h: f64,
        may_touch: impl Fn(usize, usize) -> bool,
        may_probe: impl Fn(usize, usize) -> bool,
    ) {
        self.step_by(bodies, probes, h, may_touch, may_probe, |bodies, step| {
            bodies.iter_mut().for_each(step);
        });
    }

    /// As [`Islands::step_with`], where `each` calls its second argument for each body of its
    /// first, in any order and on any threads. The result is the same to the bit. The bodies that
    /// are near no other body are stepped in it.
    pub fn step_by<'a>(
        &mut self,
        bodies: &mut [Together<'a>],
        probes: &mut [Probe],
        h: f64,
        may_touch: impl Fn(usize, usize) -> bool,
        may_probe: impl Fn(usize, usize) -> bool,
        each: impl FnOnce(&mut [Together<'a>], fn(&mut Together<'a>)),
    ) {
        self.work.begin_step();
        self.find_pairs(bodies, &may_touch);
        self.find_probed(bodies, probes, h, &may_probe);
        self.find_pushed(bodies, h);
        self.find_islands(bodies, probes);
        self.wake(bodies, probes);
        self.find_lone(bodies, probes);
        each(bodies, |together| {
            if together.lone {
                together.begin_step();
                together.step_alone();
                together.body.end_step();
            }
        });
        for together in bodies.iter_mut().filter(|together| !together.resting && !together.lone) {
            together.begin_step();
        }
        let mut begin = 0;
        while begin < self.order.len() {
            let island = bodies[self.order[begin]].island;
            let count =
                self.order[begin..].iter().take_while(|&&index| bodies[index].island == island).count();
            self.step_island(bodies, begin, begin + count, (probes, h));
            begin += count;
        }
        for index in 0..probes.len() {
            if probes[index].near.is_empty() {
                let held = &[index][..];
                let others = Others { probes: &mut *probes, held, rigids: &mut [], pushed: &[], h };
                // The probe whose obstacle has failed is at its target.
                let _ = group::step(bodies, &[], &[], &mut [], others, &mut self.work);
            }
        }
        for together in bodies.iter_mut().filter(|together| !together.resting && !together.lone) {
            together.body.end_step();
        }
    }

    fn step_island(
        &mut self,
        bodies: &mut [Together<'_>],
        begin: usize,
        end: usize,
        (probes, h): (&mut [Probe], f64),
    ) {
        let who = &self.order[begin..end];
        if who.first().is_none_or(|&first| bodies[first].resting || bodies[first].lone) {
            return;
        }
        self.held.clear();
        let of_island =
            |probe: &Probe| probe.near.first().is_some_and(|&n| self.first[n] == self.first[who[0]]);
        self.held.extend((0..probes.len()).filter(|&index| of_island(&probes[index])));
        self.members.clear();
        if self.sixes.len() < who.len() {
            self.sixes.resize_with(who.len(), Default::default);
        }
        for pair in &self.pairs {
            let local = pair.map(|index| self.local[index as usize]);
            if self.first[pair[0] as usize] == self.first[who[0]] {
                self.members.push(local);
            }
        }
        let sixes = &mut self.sixes[..who.len()];
        let (root, bodies_count) = (self.first[who[0]], bodies.len());
        self.pushed.clear();
        self.pushed.extend((0..self.rigids.len()).filter(|&rigid| self.first[bodies_count + rigid] == root));
        let (held, rigids, pushed) = (&self.held[..], &mut self.rigids[..], &self.pushed[..]);
        let others = Others { probes, held, rigids, pushed, h };
        let Err(error) = group::step(bodies, who, &self.members, sixes, others, &mut self.work) else {
            return;
        };
        for &index in who {
            let together = &mut bodies[index];
            together.body.contacts_mut().forget();
            together.step_alone();
            together.error.get_or_insert_with(|| error.clone());
        }
    }

    fn find_pairs(&mut self, bodies: &[Together<'_>], may_touch: &impl Fn(usize, usize) -> bool) {
        self.pairs.clear();
        self.balls.clear();
        let touching = bodies.iter().enumerate().filter(|(_, together)| together.touches);
        self.balls.extend(touching.map(|(index, together)| Ball::of(index, together.body)));
        self.balls.retain(|ball| ball.ends().iter().all(|x| x.is_finite()));
        self.balls.sort_unstable_by(|a, b| a.ends()[0].total_cmp(&b.ends()[0]).then(a.index.cmp(&b.index)));
        for (number, a) in self.balls.iter().enumerate() {
            let [_, end] = a.ends();
            for b in self.balls[number + 1..].iter().take_while(|b| b.ends()[0] <= end) {
                let (i, j) = (a.index.min(b.index), a.index.max(b.index));
                if may_touch(i, j) && a.meets(b) {
                    self.pairs.push([i as u32, j as u32]);
                }
            }
        }
        self.pairs.sort_unstable();
    }

    /// Begins the step of all probes, and finds the bodies near each.
    fn find_probed(
        &mut self,
        bodies: &mut [Together<'_>],
        probes: &mut [Probe],
        h: f64,
        may_probe: &impl Fn(usize, usize) -> bool,
    ) {
        for (number, probe) in probes.iter_mut().enumerate() {
            let way = probe.begin_step(h);
            let mut near = std::mem::take(&mut probe.near);
            near.clear();
            for ball in self.balls.iter().filter(|ball| ball.step == h && may_probe(number, ball.index)) {
                let reach = way + probe.extent();
                let body = &mut *bodies[ball.index].body;
                let own =
                    ball.step * (ball.velocity.norm() + body.speed_bound()) + MARGIN * body.model().size();
                let touched = probe.memory.iter().any(|m| m.other == Touched::Body(bodies[ball.index].key));
                if (ball.center - probe.start).norm() <= ball.radius + own + reach
                    && (touched || bodies[ball.index].body.is_near(&probe.start, reach + own))
                {
                    near.push(ball.index);
                }
            }
            near.sort_unstable();
            probe.near = near;
        }
    }

    /// Finds the bodies that are attached to each rigid body that gives way, or near it. A resting
    /// one must touch it or be about to, so that what moves beside it does not wake it.
    fn find_pushed(&mut self, bodies: &[Together<'_>], h: f64) {
        for rigid in &mut self.rigids {
            rigid.begin();
            rigid.near.clear();
        }
        if self.rigids.is_empty() {
            return;
        }
        for (index, together) in bodies.iter().enumerate() {
            let body = &*together.body;
            for (_, to) in body.attachments() {
                let AttachedTo::Rigid { key, .. } = to else { continue };
                let rigid = self.rigids.iter_mut().find(|rigid| rigid.key == key && rigid.is_sound());
                if let Some(rigid) = rigid.filter(|rigid| !rigid.near.contains(&index))
                    && body.config().step == h
                {
                    rigid.near.push(index);
                }
            }
            let obstacles = body.contacts().obstacles().iter();
            let mut ball = None;
            let named = obstacles.enumerate();
            let named = named.filter_map(|(slot, obstacle)| Some((slot, obstacle, obstacle.rigid()?)));
            for (slot, obstacle, key) in named {
                let rigid = self.rigids.iter_mut().find(|rigid| rigid.key == key && rigid.is_sound());
                let Some(rigid) = rigid.filter(|_| body.config().step == h) else { continue };
                let ball = ball.get_or_insert_with(|| Ball::of(index, body));
                if !ball.ends().iter().all(|x| x.is_finite()) {
                    continue;
                }
                let way = h * (ball.velocity.norm() + obstacle.velocity(&ball.center).norm());
                if obstacle.at(&ball.center).distance <= ball.radius + way
                    && !rigid.near.contains(&index)
                    && (!together.resting || body.may_touch(slot, way + MARGIN * body.model().size()))
                {
                    rigid.near.push(index);
                }
            }
        }
    }

    /// Wakes the islands of which a member moves or is touched by a probe or a rigid body that
    /// moves.
    fn wake(&mut self, bodies: &mut [Together<'_>], probes: &[Probe]) {
        // The entry of each island's first body says whether one moves.
        self.moves.clear();
        self.moves.resize(bodies.len(), false);
        for together in bodies.iter() {
            self.moves[together.island] |= !together.resting;
        }
        let awake = self.rigids.iter().filter(|rigid| !rigid.rests);
        let rigids = awake.flat_map(|rigid| &rigid.near);
        for &near in probes.iter().flat_map(|probe| &probe.near).chain(rigids) {
            self.moves[bodies[near].island] = true;
        }
        for together in bodies.iter_mut() {
            together.resting = !self.moves[together.island];
        }
    }

    /// Finds the bodies that move, and that are their whole island.
    fn find_lone(&mut self, bodies: &mut [Together<'_>], probes: &[Probe]) {
        for together in bodies.iter_mut() {
            together.lone = !together.resting;
        }
        for pair in &self.pairs {
            pair.iter().for_each(|&index| bodies[index as usize].lone = false);
        }
        let rigids = self.rigids.iter().flat_map(|rigid| &rigid.near);
        for &near in probes.iter().flat_map(|probe| &probe.near).chain(rigids) {
            bodies[near].lone = false;
        }
    }

    /// Joins the bodies of all pairs, and those near one probe or near rigid bodies that touch.
    fn find_islands(&mut self, bodies: &mut [Together<'_>], probes: &[Probe]) {
        self.first.clear();
        self.first.extend(0..bodies.len() + self.rigids.len());
        let root = |first: &[usize], mut index: usize| {
            while first[index] != index {
                index = first[index];
            }
            index
        };
        let probed = probes.iter().flat_map(|probe| probe.near.windows(2).map(|pair| [pair[0], pair[1]]));
        // Rigid bodies come after all bodies.
        let sound = self.rigids.iter().enumerate().filter(|(_, rigid)| rigid.is_sound());
        let rigids = sound.flat_map(|(number, rigid)| {
            let own = bodies.len() + number;
            let of = |key| self.rigids.iter().position(|other| other.key == key && other.is_sound());
            let touched = rigid.supports.iter().filter_map(move |support| of(support.other?));
            let touched = touched.map(|other| bodies.len() + other);
            rigid.near.iter().copied().chain(touched).map(move |other| [own, other])
        });
        let pairs = self.pairs.iter().map(|pair| pair.map(|index| index as usize));
        for pair in pairs.chain(probed).chain(rigids) {
            let [a, b] = pair.map(|index| root(&self.first, index));
            self.first[a.max(b)] = a.min(b);
        }
        for index in 0..self.first.len() {
            self.first[index] = root(&self.first, index);
        }
        for (body, first) in bodies.iter_mut().zip(&self.first) {
            body.island = *first;
        }
        self.order.clear();
        self.order.extend(0..bodies.len());
        self.order.sort_unstable_by_key(|&index| (self.first[index], index));
        self.local.clear();
        self.local.resize(bodies.len(), 0);
        let mut count = 0;
        for (number, &index) in self.order.iter().enumerate() {
            let begins = number == 0 || self.first[self.order[number - 1]] != self.first[index];
            count = if begins { 0 } else { count + 1 };
            self.local[index] = count;
        }
    }
}
