//! Reliable messages between the apps beside the session: the host's body transforms, the users and
//! their links, and the guests' subscriptions.
//!
//! The first byte of every reliable message is its kind. All kinds share one ordered stream.

use std::sync::Arc;
use std::time::Duration;

use bevy::prelude::*;
use bytes::{BufMut, Bytes, BytesMut};
use pliant_stream::{BodyId, UserId};

use crate::transport::Role;
use crate::user::UserLink;

/// A body that all users of the session see and may hold.
///
/// On a host, next to a [`ModalBody`](pliant_body::ModalBody), this component streams the body. On
/// a guest, the app may put it on an entity for the body of this name. The body then arrives on
/// that entity, which keeps its transform and its other components (a material, for example). If
/// there is no such entity, the plugin spawns one at the host's transform.
#[derive(Component, Debug, Clone, PartialEq, Eq, Reflect)]
#[reflect(Component, Clone, PartialEq)]
pub struct SharedBody {
    /// Name of the body in the session, at most 64 bytes. Bodies of the same name are matched in
    /// the order in which they arrive.
    pub name: String,
}

impl SharedBody {
    /// Creates a shared body called `name`.
    pub fn named(name: impl Into<String>) -> Self {
        Self { name: name.into() }
    }
}

/// Kind: a message of the session.
const SESSION: u8 = 0;
/// Kind: a [`Placement`].
const PLACEMENT: u8 = 1;
/// Kind: [`Person`]s, sent by the host.
const PEOPLE: u8 = 2;
/// Kind: [`Reach`]es, sent by the host.
const REACHES: u8 = 3;
/// Kind: a [`Wanted`], sent by a guest.
const WANTED: u8 = 4;

/// Longest name, bytes.
pub(crate) const LONGEST_NAME: usize = 64;

/// A user of the session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Person {
    pub(crate) user: UserId,
    pub(crate) role: Role,
    /// Name of the user, at most [`LONGEST_NAME`] bytes.
    pub(crate) name: String,
}

/// Quality of the host's link to a user.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reach {
    pub(crate) user: UserId,
    /// Round trip, us.
    pub(crate) round_trip: u32,
    /// Loss of the user's datagrams (`loss_in`) and of the datagrams to the user (`loss_out`); 255
    /// is total loss.
    pub(crate) loss_in: u8,
    pub(crate) loss_out: u8,
}

impl Reach {
    pub(crate) fn new(user: UserId, link: &UserLink) -> Self {
        let part = |share: f64| (share.clamp(0.0, 1.0) * 255.0).round() as u8;
        Self {
            user,
            round_trip: u32::try_from(link.round_trip.as_micros()).unwrap_or(u32::MAX),
            loss_in: part(link.loss_in),
            loss_out: part(link.loss_out),
        }
    }

    pub(crate) fn to_link(self) -> UserLink {
        UserLink {
            round_trip: Duration::from_micros(self.round_trip.into()),
            loss_in: f64::from(self.loss_in) / 255.0,
            loss_out: f64::from(self.loss_out) / 255.0,
        }
    }
}

/// A guest's subscription to a body, as a number of modes. Zero means none and [`Wanted::ALL`]
/// means all modes that the guest accepts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Wanted {
    pub(crate) body: BodyId,
    pub(crate) modes: u16,
}

impl Wanted {
    pub(crate) const ALL: u16 = u16::MAX;

    pub(crate) fn to_message(self) -> Bytes {
        let mut message = BytesMut::with_capacity(5);
        message.put_u8(WANTED);
        message.put_u16_le(self.body.0);
        message.put_u16_le(self.modes);
        message.freeze()
    }
}

pub(crate) fn people_message(people: &[Person]) -> Bytes {
    let mut message = BytesMut::with_capacity(3 + people.len() * 20);
    message.put_u8(PEOPLE);
    message.put_u16_le(people.len() as u16);
    for person in people {
        message.put_u16_le(person.user.0);
        message.put_u8(person.role.to_byte());
        let name = shortened(&person.name);
        message.put_u8(name.len() as u8);
        message.put_slice(name.as_bytes());
    }
    message.freeze()
}

/// Cuts a name to the length that is sent.
pub(crate) fn shortened(name: &str) -> &str {
    let end = (0..=LONGEST_NAME.min(name.len())).rev().find(|&end| name.is_char_boundary(end));
    &name[..end.unwrap_or(0)]
}

