//! The course of a run: its start, its end, and its picture.

use std::{path::PathBuf, time::Duration};

use bevy::{
    prelude::*,
    render::view::screenshot::{Screenshot, ScreenshotCaptured, save_to_disk},
    time::TimeUpdateStrategy,
};
use pliant::prelude::*;

use super::{Options, Readout};

/// Present with `--headless` and `--screenshot`: no person is there, so the example plays the user.
#[derive(Resource)]
pub struct Unattended;

/// Marks something that has yet to join or load.
///
/// An unattended run counts its frames and seconds only while no entity has this component, because
/// the waiting time depends on the machine.
#[derive(Component)]
pub struct Awaited;

/// Time step of an unattended frame, s.
const FRAME: f64 = 1.0 / 60.0;

/// Number of frames before the picture in which the cameras draw; a body is deformed one frame
/// after it was visible.
const DRAWN: u64 = 5;

/// Maximum time to wait for [`Awaited`] entities, s.
const LONGEST_WAIT: f64 = 300.0;

/// Maximum number of frames to wait for the bodies to load, and for the picture to be written.
const PATIENCE: u64 = 100_000;

#[derive(Resource)]
struct Run {
    headless: bool,
    /// Number of frames to run after the bodies exist.
    frames: Option<u64>,
    /// Duration of the run after the bodies exist, s of the app's clock.
    seconds: Option<f64>,
    screenshot: Option<PathBuf>,
    /// Frames since the bodies exist, and the time at which they first did, s; `None` before.
    since: Option<(u64, f64)>,
    /// Time at which the run began to wait for others, s of real time.
    awaits_since: Option<f64>,
    waited: u64,
    /// Number of frames in which the cameras have drawn.
    drawn: u64,
    picture: Picture,
}

/// State of the screenshot, if one is requested.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Picture {
    Wanted,
    Asked,
    Captured,
}

pub(super) fn build(app: &mut App, options: &Options, real_time: bool, picture_at: f64) {
    let unattended = options.headless || options.screenshot.is_some();
    let seconds = match (options.frames, options.seconds) {
        (None, None) if options.screenshot.is_some() => Some(picture_at),
        (None, None) if options.headless => Some(5.0),
        (_, seconds) => seconds,
    };
    app.insert_resource(Run {
        headless: options.headless,
        frames: options.frames,
        seconds,
        screenshot: options.screenshot.clone(),
        since: None,
        awaits_since: None,
        waited: 0,
        drawn: 0,
        picture: Picture::Wanted,
    });
    if unattended {
        app.insert_resource(Unattended);
        if !real_time {
            app.insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs_f64(FRAME)));
        }
        app.add_systems(Startup, |mut time: ResMut<Time<Virtual>>| time.pause());
    } else {
        app.add_systems(PreUpdate, pause_and_step.after(super::SceneKeys));
    }
    app.add_systems(First, begin.before(bevy::time::TimeSystems)).add_systems(Last, (draw_late, end).chain());
}

/// Starts the clock of an unattended run when all bodies exist, so that every run shows the same.
fn begin(
    mut run: ResMut<Run>,
    unattended: Option<Res<Unattended>>,
    real: Res<Time<Real>>,
    mut time: ResMut<Time<Virtual>>,
    waiting: Query<(), (With<ModalBody>, Without<BodyState>)>,
) {
    if run.since.is_some() {
        return;
    }
    run.waited += 1;
    if unattended.is_none() {
        run.since = Some((0, real.elapsed_secs_f64()));
    } else if run.waited > 2 && waiting.is_empty() {
        time.unpause();
        run.since = Some((0, real.elapsed_secs_f64()));
    } else {
        // Files are read on other threads.
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Pauses on Space, and steps once on the full stop.
fn pause_and_step(
    keys: Res<ButtonInput<KeyCode>>,
    mut time: ResMut<Time<Virtual>>,
    mut steps: MessageWriter<SingleSteps>,
    mut exit: MessageWriter<AppExit>,
) {
    if keys.just_pressed(KeyCode::Space) {
        if time.is_paused() { time.unpause() } else { time.pause() }
    }
    if keys.just_pressed(KeyCode::Period) {
        steps.write(SingleSteps(1));
    }
    if keys.just_pressed(KeyCode::Escape) {
        exit.write(AppExit::Success);
    }
}

/// Turns the cameras of a picture on only just before the picture, for slow renderers.
fn draw_late(mut run: ResMut<Run>, real: Res<Time<Real>>, mut cameras: Query<&mut Camera>) {
    if run.screenshot.is_none() {
        return;
    }
    let draws = run.since.is_some_and(|(frames, since)| {
        let left_frames = run.frames.map(|all| all.saturating_sub(frames));
        let left = run.seconds.map(|all| ((all - (real.elapsed_secs_f64() - since)) / FRAME).max(0.0) as u64);
        left_frames.or(left).is_none_or(|left| left <= DRAWN)
    });
    run.drawn += u64::from(draws);
    for mut camera in &mut cameras {
        if camera.is_active != draws {
            camera.is_active = draws;
        }
    }
}

fn end(
    mut commands: Commands,
    mut run: ResMut<Run>,
    real: Res<Time<Real>>,
    mut time: ResMut<Time<Virtual>>,
    readout: Res<Readout>,
    unattended: Option<Res<Unattended>>,
    awaited: Query<(), With<Awaited>>,
    mut exit: MessageWriter<AppExit>,
) {
    if run.since.is_some() && unattended.is_some() && !awaited.is_empty() {
        let now = real.elapsed_secs_f64();
        run.since = Some((0, now));
        if now - *run.awaits_since.get_or_insert(now) > LONGEST_WAIT {
            error!("whoever this scene waits for did not come");
            exit.write(AppExit::error());
        }
        return;
    }
    let Some((frames, since)) = run.since else {
        if run.waited > PATIENCE {
            error!("the bodies of this scene did not come; the lines above say why");
            exit.write(AppExit::error());
        }
        return;
    };
    let frames = frames + 1;
    run.since = Some((frames, since));
    let over = run.frames.is_some_and(|all| frames >= all)
        || run.seconds.is_some_and(|all| real.elapsed_secs_f64() - since >= all);
    if !over {
        return;
    }
    let Some(file) = run.screenshot.clone() else {
        if run.headless {
            println!("{}", readout.0);
        }
        exit.write(AppExit::Success);
        return;
    };
    match run.picture {
        // Frames can take longer than expected.
        Picture::Wanted if run.drawn < DRAWN => {}
        Picture::Wanted => {
            time.pause();
            run.waited = 0;
            run.picture = Picture::Asked;
            commands
                .spawn(Screenshot::primary_window())
                .observe(save_to_disk(file))
                .observe(|_: On<ScreenshotCaptured>, mut run: ResMut<Run>| run.picture = Picture::Captured);
        }
        Picture::Asked => {
            run.waited += 1;
            if run.waited > PATIENCE {
                error!("the window could not be pictured");
                exit.write(AppExit::error());
            }
        }
        Picture::Captured => {
            let written = std::fs::metadata(&file).is_ok_and(|found| found.len() > 0);
            if !written {
                error!("{} was not written", file.display());
            }
            exit.write(if written { AppExit::Success } else { AppExit::error() });
        }
    }
}
