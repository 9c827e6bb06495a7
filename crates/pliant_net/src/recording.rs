//! A recorded session: everything that a guest received, with the times, for replay in a guest.
//!
//! The file starts with eight magic bytes. One zstd stream of records follows. Each record is a
//! `u8` kind, a `u64` time since the guest began (us), a `u32` length, and that many bytes, all
//! little-endian. The guest's own outgoing data is not recorded, because the session only depends
//! on what the guest received.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TrySendError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use bevy::log::{error, warn};
use bytes::Bytes;
use pliant_modal::ModalModel;
use pliant_stream::DisconnectReason;
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
/// Largest record, bytes. The largest records are models.
const LONGEST: u32 = 1 << 30;
/// Largest zstd window is 2^27 bytes, so that no file makes a reader allocate more.
const WINDOW_LOG: u32 = 27;

const CONNECTED: u8 = 0;
const DATAGRAM: u8 = 1;
const MESSAGE: u8 = 2;
const MODEL: u8 = 3;
const CLOSED: u8 = 4;

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
    /// Largest recording, bytes before compression.
    most: u64,
    flushed: Duration,
}

impl SessionRecorder {
    pub(crate) fn create(path: &Path) -> Result<Self, RecordingError> {
        Self::limited(path, MAX_BYTES)
    }

    fn limited(path: &Path, most: u64) -> Result<Self, RecordingError> {
        let fail = |source| RecordingError::File { path: path.to_owned(), source };
        let mut file = File::create(path).map_err(fail)?;
        file.write_all(MAGIC).map_err(fail)?;
        let encoder = zstd::stream::write::Encoder::new(file, LEVEL).map_err(fail)?;
        let waiting = Arc::new(AtomicUsize::new(0));
        let (to, from) = mpsc::sync_channel(MAX_WAITING);
        let (end, ended) = mpsc::channel();
        let flushed = Duration::ZERO;
        let mut writer = RecordWriter { encoder, waiting: waiting.clone(), written: 0, most, flushed };
        let named = path.to_owned();
        let write = move || {
            if let Err(error) = writer.write_all(&from) {
                // A failed recording must not end the session.
                error!("{}: {error}; the recording ends here", named.display());
            }
            drop(end);
        };
        let thread = std::thread::Builder::new().name("pliant-record".into()).spawn(write).map_err(fail)?;
        let path = path.to_owned();
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
                KeptRecord::Model(model) => SessionRecord::Model(model.to_bytes().into()),
            };
            if self.written >= self.most {
                self.encoder.do_finish()?;
                return Err(io::Error::other(format!("more than {} bytes", self.most)));
            }
            self.written += write(&mut self.encoder, at, &record)?;
            if at.saturating_sub(self.flushed) >= FLUSH_EVERY {
                self.flushed = at;
                self.encoder.flush()?;
            }
        }
        self.encoder.do_finish()
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
    let (kind, bytes): (u8, &[u8]) = match record {
        SessionRecord::Connected { role, max_datagram } => {
            let [low, high] = max_datagram.to_le_bytes();
            connected = [role.to_byte(), low, high];
            (CONNECTED, &connected)
        }
        SessionRecord::Datagram(bytes) => (DATAGRAM, bytes),
        SessionRecord::Message(bytes) => (MESSAGE, bytes),
        SessionRecord::Model(bytes) => (MODEL, bytes),
        SessionRecord::Closed(reason) => {
            closed = [reason.code()];
            (CLOSED, &closed)
        }
    };
    let length = u32::try_from(bytes.len()).ok().filter(|length| *length <= LONGEST);
    let length = length.ok_or_else(|| io::Error::other("a record of more than a gigabyte"))?;
    to.write_all(&[kind])?;
    to.write_all(&u64::try_from(at.as_micros()).unwrap_or(u64::MAX).to_le_bytes())?;
    to.write_all(&length.to_le_bytes())?;
    to.write_all(bytes)?;
    Ok(13 + u64::from(length))
}

