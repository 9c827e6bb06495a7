//! Spring and damper of a hand in a datagram. Only those that the hand has take space.

use pliant_modal::GrabConfig;

use super::message::check_hold;
use super::{Reader, Writer};
use crate::StreamError;

const SPRING: u8 = 1;
const DAMPER: u8 = 2;

/// What the hand has: 1 a spring, 2 a damper.
pub(super) fn hold_parts(hold: &GrabConfig) -> u8 {
    let spring = if hold.stiffness.is_some() { SPRING } else { 0 };
    spring | if hold.relaxation != 0.0 { DAMPER } else { 0 }
}

/// Number of bytes of spring and damper: 4 each, if present.
pub(super) fn hold_bytes(hold: &GrabConfig) -> usize {
    4 * hold_parts(hold).count_ones() as usize
}

/// Writes what [`hold_parts`] names.
pub(super) fn encode_hold(hold: &GrabConfig, w: &mut Writer) {
    if let Some(stiffness) = hold.stiffness {
        w.f32(stiffness as f32);
    }
    if hold.relaxation != 0.0 {
        w.f32(hold.relaxation as f32);
    }
}

/// Reads what `parts` names, and limits it to what devices have.
pub(super) fn decode_hold(parts: u8, r: &mut Reader<'_>) -> Result<GrabConfig, StreamError> {
    let mut hold = GrabConfig::default();
    if parts & SPRING != 0 {
        hold.stiffness = Some(r.f32("hold stiffness")?);
    }
    if parts & DAMPER != 0 {
        hold.relaxation = r.f32("hold relaxation")?;
    }
    check_hold(hold)
}
