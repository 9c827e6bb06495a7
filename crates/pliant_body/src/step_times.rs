//! What a step of each body takes.

use std::time::Duration;

use bevy::{ecs::entity::EntityHashMap, prelude::*};
use pliant_modal::Together;

/// Time that the newest step of each body has taken, for whoever asks.
///
/// Where the app has this resource, the steps of the ticks after a call of [`ask`](Self::ask) are
/// measured. Bodies that are near other bodies, tools or rigid bodies are stepped together, and
/// share the time of all such steps equally. The search for what is near is nobody's.
#[derive(Resource, Debug, Default, Clone)]
pub struct BodyStepTimes {
    /// Number of ticks that are still measured.
    asked: u32,
    times: EntityHashMap<Duration>,
}

impl BodyStepTimes {
    /// Number of ticks that are measured after a call of [`ask`](Self::ask).
    pub const TICKS: u32 = 64;

    /// Has the steps of the next [`TICKS`](Self::TICKS) ticks measured. Call it in every frame or
    /// tick in which the times are looked at.
    pub fn ask(&mut self) {
        self.asked = Self::TICKS;
    }

    /// Time that the newest step of the body has taken. `None` if it was not stepped in the newest
    /// tick, or if nobody has asked.
    pub fn get(&self, body: Entity) -> Option<Duration> {
        self.times.get(&body).copied()
    }

    /// Whether a tick has to measure, or to forget what the one before it has measured.
    pub(crate) fn has_work(&self) -> bool {
        self.asked > 0 || !self.times.is_empty()
    }

    /// Forgets the tick before. Returns whether the steps of this tick are measured.
    pub(crate) fn begin_tick(&mut self) -> bool {
        self.times.clear();
        let measured = self.asked > 0;
        self.asked = self.asked.saturating_sub(1);
        measured
    }

    /// Sets the times of a tick. The bodies that are not alone were stepped within `together`.
    pub(crate) fn set(&mut self, bodies: &[Together<'_>], together: Duration) {
        let awake = || bodies.iter().filter(|member| !member.resting);
        let count = awake().filter(|member| !member.is_lone()).count() as u32;
        let share = together.checked_div(count).unwrap_or_default();
        self.times.extend(awake().filter_map(|member| {
            let body = Entity::try_from_bits(member.key)?;
            Some((body, if member.is_lone() { member.took } else { share }))
        }));
    }
}
