//! Tests of what a slow, closed or disabled sink receives, and of what it costs.

use std::{
    io::Read,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use bevy::{
    log::{
        debug, info,
        tracing::subscriber,
        tracing_subscriber::{layer::SubscriberExt, registry},
        warn,
    },
    prelude::*,
};
use crossbeam_channel::bounded;
use pliant_body::{Grab, ModalBody};

use crate::{
    RerunPlugin, RerunRecording, RerunScalars, RerunStats,
    collect::Collector,
    log_lines::Lines,
    queue::{FrameReceiver, queue},
    tests::{app, is_whole, numbers, recorder, rows, scratch, until, update_to},
    worker::{Message, Worker},
};

/// Returns an app whose sinks are queues that the test empties.
fn app_to(name: &str, queues: &[usize]) -> (App, Vec<FrameReceiver<Message>>) {
    let path = scratch(name);
    let mut app = app(RerunPlugin::file(&path));
    let (workers, inboxes) = queues.iter().map(|&room| Worker::held(room)).unzip();
    let (_, spare) = bounded(1);
    app.insert_resource(Collector::new(workers, spare));
    std::fs::remove_file(path).unwrap();
    (app, inboxes)
}

/// Logs the messages of a queue and returns the recording.
fn played(inbox: &FrameReceiver<Message>) -> Vec<rerun::log::LogMsg> {
    let (mut recorder, stream, storage) = recorder();
    for Message { frame, owed } in inbox.read() {
        if let Some(owed) = owed {
            recorder.catch_up(&frame, &owed).unwrap();
        }
        recorder.log(&frame).unwrap();
    }
    recorder.end();
    drop(stream);
    storage.take()
}

#[test]
fn what_went_in_a_tick_without_room_is_made_up_for() {
    // If the slow sink is alone, its ticks are not even made. Beside another sink they are made,
    // and the slow sink gets the missed data later.
    for queues in [&[2][..], &[2, 1000][..]] {
        let (mut app, inboxes) = app_to(&format!("owed{}", queues.len()), queues);
        let slow = &inboxes[0];
        let mut seen: Vec<Message> = Vec::new();
        while !(seen.iter().any(|m| !m.frame.arrived.is_empty())
            && seen.iter().any(|m| m.frame.hands.is_some()))
        {
            assert!(seen.len() < 20, "body and hand are there");
            app.update();
            seen.extend(slow.read());
        }
        // The sink stops reading, and its two places fill. Then the hand and the body are removed,
        // lines are logged, and a contact comes.
        app.update();
        app.update();
        let gone: Vec<Entity> = app
            .world_mut()
            .query_filtered::<Entity, Or<(With<Grab>, With<ModalBody>)>>()
            .iter(app.world())
            .collect();
        gone.into_iter().for_each(|entity| app.world_mut().despawn(entity).then_some(()).unwrap());
        #[cfg(feature = "contact")]
        app.world_mut().spawn(crate::tests_contact::touching());
        for line in ["first", "second", "third"] {
            app.world_mut().resource_mut::<RerunScalars>().log(line);
            app.world_mut().resource_mut::<RerunScalars>().set("of/then", "", 1.0);
            app.update();
        }
        assert_eq!(app.world().resource::<RerunStats>().dropped, 3);
        seen.extend(slow.read());
        app.update();
        seen.extend(slow.read());
        let (mut again, inbox) = queue(32);
        seen.into_iter().for_each(|message| again.offer(message).ok().unwrap());
        let messages = played(&inbox);
        assert_eq!(rows(&messages, "/world/square", "is_recursive"), 1, "the body does not stay as a ghost");
        assert_eq!(rows(&messages, "/reaction/hand", "is_recursive"), 1, "nor does the hand");
        assert_eq!(rows(&messages, "/log", "text"), 3, "every line, once");
        #[cfg(feature = "contact")]
        assert_eq!(rows(&messages, "/world/contacts", "vectors"), 1, "what touches, once");
        assert!(
            numbers(&messages, "/of/then", "scalars").is_empty(),
            "figures of a lost tick are not another's"
        );
        if let Some(quick) = inboxes.get(1) {
            let messages = played(quick);
            assert_eq!(rows(&messages, "/log", "text"), 3, "the other sink had them already");
            assert_eq!(rows(&messages, "/world/square", "is_recursive"), 1);
            #[cfg(feature = "contact")]
            assert_eq!(rows(&messages, "/world/contacts", "vectors"), 1);
        }
    }
}

#[test]
fn two_bodies_of_one_name_are_two_bodies() {
    let (mut app, inboxes) = app_to("names", &[100]);
    let first = app.world_mut().query::<&ModalBody>().single(app.world()).unwrap().clone();
    app.world_mut().spawn((first, Name::new("square")));
    (0..3).for_each(|_| app.update());
    let paths: Vec<String> = inboxes[0]
        .read()
        .flat_map(|message| {
            message.frame.arrived.iter().map(|body| body.path.to_string()).collect::<Vec<_>>()
        })
        .collect();
    let mut different = paths.clone();
    different.sort();
    different.dedup();
    assert_eq!(different.len(), 2, "{paths:?}");
    assert_eq!(different[0], "square");
    assert!(different[1].starts_with("square "), "{paths:?}");
}

#[test]
fn what_is_set_while_nothing_is_recorded_is_not_recorded_later() {
    let (mut app, inboxes) = app_to("stale", &[100]);
    let set = |app: &mut App, value: f64| {
        app.world_mut().resource_mut::<RerunScalars>().set("a/b", "", value);
        app.world_mut().resource_mut::<RerunScalars>().log(format!("{value}"));
        app.update();
    };
    app.world_mut().resource_mut::<RerunRecording>().metrics_hz = 0.0;
    set(&mut app, 1.0);
    app.world_mut().resource_mut::<RerunRecording>().on = false;
    set(&mut app, 2.0);
    *app.world_mut().resource_mut::<RerunRecording>() = RerunRecording::default();
    app.update();
    set(&mut app, 3.0);
    let messages = played(&inboxes[0]);
    assert_eq!(numbers(&messages, "/a/b", "scalars"), [3.0]);
    assert_eq!(rows(&messages, "/log", "text"), 2, "the first and the third: lines go with every tick");
}

#[test]
fn a_recording_that_starts_off_is_off_and_knows_its_sinks_before_the_first_tick() {
    let path = scratch("off from the start");
    let mut app = App::new();
    let off = RerunRecording { on: false, ..RerunRecording::default() };
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), pliant_body::PliantBodyPlugin::default()))
        .add_plugins(RerunPlugin::file(&path).with_rates(off));
    assert_eq!(app.world().resource::<RerunStats>().sinks, 1);
    assert!(!app.world().resource::<RerunRecording>().on);
    drop(app);
    std::fs::remove_file(path).unwrap();
}