pub(crate) fn reaches_message(reaches: &[Reach]) -> Bytes {
    let mut message = BytesMut::with_capacity(3 + reaches.len() * 8);
    message.put_u8(REACHES);
    message.put_u16_le(reaches.len() as u16);
    for reach in reaches {
        message.put_u16_le(reach.user.0);
        message.put_u32_le(reach.round_trip);
        message.put_u8(reach.loss_in);
        message.put_u8(reach.loss_out);
    }
    message.freeze()
}

fn people_from(bytes: &[u8]) -> Option<Vec<Person>> {
    let (&count, mut rest) = bytes.split_first_chunk::<2>()?;
    let mut people = Vec::new();
    for _ in 0..u16::from_le_bytes(count) {
        let (&[low, high, role, length], after) = rest.split_first_chunk::<4>()?;
        let length = usize::from(length);
        if length > LONGEST_NAME || length > after.len() {
            return None;
        }
        let (name, after) = after.split_at(length);
        rest = after;
        people.push(Person {
            user: UserId(u16::from_le_bytes([low, high])),
            role: Role::from_byte(role)?,
            name: std::str::from_utf8(name).ok()?.to_owned(),
        });
    }
    rest.is_empty().then_some(people)
}

fn reaches_from(bytes: &[u8]) -> Option<Vec<Reach>> {
    let (&count, rest) = bytes.split_first_chunk::<2>()?;
    if rest.len() != 8 * usize::from(u16::from_le_bytes(count)) {
        return None;
    }
    let reach = |bytes: &[u8; 8]| {
        let [low, high, a, b, c, d, loss_in, loss_out] = *bytes;
        let (user, round_trip) = (UserId(u16::from_le_bytes([low, high])), u32::from_le_bytes([a, b, c, d]));
        Reach { user, round_trip, loss_in, loss_out }
    };
    Some(rest.as_chunks::<8>().0.iter().map(reach).collect())
}

fn wanted_from(bytes: &[u8]) -> Option<Wanted> {
    let &[a, b, c, d] = <&[u8; 4]>::try_from(bytes).ok()?;
    Some(Wanted { body: BodyId(u16::from_le_bytes([a, b])), modes: u16::from_le_bytes([c, d]) })
}

/// The host's transform of a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placement {
    pub(crate) body: BodyId,
    pub(crate) transform: Transform,
}

/// A reliable message, by kind.
#[derive(Debug, PartialEq)]
pub(crate) enum Reliable<'a> {
    Session(&'a [u8]),
    Placement(Placement),
    People(Vec<Person>),
    Reaches(Vec<Reach>),
    Wanted(Wanted),
}

pub(crate) fn session_message(bytes: &Arc<[u8]>) -> Bytes {
    let mut message = BytesMut::with_capacity(1 + bytes.len());
    message.put_u8(SESSION);
    message.put_slice(bytes);
    message.freeze()
}

impl Placement {
    /// The placement of a body at `transform`, whose scale is uniform.
    pub(crate) fn new(body: BodyId, transform: &GlobalTransform) -> Self {
        let (scale, rotation, translation) = transform.to_scale_rotation_translation();
        Self { body, transform: Transform { translation, rotation, scale: Vec3::splat(scale.x) } }
    }

    pub(crate) fn to_message(self) -> Bytes {
        let mut message = BytesMut::with_capacity(1 + 2 + 8 * 4);
        message.put_u8(PLACEMENT);
        message.put_u16_le(self.body.0);
        let Transform { translation, rotation, scale } = self.transform;
        let numbers = translation.to_array().into_iter().chain(rotation.to_array()).chain([scale.x]);
        numbers.for_each(|number| message.put_f32_le(number));
        message.freeze()
    }

    fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (&body, rest) = bytes.split_first_chunk::<2>()?;
        if rest.len() != 8 * 4 {
            return None;
        }
        let mut numbers = [0.0; 8];
        for (number, bytes) in numbers.iter_mut().zip(rest.as_chunks::<4>().0) {
            *number = f32::from_le_bytes(*bytes);
        }
        let [x, y, z, qx, qy, qz, qw, scale] = numbers;
        let rotation = Quat::from_xyzw(qx, qy, qz, qw);
        let near = numbers.iter().all(|number| number.abs() < 1e6);
        let turns = (rotation.length_squared() - 1.0).abs() < 1e-3;
        if !(near && turns && scale > 1e-6) {
            return None;
        }
        let transform = Transform {
            translation: Vec3::new(x, y, z),
            rotation: rotation.normalize(),
            scale: Vec3::splat(scale),
        };
        Some(Self { body: BodyId(u16::from_le_bytes(body)), transform })
    }
}

