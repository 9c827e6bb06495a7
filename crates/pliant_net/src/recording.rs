//! A session on disk: everything that a guest received, with its times, to be played into a guest again.
//!
//! The file is eight bytes that say what it is, then one zstd stream of records: `u8` kind, `u64` time since the guest began (us), `u32` length, and
//! so many bytes; little end first. What a guest sent is not in it: the session is one that follows, and it follows the same way again.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bevy::log::{error, warn};
use bytes::Bytes;
use pliant_modal::ModalModel;
use thiserror::Error;

use crate::transport::Role;

const MAGIC: &[u8; 8] = b"PLIANT\x01R";
/// Of zstd: fast enough to be nothing beside a step.
const LEVEL: i32 = 3;
/// What is in the encoder reaches the file so often, so that a crash costs no more.
const FLUSH_EVERY: Duration = Duration::from_secs(1);
/// A recording of a day at a megabit a second.
const MOST_BYTES: u64 = 12 << 30;
/// No record is longer: a model at most.
const LONGEST: u32 = 1 << 30;
/// zstd's window is at most 2^27 bytes: no file makes a reader take more.
const WINDOW_LOG: u32 = 27;

const CONNECTED: u8 = 0;
const DATAGRAM: u8 = 1;
const MESSAGE: u8 = 2;
const MODEL: u8 = 3;
const CLOSED: u8 = 4;

/// Something that reached the guest.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Record {
    /// The connection is open, for this role and datagrams of at most so many bytes.
    Connected {
        role: Role,
        max_datagram: u16,
    },
    Datagram(Bytes),
    Message(Bytes),
    /// A model that was in the guest's cache, as a `.modal` file.
    Model(Bytes),
    /// The connection ended, in words.
    Closed(String),
}

/// Why a recording cannot be made or played.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file is no recording of this version.
    #[error("{} is no recording of a Pliant session, or one of another version", path.display())]
    Kind {
        /// Which.
        path: PathBuf,
    },
}

type Encoder = zstd::stream::write::Encoder<'static, File>;

/// Writes a recording; it is whole when this is dropped, and but for a second when the process is killed.
pub(crate) struct Recorder {
    /// None after a failure.
    encoder: Option<Encoder>,
    path: PathBuf,
    written: u64,
    flushed: Duration,
}

impl Recorder {
    pub(crate) fn create(path: &Path) -> Result<Self, RecordingError> {
        let fail = |source| RecordingError::File { path: path.to_owned(), source };
        let mut file = File::create(path).map_err(fail)?;
        file.write_all(MAGIC).map_err(fail)?;
        let encoder = zstd::stream::write::Encoder::new(file, LEVEL).map_err(fail)?;
        Ok(Self { encoder: Some(encoder), path: path.to_owned(), written: 0, flushed: Duration::ZERO })
    }

