//! The thread that logs. It may wait for a disk or a viewer; the app never does: it offers a frame, and a full queue drops it.

use std::{
    net::{SocketAddr, TcpStream},
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bevy::log::{info, warn};
use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};
use rerun::{ApplicationId, RecordingStream, RecordingStreamBuilder, SpawnOptions};

use crate::{RerunError, blueprint::Plots, frame::Frame, recorder::Recorder};

/// How long a viewer may take to start.
const VIEWER_START: Duration = Duration::from_secs(10);

/// How long the end of an app waits for a worker: a file is written to its end; a viewer that has stopped reading is given up.
const FILE_END: Duration = Duration::from_secs(60);
const VIEWER_END: Duration = Duration::from_secs(5);

/// Where one worker's recording goes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Target {
    File(PathBuf),
    Viewer { port: u16, spawn: bool },
}

/// One worker as the app sees it.
pub(crate) struct Worker {
    frames: Option<Sender<Arc<Frame>>>,
    thread: Option<JoinHandle<()>>,
    ended: Receiver<()>,
    patience: Duration,
    dropped: Arc<AtomicU64>,
}

impl Worker {
    /// Starts a worker with room for `queue` frames. A file is created here, so that a wrong path is told at once.
    pub fn start(application: &str, target: &Target, queue: usize, plots: Plots) -> Result<Self, RerunError> {
        let id = ApplicationId::try_from(application.to_owned())
            .map_err(|_| RerunError::Application { name: application.to_owned() })?;
        let builder = RecordingStreamBuilder::new(id);
        let (frames, inbox) = bounded(queue.max(1));
        let (end, ended) = bounded(1);
        let (opened, patience) = match target.clone() {
            Target::File(path) => {
                let stream = builder
                    .save(&path)
                    .map_err(|source| RerunError::File { path: path.clone(), source: Box::new(source) })?;
                info!("recording to {}", path.display());
                (Opened::Stream(stream), FILE_END)
            }
            Target::Viewer { port, spawn } => {
                (Opened::Later { builder: Box::new(builder), port, spawn }, VIEWER_END)
            }
        };
        let thread = std::thread::Builder::new()
            .name("pliant rerun".into())
            .spawn(move || {
                match opened.stream() {
                    Some(stream) => record(&stream, &inbox, plots),
                    // Dropping the inbox tells the app that nobody listens.
                    None => drop(inbox),
                }
                drop(end);
            })
            .map_err(RerunError::Thread)?;
        Ok(Self { frames: Some(frames), thread: Some(thread), ended, patience, dropped: Arc::default() })
    }

    /// Offers a frame without waiting; `false` when it was not taken. A worker that has ended takes nothing and drops nothing.
    pub fn offer(&mut self, frame: &Arc<Frame>) -> bool {
        let Some(frames) = &self.frames else { return false };
        match frames.try_send(frame.clone()) {
            Ok(()) => true,
            Err(TrySendError::Full(_)) => {
                self.dropped.fetch_add(1, Ordering::Relaxed);
                false
            }
            Err(TrySendError::Disconnected(_)) => {
                self.frames = None;
                false
            }
        }
    }

    /// Whether anybody still listens.
    pub fn listens(&self) -> bool {
        self.frames.is_some()
    }

    /// Frames that were not taken because the queue was full.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Lets the worker log what is queued and close its recording.
    pub fn close(&mut self) {
        self.frames = None;
        let Some(thread) = self.thread.take() else { return };
        match self.ended.recv_timeout(self.patience) {
            Err(crossbeam_channel::RecvTimeoutError::Timeout) => {
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

fn record(stream: &RecordingStream, inbox: &Receiver<Arc<Frame>>, plots: Plots) {
    let mut recorder = Recorder::new(stream.clone(), plots);
    let mut failing = false;
    for frame in inbox {
        match recorder.log(&frame) {
            Ok(()) => failing = false,
            Err(error) => {
                if !failing {
                    warn!("tick {} was not recorded: {error}", frame.tick);
                }
                failing = true;
            }
        }
    }
    recorder.end();
}

enum Opened {
    Stream(RecordingStream),
    Later { builder: Box<RecordingStreamBuilder>, port: u16, spawn: bool },
}

impl Opened {
    /// A stream to something that is there. The SDK's own connection would wait for a viewer for ever, and at its end, too.
    fn stream(self) -> Option<RecordingStream> {
        let (builder, port, spawn) = match self {
            Self::Stream(stream) => return Some(stream),
            Self::Later { builder, port, spawn } => (builder, port, spawn),
        };
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
        match builder.connect_grpc_opts(format!("rerun+http://127.0.0.1:{port}/proxy")) {
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
