//! What a step with contacts keeps: for the next step, and for users to read.

use nalgebra::Vector3;

use super::{Group, Member};
use crate::{
    contact::{Contact, ContactPoint, ContactReport, Contacts, Memory, Touched, Touching},
    step::kernel::points,
};

impl<P: Member> Group<'_, P> {
    /// Stores what the next step needs and what users read.
    pub(super) fn end(&mut self, work: &mut Touching, theta: f64, report: &ContactReport) {
        for member in 0..self.len() {
            let contacts = self.parts(member).contacts;
            contacts.memory.clear();
            for attachment in &mut contacts.attachments {
                attachment.force = Vector3::zeros();
                attachment.largest *= 0.95;
            }
            contacts.report = *report;
        }
        work.points.sort_unstable_by_key(|point| {
            let other = match point.other {
                Touched::Obstacle(index) => (0, index as u64),
                Touched::Body(key) => (1, key),
                Touched::Probe(index) => (2, index as u64),
                Touched::Attachment(index) => (3, index as u64),
            };
            (point.member, other, point.site)
        });
        for &probe in self.held {
            self.probes[probe].memory.clear();
            let [_, torque] = points::pull_on_probe(&work.points, probe);
            self.probes[probe].set_torque(torque);
        }
        points::write_forces(self, work);
        for point in &work.points {
            if let Some((probe, contact, memory)) = points::keep_at_probe(self, point) {
                let probe = &mut self.probes[probe];
                probe.contacts.push(contact);
                probe.memory.extend(memory);
            }
            let force = point.world_force();
            if let Some(at) = point.attached {
                let own = self.parts(point.member).contacts.attachments.get_mut(at.index);
                if let Some(own) = own.filter(|_| force.iter().all(|x| x.is_finite())) {
                    own.force = force;
                    own.largest = force.norm().max(own.largest);
                }
                continue;
            }
            if point.pushed[0] <= 0.0 || !force.iter().all(|x| x.is_finite()) {
                continue;
            }
            self.keep(point, &force);
        }
        for member in 0..self.len() {
            let contacts = self.parts(member).contacts;
            contacts.report.contacts = contacts.list.len();
            // A body whose sites touch nothing may still be touched.
            contacts.theta = if contacts.list.is_empty() { 0.5 } else { theta };
        }
    }

    /// Keeps a contact with force for the next step, and lists it at both bodies.
    fn keep(&mut self, point: &ContactPoint, force: &Vector3<f64>) {
        let held = point.pushed[1].hypot(point.pushed[2]);
        let sliding = held >= point.friction * point.pushed[0] * (1.0 - 1e-9);
        let normal = point.axes.row(0).transpose();
        let dent = point.dent(force);
        let shift = point.indent.map_or(0.0, |indent| indent.shift);
        let penetration = (-(point.off[0] - shift + point.floor + normal.dot(&dent))).max(0.0);
        let add = |contacts: &mut Contacts, contact: Contact, energy: f64| {
            let report = &mut contacts.report;
            report.force = (Vector3::from(report.force) + Vector3::from(contact.force)).into();
            report.penetration = report.penetration.max(penetration);
            report.energy += energy;
            contacts.list.push(contact);
        };
        let mut contact = Contact {
            other: point.other,
            vertex: 0,
            point: point.place.into(),
            normal: normal.into(),
            force: (*force).into(),
            penetration,
            sliding,
        };
        if let Some(at) = &point.probe {
            let Some((_, carriers)) = &at.first else { return };
            let sites = self.view(point.member).sites();
            let site = carriers.largest().and_then(|site| sites?.sites.get(site));
            contact.vertex = site.map_or(0, |site| site.vertex);
            add(self.parts(point.member).contacts, contact, point.stored(force));
            return;
        }
        let view = self.view(point.member);
        let key = view.contacts.key;
        let Some(site) = view.sites().and_then(|sites| sites.sites.get(point.site)) else { return };
        let mut anchor = if sliding { point.end + dent } else { point.anchor };
        // The next step holds the material of the new contact point.
        anchor += point.place - point.end;
        let toward = if site.radius > 0.0 { point.last } else { point.first };
        contact.vertex = site.vertex;
        let far = point.far.as_ref().map(|far| {
            let view = self.view(far.member);
            let turn = view.state.frame.rotation().inverse();
            let sites = view.sites();
            let field = sites.map(|sites| sites.field(&view.kernel.model));
            let rest = field.map_or_else(Vector3::zeros, |field| field.rest(&far.place));
            let site = far.carriers.largest().and_then(|site| sites?.sites.get(site));
            let vertex = site.map_or(0, |site| site.vertex);
            (rest + turn * (anchor - far.end), vertex)
        });
        if let Some(at) = point.rigid {
            // What sticks to a rigid body stays in its axes.
            anchor = self.rigids[at.rigid].to_local(&anchor, self.h);
        }
        let (anchor, vertex) = far.unwrap_or((anchor, 0));
        let theirs = point.far.map_or(0.0, |far| 0.5 * force.dot(&(far.compliance * force)));
        let contacts = self.parts(point.member).contacts;
        let place = point.far.map(|far| far.place);
        let (other, site) = (point.other, point.site);
        let leads = point.indent.is_some().then(|| point.stored(force).max(0.0));
        contacts.memory.push(Memory { other, site, force: *force, anchor, toward, place, leads });
        add(contacts, contact, point.stored(force) - theirs);
        if let Some(far) = &point.far {
            let opposite = Contact {
                other: Touched::Body(key),
                vertex,
                normal: (-normal).into(),
                force: (-force).into(),
                ..contact
            };
            add(self.parts(far.member).contacts, opposite, theirs);
        }
    }
}
