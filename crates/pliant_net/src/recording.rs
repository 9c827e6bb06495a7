//! A recorded session: everything that a guest received, with the times, for replay in a guest.
//!
//! The file starts with eight magic bytes. One zstd stream of records follows. Each record is a
//! `u8` kind, a `u64` time since the guest began (us), a `u32` length, and that many bytes, all
//! little-endian. The guest's own outgoing data is not recorded, because the session only depends
//! on what the guest received.

use std::collections::HashSet;
use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TrySendError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use bevy::log::{error, info, warn};
use bytes::Bytes;
use pliant_modal::{FileError, ModalModel, ModelHash};
use pliant_path::RecordingFolder;
use pliant_stream::{DisconnectReason, MAX_MESSAGE};
use thiserror::Error;

use crate::transport::Role;

const MAGIC: &[u8; 8] = b"PLIANT\x02R";
/// zstd compression level. Its cost is negligible beside a simulation step.
const LEVEL: i32 = 3;
/// Interval at which the encoder's data is flushed to the file, so that a crash loses no more than
/// this.
const FLUSH_EVERY: Duration = Duration::from_secs(1);
/// Largest recording, bytes before compression. This is about a day at 1 Mbit/s.
const MAX_BYTES: u64 = 12 << 30;
/// Longest time that the end of a recording waits for its disk.
const PATIENCE: Duration = Duration::from_secs(10);
/// Most bytes of all different models of a recording together. A guest takes no more from its host.
const MAX_MODELS: u64 = 1 << 30;
/// Longest record of a model, bytes. Every other kind of record is much shorter.
const LONGEST_MODEL: u32 = 1 << 30;
/// Bytes of a record before its data.
const HEAD: u64 = 13;
/// Largest zstd window is 2^27 bytes, so that no file makes a reader allocate more.
const WINDOW_LOG: u32 = 27;

const CONNECTED: u8 = 0;
const DATAGRAM: u8 = 1;
const MESSAGE: u8 = 2;
const MODEL: u8 = 3;
const CLOSED: u8 = 4;

/// Returns the largest number of bytes in a record of a kind. A small compressed file may announce
/// and hold any number of bytes, so that each kind has no more room than a session uses.
fn longest(kind: u8) -> u32 {
    match kind {
        CONNECTED => 3,
        DATAGRAM => u32::from(u16::MAX),
        // The session refuses longer messages.
        MESSAGE => u32::try_from(MAX_MESSAGE).unwrap_or(u32::MAX),
        MODEL => LONGEST_MODEL,
        CLOSED => 1,
        _ => 0,
    }
}

/// Bounds of a recording.
#[derive(Clone, Copy)]
struct RecordingLimits {
    /// Most bytes before compression. When a recording is written, its last record may go beyond.
    bytes: u64,
    /// Most bytes of all different models together.
    models: u64,
    /// Most bytes of all recordings in a folder together, as files.
    folder: u64,
}

impl RecordingLimits {
    const WRITTEN: Self = Self { bytes: MAX_BYTES, models: MAX_MODELS, folder: u64::MAX };
    /// Every recording within [`Self::WRITTEN`] can be read.
    const READ: Self =
        Self { bytes: MAX_BYTES + HEAD + LONGEST_MODEL as u64, models: MAX_MODELS, folder: u64::MAX };
}

/// A piece of data that the guest received.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SessionRecord {
    /// The connection is open, with this role and datagrams of at most `max_datagram` bytes.
    Connected {
        role: Role,
        max_datagram: u16,
    },
    Datagram(Bytes),
    Message(Bytes),
    /// A model from the guest's cache, as a `.modal` file.
    Model(Bytes),
    /// The connection ended.
    Closed(DisconnectReason),
}

impl SessionRecord {
    fn kind(&self) -> u8 {
        match self {
            Self::Connected { .. } => CONNECTED,
            Self::Datagram(_) => DATAGRAM,
            Self::Message(_) => MESSAGE,
            Self::Model(_) => MODEL,
            Self::Closed(_) => CLOSED,
        }
    }

    /// Size of the record's data in memory, bytes.
    fn len(&self) -> usize {
        match self {
            Self::Connected { .. } | Self::Closed(_) => 0,
            Self::Datagram(bytes) | Self::Message(bytes) | Self::Model(bytes) => bytes.len(),
        }
    }
}

/// Why a recording cannot be made or played.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file is not a recording of this version.
    #[error("{} is no recording of a Pliant session, or one of another version", path.display())]
    Kind {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file has more data than a recording may have. A small compressed file can have any
    /// amount of it.
    #[error("{} has more than {limit} bytes, more than a session records", path.display())]
    TooLong {
        /// Path of the file.
        path: PathBuf,
        /// Largest number of bytes.
        limit: u64,
    },
    /// The different models in the file are too large together to be kept.
    #[error("the models in {} have more than {limit} bytes together", path.display())]
    ModelsTooLarge {
        /// Path of the file.
        path: PathBuf,
        /// Largest number of bytes.
        limit: u64,
    },
}