#[test]
fn a_viewer_that_is_closed_is_noticed() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    listener.set_nonblocking(true).unwrap();
    let (close, closed) = bounded::<()>(0);
    let taken = Arc::new(AtomicUsize::new(0));
    let count = taken.clone();
    let viewer = std::thread::spawn(move || {
        let mut guests = Vec::new();
        let mut bytes = [0; 4096];
        while closed.try_recv() != Err(crossbeam_channel::TryRecvError::Disconnected) {
            if let Ok((guest, _)) = listener.accept() {
                guest.set_nonblocking(true).unwrap();
                guests.push(guest);
            }
            let read = guests.iter_mut().filter_map(|guest| guest.read(&mut bytes).ok());
            count.fetch_add(read.sum(), Ordering::Relaxed);
            std::thread::sleep(Duration::from_millis(5));
        }
        guests.len()
    });
    let mut app = app(RerunPlugin::viewer().with_viewer_port(port).with_spawn(false).with_queue(1000));
    // HTTP/2 begins with 24 fixed bytes. More bytes show that the connection is established and is
    // not tried again.
    until("it is streamed to", || {
        let streams = |_: &RerunStats| taken.load(Ordering::Relaxed) > 24;
        update_to(&mut app, streams).map_err(|stats| (stats, taken.load(Ordering::Relaxed)))
    });
    assert_eq!(app.world().resource::<RerunStats>().sinks, 1, "it is there");
    drop(close);
    assert!(viewer.join().unwrap() >= 2, "asked for, and streamed to");
    until("it is gone", || update_to(&mut app, |stats| stats.sinks == 0));
    let collected = app.world().resource::<RerunStats>().collected;
    (0..20).for_each(|_| app.update());
    assert_eq!(app.world().resource::<RerunStats>().collected, collected, "nothing is collected for nobody");
}