/// A recorded session, to be played with [`NetPlugin::replay`](crate::NetPlugin::replay).
pub struct SessionRecording {
    decoder: zstd::stream::read::Decoder<'static, BufReader<File>>,
    /// Models that the recorded guest had in its cache.
    pub(crate) models: Vec<Arc<ModalModel>>,
    next: Option<(Duration, SessionRecord)>,
}

impl SessionRecording {
    /// Opens a recording. Reads the whole file once, to find its models.
    ///
    /// # Errors
    /// [`RecordingError`] when the file cannot be read or is not a recording of this version. A
    /// truncated file is not an error: it is played as far as it goes.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, RecordingError> {
        let path = path.as_ref();
        let mut first = open(path)?;
        let mut models = Vec::new();
        while let Some((_, record)) = read(&mut first) {
            if let SessionRecord::Model(bytes) = record {
                match ModalModel::from_bytes(&bytes) {
                    Ok(model) => models.push(Arc::new(model)),
                    Err(error) => warn!("a model in {} cannot be read: {error}", path.display()),
                }
            }
        }
        let mut decoder = open(path)?;
        let next = read(&mut decoder);
        Ok(Self { decoder, models, next })
    }

    /// Returns the next record that was received up to `now`. Call it repeatedly to get all of
    /// them.
    pub(crate) fn poll(&mut self, now: Duration) -> Option<(Duration, SessionRecord)> {
        if self.next.as_ref()?.0 > now {
            return None;
        }
        let due = self.next.take();
        self.next = read(&mut self.decoder);
        due
    }

    /// Returns whether everything has been played.
    pub(crate) fn is_over(&self) -> bool {
        self.next.is_none()
    }
}

fn open(path: &Path) -> Result<zstd::stream::read::Decoder<'static, BufReader<File>>, RecordingError> {
    let fail = |source| RecordingError::File { path: path.to_owned(), source };
    let mut file = File::open(path).map_err(fail)?;
    let mut magic = [0; 8];
    if file.read_exact(&mut magic).is_err() || &magic != MAGIC {
        return Err(RecordingError::Kind { path: path.to_owned() });
    }
    let mut decoder = zstd::stream::read::Decoder::new(file).map_err(fail)?;
    decoder.window_log_max(WINDOW_LOG).map_err(fail)?;
    Ok(decoder)
}