/// Reads any bytes. Returns `None` for an unknown kind or a number out of range.
pub(crate) fn read(message: &[u8]) -> Option<Reliable<'_>> {
    match message.split_first()? {
        (&SESSION, rest) => Some(Reliable::Session(rest)),
        (&PLACEMENT, rest) => Placement::from_bytes(rest).map(Reliable::Placement),
        (&PEOPLE, rest) => people_from(rest).map(Reliable::People),
        (&REACHES, rest) => reaches_from(rest).map(Reliable::Reaches),
        (&WANTED, rest) => wanted_from(rest).map(Reliable::Wanted),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn placements_are_written_and_read_and_checked() {
        let transform = Transform {
            translation: Vec3::new(1.0, 2.0, -3.0),
            rotation: Quat::from_rotation_y(0.7),
            scale: Vec3::splat(0.5),
        };
        let placement = Placement::new(BodyId(513), &GlobalTransform::from(transform));
        let message = placement.to_message();
        let Some(Reliable::Placement(read_back)) = read(&message) else { panic!("not read") };
        assert_eq!(read_back.body, BodyId(513));
        assert!(read_back.transform.translation.distance(transform.translation) < 1e-6);
        assert!(read_back.transform.rotation.angle_between(transform.rotation) < 1e-3);
        for cut in 0..message.len() {
            assert_eq!(read(&message[..cut]), None, "cut to {cut} bytes");
        }
        // Each number in turn is NaN, infinite and far out of range.
        for number in 0..8 {
            for bad in [f32::NAN, f32::INFINITY, 1e30] {
                let mut message = message.to_vec();
                message[3 + 4 * number..7 + 4 * number].copy_from_slice(&bad.to_le_bytes());
                assert_eq!(read(&message), None, "number {number} is {bad}");
            }
        }
        assert_eq!(read(&[77, 1, 2]), None);
        let of_session: Arc<[u8]> = vec![1, 2, 3].into();
        assert_eq!(read(&session_message(&of_session)), Some(Reliable::Session(&[1, 2, 3])));
    }

    #[test]
    fn people_and_wishes_are_written_and_read_and_checked() {
        let person = |user, role, name: &str| Person { user: UserId(user), role, name: name.to_owned() };
        let people = vec![person(0, Role::Hold, "host"), person(513, Role::Watch, "Änne")];
        let message = people_message(&people);
        assert_eq!(read(&message), Some(Reliable::People(people)));
        let reaches = vec![
            Reach { user: UserId(1), round_trip: 196_000, loss_in: 23, loss_out: 255 },
            Reach { user: UserId(999), round_trip: u32::MAX, loss_in: 0, loss_out: 1 },
        ];
        let of_reaches = reaches_message(&reaches);
        assert_eq!(read(&of_reaches), Some(Reliable::Reaches(reaches)));
        let wanted = Wanted { body: BodyId(7), modes: Wanted::ALL };
        let of_wanted = wanted.to_message();
        assert_eq!(read(&of_wanted), Some(Reliable::Wanted(wanted)));
        for message in [&message, &of_reaches, &of_wanted] {
            for cut in 0..message.len() {
                assert_eq!(read(&message[..cut]), None, "cut to {cut} bytes of {message:?}");
            }
        }
        // An invalid role, an invalid name, and a count of more people than the message holds.
        for (at, byte) in [(5, 2), (6, 65), (7, 0xff), (1, 3)] {
            let mut wrong = message.to_vec();
            wrong[at] = byte;
            assert_eq!(read(&wrong), None, "byte {at} is {byte}");
        }
        // A name that is too long is cut at a character boundary.
        let long = person(1, Role::Hold, &"ä".repeat(40));
        let Some(Reliable::People(cut)) = read(&people_message(&[long])) else { panic!("not read") };
        assert_eq!(cut[0].name, "ä".repeat(32));
    }
}
