//! What the apps tell each other beside the session: where the host has placed its bodies.
//!
//! Every reliable message begins with a byte that says whose it is. Both kinds share the one ordered stream.

use std::sync::Arc;

use bevy::prelude::*;
use bytes::{BufMut, Bytes, BytesMut};
use pliant_stream::BodyId;

/// A body that everybody in the session sees and may hold.
///
/// On a host, next to a [`ModalBody`](pliant_body::ModalBody): the body is streamed. On a guest, on an entity that the app has made for the
/// body of this name: the body arrives there, wherever the entity is, with what else is on it (a material, say). A guest without such an entity gets
/// one made, where the host has it.
#[derive(Component, Debug, Clone, PartialEq, Eq, Reflect)]
#[reflect(Component, Clone, PartialEq)]
pub struct SharedBody {
    /// What the body is called in the session, at most 64 bytes. Two bodies of one name are met in the order in which they arrive.
    pub name: String,
}

impl SharedBody {
    /// A body called `name`.
    pub fn named(name: impl Into<String>) -> Self {
        Self { name: name.into() }
    }
}

/// A message of the session.
const SESSION: u8 = 0;
/// A [`Placement`].
const PLACEMENT: u8 = 1;

/// Where the host has a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placement {
    pub(crate) body: BodyId,
    pub(crate) transform: Transform,
}

/// A reliable message, by whose it is.
#[derive(Debug, PartialEq)]
pub(crate) enum Reliable<'a> {
    Session(&'a [u8]),
    Placement(Placement),
}

pub(crate) fn session_message(bytes: &Arc<[u8]>) -> Bytes {
    let mut message = BytesMut::with_capacity(1 + bytes.len());
    message.put_u8(SESSION);
    message.put_slice(bytes);
    message.freeze()
}

impl Placement {
    /// Of a body at `transform`; its scale is uniform.
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

/// Reads any bytes. `None`: of no kind that this version knows, or with a number out of range.
pub(crate) fn read(message: &[u8]) -> Option<Reliable<'_>> {
    match message.split_first()? {
        (&SESSION, rest) => Some(Reliable::Session(rest)),
        (&PLACEMENT, rest) => Placement::from_bytes(rest).map(Reliable::Placement),
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
        // Each number in turn is NaN, infinite and absurd.
        for number in 0..8 {
            for bad in [f32::NAN, f32::INFINITY, 1e30] {
                let mut message = message.to_vec();
                message[3 + 4 * number..7 + 4 * number].copy_from_slice(&bad.to_le_bytes());
                assert_eq!(read(&message), None, "number {number} is {bad}");
            }
        }
        assert_eq!(read(&[7, 1, 2]), None);
        let of_session: Arc<[u8]> = vec![1, 2, 3].into();
        assert_eq!(read(&session_message(&of_session)), Some(Reliable::Session(&[1, 2, 3])));
    }
}
