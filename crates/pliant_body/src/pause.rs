//! Single steps while time is paused.

use bevy::prelude::*;

/// Runs this number of fixed steps in the next frame while Bevy's `Time<Virtual>` is paused.
///
/// The bodies must be stepped in the fixed loop, which is the default. See
/// [`PliantBodyPlugin::new`](crate::PliantBodyPlugin::new).
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::SingleSteps;
/// fn keys(keys: Res<ButtonInput<KeyCode>>, mut time: ResMut<Time<Virtual>>, mut steps: MessageWriter<SingleSteps>) {
///     if keys.just_pressed(KeyCode::Space) {
///         if time.is_paused() { time.unpause() } else { time.pause() }
///     }
///     if keys.just_pressed(KeyCode::Period) {
///         steps.write(SingleSteps(1));
///     }
/// }
/// ```
///
/// Pausing `Time<Virtual>` is enough to pause the bodies: no tick is counted, no body is stepped
/// and no surface is written. Targets that move during the pause take effect in the next step. A
/// single step runs the whole fixed loop once, together with the game's own systems in it. While
/// time runs, the message has no effect and is dropped. A frame runs at most [`SingleSteps::MAX`]
/// steps.
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Clone, PartialEq)]
pub struct SingleSteps(pub u32);

impl SingleSteps {
    /// Maximum number of steps in one frame.
    pub const MAX: u32 = 1_000;
}

pub(crate) fn single_steps(
    mut messages: MessageReader<SingleSteps>,
    time: Option<Res<Time<Virtual>>>,
    fixed: Option<ResMut<Time<Fixed>>>,
) {
    let steps = messages.read().fold(0_u32, |sum, steps| sum.saturating_add(steps.0));
    let (Some(time), Some(mut fixed)) = (time, fixed) else { return };
    if steps > 0 && time.is_paused() {
        let passed = fixed.timestep().saturating_mul(steps.min(SingleSteps::MAX));
        fixed.accumulate_overstep(passed);
    }
}
