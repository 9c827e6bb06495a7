//! Single steps while time is held.

use bevy::prelude::*;

/// Lets so many fixed steps pass in the next frame, while Bevy's `Time<Virtual>` is paused. Needs bodies that are stepped in the fixed loop,
/// as they are unless [`PliantBodyPlugin::new`](crate::PliantBodyPlugin::new) was told otherwise.
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
/// Pausing `Time<Virtual>` is all that holding the time takes: no tick is counted, no body stepped, no surface written, and targets that are moved
/// meanwhile are acted on in the next step. A single step runs the whole fixed loop once, with the game's own systems in it. While time runs
/// nothing is added to it: the message is then forgotten. More than [`SingleSteps::MOST`] steps a frame are cut to that number.
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Clone, PartialEq)]
pub struct SingleSteps(pub u32);

impl SingleSteps {
    /// Most steps that pass in one frame.
    pub const MOST: u32 = 1_000;
}

pub(crate) fn single_steps(
    mut messages: MessageReader<SingleSteps>,
    time: Option<Res<Time<Virtual>>>,
    fixed: Option<ResMut<Time<Fixed>>>,
) {
    let steps = messages.read().fold(0_u32, |sum, steps| sum.saturating_add(steps.0));
    let (Some(time), Some(mut fixed)) = (time, fixed) else { return };
    if steps > 0 && time.is_paused() {
        let passed = fixed.timestep().saturating_mul(steps.min(SingleSteps::MOST));
        fixed.accumulate_overstep(passed);
    }
}