type Encoder = zstd::stream::write::Encoder<'static, File>;

/// Most records, and most bytes in them, that may wait for the recorder's thread. Models are not
/// counted, because they are in memory anyway.
const MAX_WAITING: usize = 8192;
const MAX_WAITING_BYTES: usize = 64 << 20;

/// Data for the recorder's thread.
enum KeptRecord {
    Record(SessionRecord),
    /// A model, which the recorder's thread encodes as a file.
    Model(Arc<ModalModel>),
}

/// Writes a recording on its own thread, so that no frame waits for a disk. The file is complete
/// when the recorder is dropped, unless the disk takes longer than [`PATIENCE`]. If the process is
/// killed, about the last second is missing.
pub(crate) struct SessionRecorder {
    /// `None` after a failure.
    to: Option<SyncSender<(Duration, KeptRecord)>>,
    waiting: Arc<AtomicUsize>,
    thread: Option<JoinHandle<()>>,
    /// In a mutex, because resources are shared between threads.
    ended: Mutex<Receiver<()>>,
    patience: Duration,
    path: PathBuf,
}

/// The recorder's state on its thread.
struct RecordWriter {
    encoder: Encoder,
    waiting: Arc<AtomicUsize>,
    written: u64,
    /// Models that are in the file. A replay needs each only once, however many bodies have it.
    models: HashSet<ModelHash>,
    model_bytes: u64,
    limits: RecordingLimits,
    /// The folder of the recording, if one was named.
    folder: Option<RecordingFolder>,
    flushed: Duration,
}

impl SessionRecorder {
    /// Records to a file, or to a new file of a folder, whose recordings have at most `budget`
    /// bytes together.
    pub(crate) fn create(path: &Path, budget: u64) -> Result<Self, RecordingError> {
        Self::limited(path, RecordingLimits { folder: budget, ..RecordingLimits::WRITTEN })
    }

    fn limited(path: &Path, limits: RecordingLimits) -> Result<Self, RecordingError> {
        let fail = |source| RecordingError::File { path: path.to_owned(), source };
        let is_folder = RecordingFolder::is_named_by(path);
        let folder = is_folder.then(|| RecordingFolder {
            path: path.to_owned(),
            extension: "pliant",
            magic: MAGIC,
            budget: limits.folder,
        });
        let (path, mut file) = match &folder {
            Some(folder) => folder.create().map_err(fail)?,
            None => (path.to_owned(), File::create(path).map_err(fail)?),
        };
        file.write_all(MAGIC).map_err(fail)?;
        let encoder = zstd::stream::write::Encoder::new(file, LEVEL).map_err(fail)?;
        let waiting = Arc::new(AtomicUsize::new(0));
        let (to, from) = mpsc::sync_channel(MAX_WAITING);
        let (end, ended) = mpsc::channel();
        let mut writer = RecordWriter {
            encoder,
            waiting: waiting.clone(),
            written: 0,
            models: HashSet::new(),
            model_bytes: 0,
            limits,
            folder,
            flushed: Duration::ZERO,
        };
        let named = path.clone();
        let write = move || {
            if let Err(error) = writer.write_all(&from) {
                // A failed recording must not end the session.
                error!("{}: {error}; the recording ends here", named.display());
            }
            drop(end);
        };
        let thread = std::thread::Builder::new().name("pliant-record".into()).spawn(write).map_err(fail)?;
        Ok(Self {
            to: Some(to),
            waiting,
            thread: Some(thread),
            ended: Mutex::new(ended),
            patience: PATIENCE,
            path,
        })
    }

    pub(crate) fn put(&mut self, at: Duration, record: &SessionRecord) {
        self.send(at, record.len(), KeptRecord::Record(record.clone()));
    }

    /// Records a model of the guest's cache, which the host never sends.
    pub(crate) fn put_model(&mut self, at: Duration, model: &Arc<ModalModel>) {
        self.send(at, 0, KeptRecord::Model(model.clone()));
    }

    fn send(&mut self, at: Duration, bytes: usize, kept: KeptRecord) {
        let Some(to) = &self.to else { return };
        let waiting = self.waiting.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let full = waiting > MAX_WAITING_BYTES && bytes < waiting;
        let sent = if full { Err(TrySendError::Full((at, kept))) } else { to.try_send((at, kept)) };
        match sent {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => {
                error!("{}: the disk does not keep up; the recording ends here", self.path.display());
                self.to = None;
            }
            // The thread has logged the error.
            Err(TrySendError::Disconnected(_)) => self.to = None,
        }
    }
}