#[cfg(target_os = "linux")]
#[test]
fn the_threads_of_a_recording_give_way() {
    // In `id (name) state ppid ...` the 19th field is the nice value.
    let of = |stat: &str| stat.rsplit(')').next()?.split_whitespace().nth(16)?.parse::<i32>().ok();
    let own = of(&std::fs::read_to_string("/proc/self/stat").unwrap()).unwrap();
    let path = scratch("nice");
    let mut app = app(RerunPlugin::file(&path));
    // The worker makes the SDK's thread that writes the file.
    let nice = until("a thread that writes the file", || {
        app.update();
        let threads = std::fs::read_dir("/proc/self/task").unwrap().flatten();
        let stats = threads.filter_map(|thread| std::fs::read_to_string(thread.path().join("stat")).ok());
        let (writers, others): (Vec<_>, Vec<_>) = stats.partition(|stat| stat.contains("(file_writer)"));
        if writers.is_empty() { Err(others) } else { Ok(writers) }
    });
    // If the test process itself has a nice value above 9, any value of 9 or more is right.
    let right = |nice| if own <= 9 { nice == 9 } else { nice >= 9 };
    assert!(nice.iter().all(|stat| of(stat).is_some_and(right)), "{nice:?}");
    drop(app);
    std::fs::remove_file(path).unwrap();
}

#[test]
fn what_the_app_logs_is_a_line_but_for_what_the_recorder_says_of_itself() {
    let (lines, taken) = bounded(3);
    subscriber::with_default(registry().with(Lines(lines)), || {
        info!(target: "game", points = 3, "half time");
        debug!(target: "game", "chatter");
        warn!(target: "re_sdk", "about itself");
        warn!(target: "game", "low on time");
        (0..10).for_each(|_| info!(target: "game", "flood"));
    });
    let lines: Vec<(bool, String)> = taken.try_iter().map(|line| (line.warning, line.text)).collect();
    let expected = [(false, "game: half time points=3"), (true, "game: low on time"), (false, "game: flood")];
    assert_eq!(lines, expected.map(|(warning, text)| (warning, text.to_owned())));
}

#[test]
fn recordings_of_many_runs_stay_within_the_budget_of_their_folder() {
    let folder = scratch("folder").with_extension("");
    std::fs::remove_dir_all(&folder).ok();
    let files = || {
        let entries = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap());
        let mut files: Vec<_> = entries.map(|file| (file.path(), file.metadata().unwrap().len())).collect();
        files.sort();
        files
    };
    let run = |budget, until_it: &dyn Fn(&RerunStats) -> bool| {
        let mut app = app(RerunPlugin::file(folder.join("")).with_folder_budget(budget));
        until("what this run is for", || update_to(&mut app, until_it));
        *app.world().resource::<RerunStats>()
    };
    // Two runs within the budget, each with a file of its own.
    for _ in 0..2 {
        assert_eq!(run(1 << 30, &|stats| stats.collected > 80).removed, 0);
    }
    let two = files();
    assert!(two.len() == 2 && two.iter().all(|(_, bytes)| *bytes > 1000), "{two:?}");
    std::fs::write(folder.join("mine.rrd"), [0; 100_000]).unwrap();
    // A third run has no room for the first.
    let stats = run(two[1].1 + 60_000, &|stats| stats.removed > 0 && stats.collected > 80);
    println!("{two:?}: {} removed", stats.removed);
    let mut kept: Vec<_> = files().into_iter().map(|(path, _)| path).collect();
    assert!(kept.contains(&folder.join("mine.rrd")), "files of others stay: {kept:?}");
    kept.retain(|path| *path != folder.join("mine.rrd"));
    assert!(!kept.contains(&two[0].0) && kept.len() as u64 <= 3 - stats.removed, "{kept:?}");
    assert!(kept.iter().any(|path| *path > two[1].0), "its own stays: {kept:?}");
    // A run that has no room alone ends, and its file is whole.
    let stats = run(20_000, &|stats| stats.sinks == 0 && stats.collected > 0);
    assert_eq!(stats.removed, kept.len() as u64);
    let left = files();
    assert_eq!(left.len(), 2, "its own and that of another: {left:?}");
    assert!(is_whole(&left[1].0), "{left:?}");
    std::fs::remove_dir_all(&folder).unwrap();
}
