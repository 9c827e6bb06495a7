//! The worker thread that logs.
//!
//! The worker may wait for a disk or a viewer. The app never waits: it offers a frame, and a full
//! queue drops the frame.

use std::{
    any::Any,
    fs::File,
    net::{SocketAddr, TcpStream},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use bevy::{
    log::{debug, error, info, warn},
    platform::time::Instant,
};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use pliant_path::RecordingFolder;
use rerun::{
    ApplicationId, RecordingStream, RecordingStreamBuilder, RecordingStreamError, SpawnOptions,
    log::ChunkBatcherConfig,
    sink::{GrpcSink, GrpcSinkConnectionState, LogSink},
};

use crate::{
    RerunError,
    blueprint::Plots,
    frame::{Drawn, Owed, RecordedFrame},
    queue::{FrameReceiver, FrameSender, Refused, queue},
    recorder::Recorder,
};

/// Time that a viewer may take to start.
const VIEWER_START: Duration = Duration::from_secs(10);

/// Time that the end of an app waits for a worker. A file may take long until it is complete. A
/// viewer that does not read is abandoned sooner.
const FILE_END: Duration = Duration::from_secs(60);
const VIEWER_END: Duration = Duration::from_secs(5);

/// The destination of one worker's recording.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Target {
    /// A file or a folder, the size at which the recording ends, and the size of all recordings in
    /// the folder together, bytes.
    File {
        path: PathBuf,
        limit: u64,
        budget: u64,
    },
    Viewer {
        port: u16,
        spawn: bool,
    },
}

/// Time for which ticks gather before a worker logs them, so that it wakes a few times per second
/// and not in every tick.
const PAUSE: Duration = Duration::from_millis(100);

/// Interval at which metrics are sent. A viewer shows them as they arrive. In a file, fewer and
/// longer columns are smaller.
const VIEWER_COLUMNS: Duration = Duration::from_millis(90);
const FILE_COLUMNS: Duration = Duration::from_millis(500);

/// Interval of the checks whether the viewer is still connected.
const WATCH: Duration = Duration::from_secs(1);

/// Interval of the looks at the size of a file.
const MEASURE: Duration = Duration::from_millis(500);

/// First bytes of each file that the SDK writes.
const FILE_MAGIC: &[u8] = b"RRF2";

/// One tick for a worker.
pub(crate) struct Message {
    pub frame: Arc<RecordedFrame>,
    pub owed: Option<Owed>,
}

/// The app's handle of a worker.
pub(crate) struct Worker {
    frames: FrameSender<Message>,
    thread: Option<JoinHandle<()>>,
    ended: Receiver<()>,
    patience: Duration,
    owed: Option<Owed>,
    /// Number of older recordings that were removed.
    removed: Arc<AtomicU64>,
}

/// The file of a recording, and what bounds it.
struct RecordedFile {
    path: PathBuf,
    limit: u64,
    /// The folder, if one was named, and the file, which is locked while it is open here.
    folder: Option<(RecordingFolder, File)>,
    removed: Arc<AtomicU64>,
}

impl RecordedFile {
    fn create(path: &Path, limit: u64, budget: u64, removed: &Arc<AtomicU64>) -> Result<Self, RerunError> {
        let fail = |source| RerunError::File { path: path.to_owned(), source };
        let removed = removed.clone();
        if !RecordingFolder::is_named_by(path) {
            File::create(path).map_err(fail)?;
            return Ok(Self { path: path.to_owned(), limit, folder: None, removed });
        }
        let folder = RecordingFolder { path: path.to_owned(), extension: "rrd", magic: FILE_MAGIC, budget };
        let (path, file) = folder.create().map_err(fail)?;
        Ok(Self { path, limit, folder: Some((folder, file)), removed })
    }

    /// Returns why the recording must end here, if it must. Removes older ones before that.
    fn full(&self) -> Option<String> {
        let Self { path, limit, folder, removed } = self;
        if std::fs::metadata(path).is_ok_and(|file| file.len() >= *limit) {
            return Some(format!("it has reached its limit of {limit} bytes"));
        }
        let (folder, _) = folder.as_ref()?;
        // A folder that cannot be read now is asked again.
        let room = folder.make_room().ok()?;
        for old in &room.removed {
            removed.fetch_add(1, Ordering::Relaxed);
            let budget = folder.budget;
            info!("{} was removed: the recordings had more than {budget} bytes together", old.display());
        }
        let (bytes, budget) = (room.bytes, folder.budget);
        (!room.is_enough).then(|| format!("recordings of {bytes} bytes are left where {budget} may be"))
    }
}