impl RecordWriter {
    fn write_all(&mut self, from: &Receiver<(Duration, KeptRecord)>) -> io::Result<()> {
        for (at, kept) in from {
            let record = match kept {
                KeptRecord::Record(record) => {
                    self.waiting.fetch_sub(record.len(), Ordering::Relaxed);
                    record
                }
                KeptRecord::Model(model) if !self.models.insert(model.hash()) => continue,
                KeptRecord::Model(model) => {
                    let bytes = model.to_bytes();
                    self.model_bytes += bytes.len() as u64;
                    SessionRecord::Model(bytes.into())
                }
            };
            let mut room = self.room(&record);
            if room.is_ok() {
                self.written += write(&mut self.encoder, at, &record)?;
                if at.saturating_sub(self.flushed) >= FLUSH_EVERY {
                    self.flushed = at;
                    self.encoder.flush()?;
                    room = self.room_in_folder();
                }
            }
            if let Err(error) = room {
                // What was recorded so far stays a whole recording.
                self.encoder.do_finish()?;
                return Err(error);
            }
        }
        self.encoder.do_finish()?;
        self.room_in_folder()
    }

    /// Removes the oldest recordings of the folder if all have too many bytes.
    ///
    /// # Errors
    /// An error if none can be removed.
    fn room_in_folder(&self) -> io::Result<()> {
        let Some(folder) = &self.folder else { return Ok(()) };
        // A folder that cannot be read now is asked again.
        let Ok(room) = folder.make_room() else { return Ok(()) };
        let budget = folder.budget;
        for old in &room.removed {
            info!("{} was removed: the recordings had more than {budget} bytes together", old.display());
        }
        if room.is_enough {
            return Ok(());
        }
        Err(io::Error::other(format!("recordings of {} bytes are left where {budget} may be", room.bytes)))
    }

    /// Checks that a reader will accept the recording with one more record.
    fn room(&self, record: &SessionRecord) -> io::Result<()> {
        let RecordingLimits { bytes, models, .. } = self.limits;
        if self.written >= bytes {
            return Err(io::Error::other(format!("more than {bytes} bytes")));
        }
        if self.model_bytes > models {
            return Err(io::Error::other(format!("more than {models} bytes of models")));
        }
        let longest = longest(record.kind());
        if record.len() as u64 > u64::from(longest) {
            return Err(io::Error::other(format!("a record of more than {longest} bytes")));
        }
        Ok(())
    }
}

impl Drop for SessionRecorder {
    fn drop(&mut self) {
        self.to = None;
        let Some(thread) = self.thread.take() else { return };
        let ended = self.ended.get_mut().unwrap_or_else(PoisonError::into_inner);
        if ended.recv_timeout(self.patience) == Err(RecvTimeoutError::Timeout) {
            let patience = self.patience.as_secs();
            warn!("{}: the disk took more than {patience} s; the recording is given up", self.path.display());
            return;
        }
        // A panic of that thread has been reported there.
        let _ = thread.join();
    }
}

fn write(to: &mut impl Write, at: Duration, record: &SessionRecord) -> io::Result<u64> {
    let (connected, closed);
    let bytes: &[u8] = match record {
        SessionRecord::Connected { role, max_datagram } => {
            let [low, high] = max_datagram.to_le_bytes();
            connected = [role.to_byte(), low, high];
            &connected
        }
        SessionRecord::Datagram(bytes) | SessionRecord::Message(bytes) | SessionRecord::Model(bytes) => bytes,
        SessionRecord::Closed(reason) => {
            closed = [reason.code()];
            &closed
        }
    };
    let length = u32::try_from(bytes.len()).map_err(io::Error::other)?;
    to.write_all(&[record.kind()])?;
    to.write_all(&u64::try_from(at.as_micros()).unwrap_or(u64::MAX).to_le_bytes())?;
    to.write_all(&length.to_le_bytes())?;
    to.write_all(bytes)?;
    Ok(HEAD + u64::from(length))
}

/// Decompresses no more than one byte beyond the limit, and has no byte left if there was more.
type Decoder = io::Take<zstd::stream::read::Decoder<'static, BufReader<File>>>;

/// A recorded session, to be played with [`NetPlugin::replay`](crate::NetPlugin::replay).
pub struct SessionRecording {
    decoder: Decoder,
    /// Models that the recorded guest had in its cache.
    pub(crate) models: Vec<Arc<ModalModel>>,
    next: Option<(Duration, SessionRecord)>,
}