/// Reads the next record. Returns `None` at the end of the file and at the first truncated or
/// invalid record.
fn read(from: &mut impl Read) -> Option<(Duration, SessionRecord)> {
    let mut head = [0; 13];
    from.read_exact(&mut head).ok()?;
    let [kind, rest @ ..] = head;
    let (time, length) = rest.split_first_chunk::<8>()?;
    let at = Duration::from_micros(u64::from_le_bytes(*time));
    let length = u32::from_le_bytes(length.try_into().ok()?);
    if length > LONGEST {
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
mod tests {
    use super::*;

    fn file(name: &str) -> PathBuf {
        std::env::temp_dir().join(format!("pliant-recording-{}-{name}", std::process::id()))
    }

    fn records() -> Vec<(Duration, SessionRecord)> {
        let mut records = vec![(
            Duration::from_micros(1_500),
            SessionRecord::Connected { role: Role::Watch, max_datagram: 1_162 },
        )];
        for n in 0..500u64 {
            let at = Duration::from_millis(2 + 25 * n);
            let bytes: Vec<u8> = (0..200).map(|k| (n as u8).wrapping_mul(31) ^ k).collect();
            records.push((at, SessionRecord::Datagram(bytes.clone().into())));
            if n % 50 == 0 {
                records.push((at, SessionRecord::Message(bytes.into())));
            }
        }
        records.push((Duration::from_secs(20), SessionRecord::Closed(DisconnectReason::Left)));
        records
    }

    #[test]
    fn a_recording_ends_at_its_limit_and_is_whole() {
        let path = file("limited");
        let records = records();
        let mut recorder = SessionRecorder::limited(&path, 20_000).unwrap();
        // All within a second, so that nothing was written out before the limit.
        records.iter().for_each(|(_, record)| recorder.put(Duration::from_millis(1), record));
        drop(recorder);
        let mut recording = SessionRecording::open(&path).unwrap();
        let played: Vec<_> = std::iter::from_fn(|| recording.poll(Duration::MAX)).collect();
        let bytes: usize = played.iter().map(|(_, record)| 13 + record.len()).sum();
        assert!((20_000..21_000).contains(&bytes), "{bytes} bytes in {} records", played.len());
        assert!(played.iter().zip(&records).all(|(played, record)| played.1 == record.1));
        std::fs::remove_file(&path).unwrap();
    }

    /// A pipe that nobody reads is a disk that stands still.
    #[cfg(unix)]
    #[test]
    fn a_disk_that_stands_still_holds_up_no_frame_and_no_end() {
        let path = file("pipe");
        let made = std::process::Command::new("mkfifo").arg(&path).status();
        assert!(made.is_ok_and(|status| status.success()), "mkfifo");
        let nobody = File::options().read(true).write(true).open(&path).unwrap();
        let mut recorder = SessionRecorder::create(&path).unwrap();
        recorder.patience = Duration::from_millis(100);
        let began = std::time::Instant::now();
        let (mut state, mut most) = (1_u64, 0);
        for n in 0..20_000 {
            // Bytes that do not compress, by xorshift (Marsaglia 2003).
            let noise = (0..1000).map(|_| {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                (state >> 24) as u8
            });
            recorder.put(Duration::from_millis(n), &SessionRecord::Datagram(noise.collect()));
            most = most.max(recorder.waiting.load(Ordering::Relaxed));
        }
        assert!(recorder.to.is_none(), "the recording goes on");
        assert!(most <= (MAX_WAITING + 1) * 1000, "{most} bytes wait");
        drop(recorder);
        assert!(began.elapsed() < Duration::from_secs(60), "{:?}", began.elapsed());
        // The thread finds the pipe closed, and ends.
        drop(nobody);
        std::fs::remove_file(&path).unwrap();
    }

    #[test]
    fn what_was_recorded_is_played_at_its_time_also_from_a_file_that_was_cut() {
        let path = file("whole");
        let records = records();
        let mut recorder = SessionRecorder::create(&path).unwrap();
        records.iter().for_each(|(at, record)| recorder.put(*at, record));
        drop(recorder);
        let mut recording = SessionRecording::open(&path).unwrap();
        assert_eq!(recording.poll(Duration::from_micros(1_499)), None, "not before its time");
        let mut played = Vec::new();
        for ms in 0..=20_000 {
            played.extend(std::iter::from_fn(|| recording.poll(Duration::from_millis(ms))));
        }
        assert!(played == records && recording.is_over());

        let bytes = std::fs::read(&path).unwrap();
        let raw: usize = records.len() * 213;
        assert!(bytes.len() < raw, "{} bytes of {raw}", bytes.len());
        // A truncated file is played up to the cut. A file with a corrupt byte is read without a
        // panic.
        for cut in (0..bytes.len()).step_by(97) {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            match SessionRecording::open(&path) {
                Err(RecordingError::Kind { .. }) => assert!(cut < 8),
                Err(other) => panic!("{other}"),
                Ok(mut recording) => {
                    let played: Vec<_> = std::iter::from_fn(|| recording.poll(Duration::MAX)).collect();
                    assert!(records.starts_with(&played), "cut to {cut} bytes");
                }
            }
            let mut wrong = bytes.clone();
            wrong[cut] ^= 0x55;
            std::fs::write(&path, &wrong).unwrap();
            if let Ok(mut recording) = SessionRecording::open(&path) {
                while recording.poll(Duration::MAX).is_some() {}
            }
        }
        std::fs::remove_file(&path).unwrap();
        assert!(matches!(SessionRecording::open(&path), Err(RecordingError::File { .. })));
    }
}
