//! The datagram of rigid bodies: where they are at one tick, and how they move.

use super::datagram::bounded;
use super::{Reader, Writer};
use crate::StreamError;
use crate::state::{RigidId, RigidState, Tick};

/// Bytes of a datagram's header, tick and count.
pub(crate) const HEADER: usize = 3 + 6 + 1;
/// Bytes of one rigid body.
pub(crate) const ENTRY: usize = 2 + 12 + 8 + 9 + 9;
/// Largest number of rigid bodies in one datagram.
pub(crate) const MAX_ENTRIES: usize = 255;

/// Bits of one component of a rotation, and its largest value, since the largest of four components
/// of a unit quaternion is left out.
const BITS: u32 = 20;
const MOST: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// Poses and velocities of rigid bodies after one tick of the host.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidPoses {
    /// The tick after which they hold.
    pub tick: Tick,
    /// Rigid bodies that move, at most 255.
    pub poses: Vec<(RigidId, RigidState)>,
}

impl RigidPoses {
    pub(super) fn encode(&self, w: &mut Writer) {
        let poses = &self.poses[..self.poses.len().min(MAX_ENTRIES)];
        w.tick(self.tick);
        w.u8(poses.len() as u8);
        for (rigid, state) in poses {
            w.u16(rigid.0);
            w.vector(state.position);
            w.u64(pack(state.rotation));
            w.vector24(state.linear);
            w.vector24(state.angular);
        }
    }

    pub(super) fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let tick = r.tick("rigid tick")?;
        let count = r.u8("rigid count")?;
        bounded("rigid count", count, MAX_ENTRIES, "at most 255")?;
        let mut poses = Vec::with_capacity(usize::from(count).min(r.left() / ENTRY));
        for _ in 0..count {
            let rigid = RigidId(r.u16("rigid")?);
            let position = r.vector("rigid position")?;
            let rotation = unpack(r.u64("rigid rotation")?)?;
            let (linear, angular) = (r.vector24("rigid velocity")?, r.vector24("rigid spin")?);
            poses.push((rigid, RigidState { position, rotation, linear, angular }));
        }
        Ok(Self { tick, poses })
    }
}

/// Packs a unit quaternion into 62 bits: which component is the largest, and the other three in 20
/// bits each. A rotation is then off by at most 4.7e-6 rad.
fn pack(rotation: [f64; 4]) -> u64 {
    let length = rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
    let unit = if length > 0.0 { rotation.map(|x| x / length) } else { [0.0, 0.0, 0.0, 1.0] };
    let largest = (0..4).max_by(|&a, &b| unit[a].abs().total_cmp(&unit[b].abs())).unwrap_or(3);
    let sign = unit[largest].signum();
    let steps = f64::from((1 << BITS) - 2);
    (0..4).filter(|k| *k != largest).fold(largest as u64, |packed, k| {
        let share = (sign * unit[k] / MOST + 1.0) * 0.5;
        packed << BITS | (share.clamp(0.0, 1.0) * steps).round() as u64
    })
}

fn unpack(packed: u64) -> Result<[f64; 4], StreamError> {
    let largest = (packed >> (3 * BITS)) as usize;
    if largest > 3 {
        let found = format!("component {largest}");
        return Err(StreamError::Invalid { what: "rigid rotation", found, expected: "component 0..=3" });
    }
    let steps = f64::from((1 << BITS) - 2);
    let mut rotation = [0.0; 4];
    for (place, k) in (0..4).filter(|k| *k != largest).enumerate() {
        let step = packed >> (BITS as usize * (2 - place)) & ((1 << BITS) - 1);
        rotation[k] = (step as f64 / steps * 2.0 - 1.0) * MOST;
    }
    let others: f64 = rotation.iter().map(|x| x * x).sum();
    rotation[largest] = (1.0 - others).max(0.0).sqrt();
    // Three components that are too large together, which no encoder writes, make no unit
    // quaternion.
    let length = others.max(1.0).sqrt();
    Ok(rotation.map(|x| x / length))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Angle between two rotations, rad.
    fn angle(a: [f64; 4], b: [f64; 4]) -> f64 {
        // Half of the angle by the shorter of two chords, which is exact for small angles.
        let chord = |sign: f64| (0..4).map(|k| (a[k] - sign * b[k]).powi(2)).sum::<f64>().sqrt();
        4.0 * (chord(1.0).min(chord(-1.0)) / 2.0).asin()
    }

    #[test]
    fn rotations_come_back_within_a_few_millionths() {
        let mut worst: f64 = 0.0;
        let mut seed = 1_u64;
        let mut random = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (seed >> 11) as f64 / (1_u64 << 53) as f64 * 2.0 - 1.0
        };
        let mut all: Vec<[f64; 4]> = (0..20_000).map(|_| [random(), random(), random(), random()]).collect();
        all.extend((0..4).map(|k| std::array::from_fn(|i| f64::from(u8::from(i == k)))));
        all.push([0.5, -0.5, 0.5, -0.5]);
        for rotation in all {
            let length = rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
            if length < 0.1 {
                continue;
            }
            let unit = rotation.map(|x| x / length);
            let back = unpack(pack(rotation)).unwrap();
            assert!((back.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
            worst = worst.max(angle(unit, back));
        }
        // Half a step in each of three components, and all of that in the fourth where it is as
        // large as they are: twice the square root of 12 times half of a step.
        assert!(worst < 4.7e-6, "{worst} rad");
    }

    #[test]
    fn any_number_is_a_rotation_or_an_error() {
        let mut seed = 7_u64;
        for _ in 0..20_000 {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            match unpack(seed) {
                Ok(q) => assert!((q.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-9, "{q:?}"),
                Err(_) => assert!(seed >> (3 * BITS) > 3),
            }
        }
        assert_eq!(unpack(pack([0.0; 4])).unwrap()[3], 1.0, "what is no rotation is none");
    }
}