impl Worker {
    /// Starts a worker with room for `room` frames.
    ///
    /// The file is created here, so that a wrong path is reported at once. Logged frames go to
    /// `spare`, so that their memory is reused.
    pub fn start(
        application: &str,
        target: &Target,
        room: usize,
        plots: Plots,
        spare: Sender<RecordedFrame>,
    ) -> Result<Self, RerunError> {
        let id = ApplicationId::try_from(application.to_owned())
            .map_err(|_| RerunError::Application { name: application.to_owned() })?;
        let builder = RecordingStreamBuilder::new(id);
        let (frames, inbox) = queue(room);
        let (end, ended) = bounded(1);
        let removed = Arc::default();
        let (patience, file) = match target {
            Target::File { path, limit, budget } => {
                let file = RecordedFile::create(path, *limit, *budget, &removed)?;
                info!("recording to {}", file.path.display());
                (FILE_END, Some(file))
            }
            Target::Viewer { .. } => (VIEWER_END, None),
        };
        let target = target.clone();
        let thread = std::thread::Builder::new()
            .name("pliant rerun".into())
            .spawn(move || {
                // This comes before the stream starts its threads, so that they inherit the
                // priority.
                give_way();
                match target.open(builder, file.as_ref()) {
                    Some(stream) => record(&stream, &target, file.as_ref(), (inbox, &spare), plots),
                    // Dropping the inbox shows the app that the sink is closed.
                    None => drop(inbox),
                }
                drop(end);
            })
            .map_err(RerunError::Thread)?;
        Ok(Self { frames, thread: Some(thread), ended, patience, owed: None, removed })
    }

    /// Returns a worker whose frames a test receives.
    #[cfg(test)]
    pub fn held(room: usize) -> (Self, FrameReceiver<Message>) {
        let (frames, inbox) = queue(room);
        let (_, ended) = bounded(1);
        let removed = Arc::default();
        (Self { frames, thread: None, ended, patience: Duration::ZERO, owed: None, removed }, inbox)
    }

    /// Whether the thread has ended by itself, so that closing does not wait.
    #[cfg(test)]
    pub fn has_ended(&self) -> bool {
        self.ended.try_recv() == Err(crossbeam_channel::TryRecvError::Disconnected)
    }

    /// Offers a frame without waiting. Returns `false` if the frame was not accepted.
    ///
    /// A worker that has ended accepts and drops nothing. A worker that missed something also gets
    /// the list of all bodies from `bodies`.
    pub fn offer(&mut self, frame: &Arc<RecordedFrame>, bodies: impl FnOnce() -> Vec<Arc<Drawn>>) -> bool {
        if self.frames.is_closed() {
            return false;
        }
        let owed = self.owed.take().map(|owed| Owed { bodies: bodies(), ..owed });
        match self.frames.offer(Message { frame: frame.clone(), owed }) {
            Ok(()) => true,
            Err(Refused::Full(Message { owed, .. })) => {
                let mut owed = owed.unwrap_or_default();
                owed.add(frame);
                self.owed = Some(owed);
                false
            }
            Err(Refused::Closed) => false,
        }
    }

    /// Whether a frame would not be accepted.
    pub fn is_full(&self) -> bool {
        self.frames.is_full()
    }

    /// Counts a frame that was not made because all queues were full.
    pub fn miss(&mut self) {
        if !self.frames.is_closed() {
            self.frames.miss();
            self.owed.get_or_insert_default();
        }
    }

    /// Whether the sink is still open.
    pub fn listens(&self) -> bool {
        !self.frames.is_closed()
    }

    /// Returns the number of frames dropped because the queue was full.
    pub fn dropped(&self) -> u64 {
        self.frames.dropped()
    }

    /// Returns the number of older recordings that were removed for this one.
    pub fn removed(&self) -> u64 {
        self.removed.load(Ordering::Relaxed)
    }

    /// Lets the worker log the queued frames and close its recording.
    pub fn close(&mut self) {
        self.frames.close();
        let Some(thread) = self.thread.take() else { return };
        match self.ended.recv_timeout(self.patience) {
            Err(RecvTimeoutError::Timeout) => {
                warn!("a recording did not end in {} s and is given up", self.patience.as_secs());
            }
            _ => {
                if thread.join().is_err() {
                    warn!("the recording worker panicked; the recording may be incomplete");
                }
            }
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.close();
    }
}

/// Lowers the priority of this thread, because frames of the app are more urgent.
///
/// On Linux, threads started by this thread inherit the priority. The policy is not `SCHED_IDLE`:
/// on a machine that is always busy the recording would then never end.
fn give_way() {
    use thread_priority::{ThreadPriority, ThreadPriorityValue};
    // The value is a quarter of the range, which is a nice value of 9 on Linux.
    let Ok(priority) = ThreadPriorityValue::try_from(25_u8).map(ThreadPriority::Crossplatform) else {
        return;
    };
    #[cfg(target_os = "linux")]
    let result = {
        use thread_priority::{
            NormalThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy,
            thread_native_id,
        };
        // A batch thread that wakes up does not preempt another thread.
        let policy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Batch);
        set_thread_priority_and_policy(thread_native_id(), priority, policy)
    };
    #[cfg(not(target_os = "linux"))]
    let result = priority.set_for_current();
    if let Err(error) = result {
        debug!("the recording thread keeps its priority: {error:?}");
    }
}