impl SessionRecording {
    /// Opens a recording. Reads the whole file once, to find its models.
    ///
    /// # Errors
    /// [`RecordingError`] when the file cannot be read, is not a recording of this version, or has
    /// more data or larger models than a recording may have. A truncated file is not an error: it
    /// is played as far as it goes.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, RecordingError> {
        Self::limited(path.as_ref(), RecordingLimits::READ)
    }

    fn limited(path: &Path, limits: RecordingLimits) -> Result<Self, RecordingError> {
        let mut first = open(path, limits)?;
        let mut models = Vec::new();
        let (mut known, mut room) = (HashSet::new(), limits.models);
        let mut unread: Option<FileError> = None;
        while let Some((_, record)) = read(&mut first) {
            let SessionRecord::Model(bytes) = record else { continue };
            match ModalModel::from_bytes(&bytes) {
                // A file from anyone may repeat one model any number of times.
                Ok(model) if known.insert(model.hash()) => {
                    room = room.checked_sub(bytes.len() as u64).ok_or_else(|| {
                        RecordingError::ModelsTooLarge { path: path.to_owned(), limit: limits.models }
                    })?;
                    models.push(Arc::new(model));
                }
                Ok(_) => {}
                Err(error) => {
                    unread.get_or_insert(error);
                }
            }
        }
        if first.limit() == 0 {
            return Err(RecordingError::TooLong { path: path.to_owned(), limit: limits.bytes });
        }
        // One line for all of them, because a small file may have millions.
        if let Some(error) = unread {
            warn!("a model in {} cannot be read: {error}", path.display());
        }
        let mut decoder = open(path, limits)?;
        let next = read_played(&mut decoder);
        Ok(Self { decoder, models, next })
    }

    /// Returns the next record that was received up to `now`, and never a model. Call it repeatedly
    /// to get all of them.
    pub(crate) fn poll(&mut self, now: Duration) -> Option<(Duration, SessionRecord)> {
        if self.next.as_ref()?.0 > now {
            return None;
        }
        let due = self.next.take();
        self.next = read_played(&mut self.decoder);
        due
    }

    /// Returns whether everything has been played.
    pub(crate) fn is_over(&self) -> bool {
        self.next.is_none()
    }
}

fn open(path: &Path, limits: RecordingLimits) -> Result<Decoder, RecordingError> {
    let fail = |source| RecordingError::File { path: path.to_owned(), source };
    let mut file = File::open(path).map_err(fail)?;
    let mut magic = [0; 8];
    if file.read_exact(&mut magic).is_err() || &magic != MAGIC {
        return Err(RecordingError::Kind { path: path.to_owned() });
    }
    let mut decoder = zstd::stream::read::Decoder::new(file).map_err(fail)?;
    decoder.window_log_max(WINDOW_LOG).map_err(fail)?;
    Ok(decoder.take(limits.bytes.saturating_add(1)))
}

/// Reads the next record that is not a model. The caller gets no models, because skipping them one
/// by one there costs stack.
fn read_played(from: &mut impl Read) -> Option<(Duration, SessionRecord)> {
    loop {
        match read(from)? {
            (_, SessionRecord::Model(_)) => {}
            played => return Some(played),
        }
    }
}

/// Reads the next record. Returns `None` at the end of the file and at the first truncated or
/// invalid record.
fn read(from: &mut impl Read) -> Option<(Duration, SessionRecord)> {
    let mut head = [0; HEAD as usize];
    from.read_exact(&mut head).ok()?;
    let [kind, rest @ ..] = head;
    let (time, length) = rest.split_first_chunk::<8>()?;
    let at = Duration::from_micros(u64::from_le_bytes(*time));
    let length = u32::from_le_bytes(length.try_into().ok()?);
    if length > longest(kind) {
        return None;
    }
    // Memory grows with the bytes that are present, not with the announced length.
    let mut bytes = Vec::new();
    from.by_ref().take(u64::from(length)).read_to_end(&mut bytes).ok()?;
    if bytes.len() != length as usize {
        return None;
    }
    let record = match kind {
        CONNECTED => {
            let [role, low, high] = bytes.try_into().ok()?;
            SessionRecord::Connected {
                role: Role::from_byte(role)?,
                max_datagram: u16::from_le_bytes([low, high]),
            }
        }
        DATAGRAM => SessionRecord::Datagram(bytes.into()),
        MESSAGE => SessionRecord::Message(bytes.into()),
        MODEL => SessionRecord::Model(bytes.into()),
        CLOSED => {
            let [code] = bytes.try_into().ok()?;
            SessionRecord::Closed(DisconnectReason::from_code(code)?)
        }
        _ => return None,
    };
    Some((at, record))
}

#[cfg(test)]
mod tests;
