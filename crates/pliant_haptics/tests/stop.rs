//! The emergency stop between the app, the loop and who presses it, in all orders of their steps
//! (loom).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[path = "../src/control_loop/stop.rs"]
mod stop;

mod sync {
    pub(crate) use loom::sync::Arc;
    pub(crate) use loom::sync::atomic::{AtomicBool, Ordering};
}

use std::collections::VecDeque;

use loom::sync::{Arc, Mutex};
use loom::thread;
use stop::StopSwitch;

/// What the app tells the loop.
#[derive(Clone, Copy)]
enum Command {
    Reset,
    Other,
}

/// The queue of commands, with room for one.
type Commands = Arc<Mutex<VecDeque<Command>>>;

/// The loop's side: whether the stop is latched, and whether this period has seen it pressed.
struct Loop {
    stop: StopSwitch,
    commands: Commands,
    latched: bool,
    pressed: bool,
}

impl Loop {
    fn period(&mut self) {
        self.pressed = false;
        self.stop.clone().obey(
            self,
            |this| {
                let command = this.commands.lock().unwrap().pop_front();
                this.latched &= !matches!(command, Some(Command::Reset));
            },
            |this| (this.latched, this.pressed) = (true, true),
        );
        assert!(self.latched || !self.pressed, "a force while the stop is pressed");
    }
}

/// Tells the loop to unlatch, if there is room.
fn push_command(commands: &Commands) -> bool {
    let mut commands = commands.lock().unwrap();
    let has_room = commands.is_empty();
    if has_room {
        commands.push_back(Command::Reset);
    }
    has_room
}

/// A stop that is pressed, with commands that wait.
fn pressed(waiting: &[Command]) -> (StopSwitch, Commands, Loop) {
    let (stop, commands) = (StopSwitch::new(), Commands::default());
    stop.press();
    commands.lock().unwrap().extend(waiting);
    let of_loop = Loop { stop: stop.clone(), commands: commands.clone(), latched: false, pressed: false };
    (stop, commands, of_loop)
}

#[test]
fn a_press_beside_a_reset_ends_latched_or_free_as_the_switch_says() {
    loom::model(|| {
        let (stop, commands, mut of_loop) = pressed(&[]);
        let (by, app) = (stop.clone(), stop.clone());
        let presser = thread::spawn(move || by.press());
        let app = thread::spawn(move || app.reset(true, || push_command(&commands)));
        of_loop.period();
        presser.join().unwrap();
        assert!(app.join().unwrap(), "there is room");
        of_loop.period();
        assert_eq!(of_loop.latched, stop.is_pressed());
    });
}

#[test]
fn a_reset_that_finds_no_room_leaves_the_stop_pressed() {
    loom::model(|| {
        let (stop, commands, mut of_loop) = pressed(&[Command::Other]);
        let app = stop.clone();
        let app = thread::spawn(move || {
            let has_room = commands.lock().unwrap().is_empty();
            app.reset(has_room, || push_command(&commands))
        });
        of_loop.period();
        let is_reset = app.join().unwrap();
        of_loop.period();
        assert_eq!((of_loop.latched, stop.is_pressed()), (!is_reset, !is_reset));
    });
}