    pub(crate) fn put(&mut self, at: Duration, record: &Record) {
        let Some(encoder) = &mut self.encoder else { return };
        let written = if self.written >= MOST_BYTES {
            Err(io::Error::other(format!("more than {MOST_BYTES} bytes")))
        } else {
            write(encoder, at, record).and_then(|bytes| {
                self.written += bytes;
                if at.saturating_sub(self.flushed) >= FLUSH_EVERY {
                    self.flushed = at;
                    encoder.flush()?;
                }
                Ok(())
            })
        };
        if let Err(error) = written {
            // The session is worth more than its recording.
            error!("{}: {error}; the recording ends here", self.path.display());
            self.encoder = None;
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if let Some(mut encoder) = self.encoder.take()
            && let Err(error) = encoder.do_finish()
        {
            error!("{}: {error}; the recording's last second is lost", self.path.display());
        }
    }
}

fn write(to: &mut impl Write, at: Duration, record: &Record) -> io::Result<u64> {
    let connected;
    let (kind, bytes): (u8, &[u8]) = match record {
        Record::Connected { role, max_datagram } => {
            let [low, high] = max_datagram.to_le_bytes();
            connected = [role.to_byte(), low, high];
            (CONNECTED, &connected)
        }
        Record::Datagram(bytes) => (DATAGRAM, bytes),
        Record::Message(bytes) => (MESSAGE, bytes),
        Record::Model(bytes) => (MODEL, bytes),
        Record::Closed(words) => (CLOSED, words.as_bytes()),
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
pub struct Recording {
    decoder: zstd::stream::read::Decoder<'static, BufReader<File>>,
    /// Models that the recorded guest had in its cache.
    pub(crate) models: Vec<Arc<ModalModel>>,
    next: Option<(Duration, Record)>,
}

impl Recording {
    /// Opens a recording. Reads it through once, for the models in it.
    ///
    /// # Errors
    /// [`RecordingError`]. A file that ends too soon is no error: it is played as far as it goes.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, RecordingError> {
        let path = path.as_ref();
        let mut first = open(path)?;
        let mut models = Vec::new();
        while let Some((_, record)) = read(&mut first) {
            if let Record::Model(bytes) = record {
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

    /// What was received up to `now`, one record a call.
    pub(crate) fn poll(&mut self, now: Duration) -> Option<(Duration, Record)> {
        if self.next.as_ref()?.0 > now {
            return None;
        }
        let due = self.next.take();
        self.next = read(&mut self.decoder);
        due
    }

    /// Everything has been played.
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

/// The next record; `None` at the end, and at the first that is cut off or makes no sense.
fn read(from: &mut impl Read) -> Option<(Duration, Record)> {
    let mut head = [0; 13];
    from.read_exact(&mut head).ok()?;
    let [kind, rest @ ..] = head;
    let (time, length) = rest.split_first_chunk::<8>()?;
    let at = Duration::from_micros(u64::from_le_bytes(*time));
    let length = u32::from_le_bytes(length.try_into().ok()?);
    if length > LONGEST {
        return None;
    }
    // Memory grows with what is there, not with what is announced.
    let mut bytes = Vec::new();
    from.by_ref().take(u64::from(length)).read_to_end(&mut bytes).ok()?;
    if bytes.len() != length as usize {
        return None;
    }
    let record = match kind {
        CONNECTED => {
            let [role, low, high] = bytes.try_into().ok()?;
            Record::Connected { role: Role::from_byte(role)?, max_datagram: u16::from_le_bytes([low, high]) }
        }
        DATAGRAM => Record::Datagram(bytes.into()),
        MESSAGE => Record::Message(bytes.into()),
        MODEL => Record::Model(bytes.into()),
        CLOSED => Record::Closed(String::from_utf8(bytes).ok()?),
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

    fn records() -> Vec<(Duration, Record)> {
        let mut records = vec![(
            Duration::from_micros(1_500),
            Record::Connected { role: Role::Watch, max_datagram: 1_162 },
        )];
        for n in 0..500u64 {
            let at = Duration::from_millis(2 + 25 * n);
            let bytes: Vec<u8> = (0..200).map(|k| (n as u8).wrapping_mul(31) ^ k).collect();
            records.push((at, Record::Datagram(bytes.clone().into())));
            if n % 50 == 0 {
                records.push((at, Record::Message(bytes.into())));
            }
        }
        records.push((Duration::from_secs(20), Record::Closed("the host has left".into())));
        records
    }

    #[test]
    fn what_was_recorded_is_played_at_its_time_also_from_a_file_that_was_cut() {
        let path = file("whole");
        let records = records();
        let mut recorder = Recorder::create(&path).unwrap();
        records.iter().for_each(|(at, record)| recorder.put(*at, record));
        drop(recorder);
        let mut recording = Recording::open(&path).unwrap();
        assert_eq!(recording.poll(Duration::from_micros(1_499)), None, "not before its time");
        let mut played = Vec::new();
        for ms in 0..=20_000 {
            played.extend(std::iter::from_fn(|| recording.poll(Duration::from_millis(ms))));
        }
        assert!(played == records && recording.is_over());

        let bytes = std::fs::read(&path).unwrap();
        let raw: usize = records.len() * 213;
        assert!(bytes.len() < raw, "{} bytes of {raw}", bytes.len());
        // Every cut, and every byte turned about, is played as far as it goes and no further.
        for cut in (0..bytes.len()).step_by(97) {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            match Recording::open(&path) {
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
            if let Ok(mut recording) = Recording::open(&path) {
                while recording.poll(Duration::MAX).is_some() {}
            }
        }
        std::fs::remove_file(&path).unwrap();
        assert!(matches!(Recording::open(&path), Err(RecordingError::File { .. })));
    }
}
