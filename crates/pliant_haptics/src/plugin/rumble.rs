//! Vibration of gamepads: Bevy's rumble as a [`VibrationOutput`].

use std::{
    sync::mpsc::{Receiver, Sender, channel},
    time::Duration,
};

use bevy::{
    input::gamepad::{GamepadRumbleIntensity, GamepadRumbleRequest},
    platform::cell::SyncCell,
    prelude::*,
};

use super::{HapticDevices, HapticTool};
use crate::VibrationOutput;

/// Source of [`GamepadVibration`] outputs. Their requests are sent once per frame.
#[derive(Resource)]
pub struct Rumble {
    sender: Sender<GamepadRumbleRequest>,
    receiver: SyncCell<Receiver<GamepadRumbleRequest>>,
}

impl Default for Rumble {
    fn default() -> Self {
        let (sender, receiver) = channel();
        Self { sender, receiver: SyncCell::new(receiver) }
    }
}

impl Rumble {
    /// Returns the vibration output of `gamepad`. The caller keeps it and may use it on any thread.
    pub fn output(&self, gamepad: Entity) -> GamepadVibration {
        GamepadVibration { gamepad, sender: self.sender.clone() }
    }
}

/// The motors of a gamepad.
#[derive(Debug, Clone)]
pub struct GamepadVibration {
    gamepad: Entity,
    sender: Sender<GamepadRumbleRequest>,
}

impl VibrationOutput for GamepadVibration {
    fn vibrate(&mut self, strong: f64, weak: f64, seconds: f64) {
        let within = |x: f64, most: f64| if x.is_nan() { 0.0 } else { x.clamp(0.0, most) };
        let part = |x: f64| within(x, 1.0) as f32;
        let duration = Duration::from_secs_f64(within(seconds, 60.0));
        let intensity = GamepadRumbleIntensity { strong_motor: part(strong), weak_motor: part(weak) };
        // A send error means that the receiver is gone because the app is ending.
        let _ = self.sender.send(GamepadRumbleRequest::Add { duration, intensity, gamepad: self.gamepad });
    }

    fn stop(&mut self) {
        let _ = self.sender.send(GamepadRumbleRequest::Stop { gamepad: self.gamepad });
    }
}

/// Makes a gamepad vibrate in proportion to the force of its tool. The vibration is only a hint of
/// the force and has no direction.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct ToolRumble {
    /// The gamepad's entity.
    #[entities]
    pub gamepad: Entity,
    /// Force at which the gamepad vibrates at full strength, N. Default: 3.
    pub full: f64,
}

impl Default for ToolRumble {
    /// For no gamepad, with full strength at 3 N.
    fn default() -> Self {
        Self::new(Entity::PLACEHOLDER)
    }
}

impl ToolRumble {
    /// Creates the component for `gamepad`, with full strength at 3 N.
    pub fn new(gamepad: Entity) -> Self {
        Self { gamepad, full: 3.0 }
    }
}

/// Interval of the requests to the motors, s. The motors respond more slowly than this interval.
const EVERY: f64 = 0.05;

pub(crate) fn follow_force(
    time: Res<Time<Real>>,
    mut since: Local<f64>,
    devices: Res<HapticDevices>,
    rumble: Res<Rumble>,
    tools: Query<(&HapticTool, &ToolRumble)>,
) {
    *since += time.delta_secs_f64();
    if *since < EVERY {
        return;
    }
    *since = 0.0;
    for (tool, buzz) in &tools {
        let Some(status) = devices.get(tool.device) else { continue };
        let force = status.report.tick.wrench.force.iter().map(|f| f * f).sum::<f64>().sqrt();
        let strength = if buzz.full > 0.0 { force / buzz.full } else { 0.0 };
        let mut output = rumble.output(buzz.gamepad);
        output.stop();
        if strength > 0.02 {
            output.vibrate(strength, 0.5 * strength, 2.0 * EVERY);
        }
    }
}

pub(crate) fn send(mut rumble: ResMut<Rumble>, mut requests: MessageWriter<GamepadRumbleRequest>) {
    for request in rumble.receiver.get().try_iter() {
        requests.write(request);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_come_out_clamped_and_in_order() {
        let mut app = App::new();
        app.add_message::<GamepadRumbleRequest>().init_resource::<Rumble>().add_systems(Update, send);
        let pad = app.world_mut().spawn_empty().id();
        let mut output = app.world().resource::<Rumble>().output(pad);
        output.vibrate(2.0, f64::NAN, 0.1);
        output.stop();
        app.update();
        let messages = app.world().resource::<Messages<GamepadRumbleRequest>>();
        let sent: Vec<_> = messages.iter_current_update_messages().collect();
        assert!(matches!(
            sent[..],
            [
                GamepadRumbleRequest::Add {
                    intensity: GamepadRumbleIntensity { strong_motor: 1.0, weak_motor: 0.0 },
                    ..
                },
                GamepadRumbleRequest::Stop { gamepad },
            ] if *gamepad == pad
        ));
    }
}