/// Logs until the app ends or the viewer is closed. The function owns the inbox: dropping the inbox
/// shows the app that the sink is closed.
fn record(
    stream: &RecordingStream,
    target: &Target,
    file: Option<&RecordedFile>,
    (inbox, spare): (FrameReceiver<Message>, &Sender<RecordedFrame>),
    plots: Plots,
) {
    let mut recorder = Recorder::new(stream.clone(), plots);
    let mut failing = false;
    let (mut sent, mut watched, mut measured) = (Instant::now(), Instant::now(), Instant::now());
    let lost = Arc::new(AtomicBool::new(false));
    let columns = if file.is_some() { FILE_COLUMNS } else { VIEWER_COLUMNS };
    loop {
        let (goes_on, frames) = inbox.wait(PAUSE);
        for Message { frame, owed } in frames {
            let mut logged = owed.map_or(Ok(()), |owed| recorder.catch_up(&frame, &owed));
            logged = logged.and(recorder.log(&frame));
            warn_once(logged, frame.tick, &mut failing);
            if let Some(frame) = Arc::into_inner(frame) {
                // If there is no room, enough spare frames are waiting.
                spare.try_send(frame.cleared()).ok();
            }
            // The SDK accepts data for a closed viewer, so the connection must be checked. The
            // check also runs between ticks, because many ticks may wait.
            if let Target::Viewer { port, .. } = target
                && watched.elapsed() >= WATCH
            {
                watched = Instant::now();
                let seen = lost.clone();
                stream.inspect_sink(move |sink| seen.store(is_lost(sink), Ordering::Relaxed));
                if lost.load(Ordering::Relaxed) {
                    info!("the rerun viewer on port {port} was closed: going on without it");
                    // The app is notified before the SDK cleans up.
                    drop(inbox);
                    return;
                }
            }
        }
        if !goes_on {
            break;
        }
        if let Some(file) = file
            && measured.elapsed() >= MEASURE
        {
            measured = Instant::now();
            if let Some(reason) = file.full() {
                warn!("{}: {reason}, so that the recording ends here", file.path.display());
                // The app is notified before the SDK closes the file.
                drop(inbox);
                recorder.end();
                return;
            }
        }
        if sent.elapsed() >= columns {
            sent = Instant::now();
            warn_once(recorder.send(), 0, &mut failing);
        }
    }
    recorder.end();
}

fn warn_once(logged: Result<(), RecordingStreamError>, tick: u64, failing: &mut bool) {
    if let Err(error) = &logged
        && !*failing
    {
        warn!("tick {tick} was not recorded: {error}");
    }
    *failing = logged.is_err();
}

fn is_lost(sink: &dyn LogSink) -> bool {
    let sink: &dyn Any = sink;
    sink.downcast_ref::<GrpcSink>()
        .is_some_and(|sink| matches!(sink.status(), GrpcSinkConnectionState::Disconnected(_)))
}

impl Target {
    /// Opens a stream to an existing destination. The SDK's own connection would wait for a viewer
    /// forever, also at its end.
    fn open(&self, builder: RecordingStreamBuilder, file: Option<&RecordedFile>) -> Option<RecordingStream> {
        if let Some(RecordedFile { path, .. }) = file {
            let stream = builder.save(path);
            return stream.inspect_err(|error| error!("cannot record to {}: {error}", path.display())).ok();
        }
        let &Self::Viewer { port, spawn } = self else { return None };
        if !listens(port) {
            if !spawn {
                info!("no rerun viewer on port {port}: going on without one");
                return None;
            }
            let options = SpawnOptions { port, ..SpawnOptions::default() };
            if let Err(error) = rerun::spawn(&options) {
                info!("no rerun viewer could be started ({error}): going on without one");
                return None;
            }
            let start = Instant::now();
            while !listens(port) {
                if start.elapsed() > VIEWER_START {
                    info!(
                        "the rerun viewer did not start in {} s: going on without one",
                        VIEWER_START.as_secs()
                    );
                    return None;
                }
                std::thread::sleep(Duration::from_millis(100));
            }
        }
        // The SDK's default is to flush its rows every 8 ms.
        match builder
            .batcher_config(ChunkBatcherConfig { flush_tick: PAUSE, ..ChunkBatcherConfig::DEFAULT })
            .connect_grpc_opts(format!("rerun+http://127.0.0.1:{port}/proxy"))
        {
            Ok(stream) => {
                info!("streaming to the rerun viewer on port {port}");
                Some(stream)
            }
            Err(error) => {
                warn!("the rerun viewer on port {port} cannot be streamed to: {error}");
                None
            }
        }
    }
}

fn listens(port: u16) -> bool {
    let address = SocketAddr::from(([127, 0, 0, 1], port));
    TcpStream::connect_timeout(&address, Duration::from_millis(200)).is_ok()
}
