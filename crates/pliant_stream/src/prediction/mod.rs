//! Copies of a body that are stepped before everything about their ticks is known.
//!
//! A copy is a state with its hands ([`BodyCopy`]). What turns out different is mended by stepping
//! again from a tick that is known ([`Rollback`]), and the change fades in what is shown
//! ([`VisualCopy`]). Guests, their predicted hands and peers all use these.

mod body_copy;
mod hitch_guard;
mod predicted_hand;
mod ring;
mod rollback;
mod visual_copy;

pub(crate) use body_copy::BodyCopy;
pub use body_copy::HandState;
pub(crate) use hitch_guard::HitchGuard;
pub use predicted_hand::PredictedHand;
pub(crate) use ring::Ring;
pub(crate) use rollback::Rollback;
pub(crate) use visual_copy::VisualCopy;
