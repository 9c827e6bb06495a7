//! Recording and replay of a device's samples.
//!
//! A recording is a header (the device's info) and one fixed-size record per period. All numbers
//! are little-endian:
//!
//! ```text
//! "PLHR" | version u16 | info: length u32, postcard bytes
//! record: now f64 | dt f64 | position 3 f64 | orientation 4 f64 | velocity 3 f64 (NaN: none) | buttons u32 | sequence u64 (0: none, else + 1)
//!         | force 3 f64 | torque 3 f64
//! ```

use std::io::{self, Read, Write};

use thiserror::Error;

use crate::{DeviceInfo, Fault, HapticDevice, Record, Sample, Scheduler, Wrench};

const MAGIC: [u8; 4] = *b"PLHR";
const VERSION: u16 = 1;
const NUMBERS: usize = 18;
const RECORD: usize = NUMBERS * 8 + 4 + 8;
/// Maximum length of the info, bytes. A longer info is invalid.
const LONGEST_INFO: u32 = 64 * 1024;
/// Default size limit of a recording, bytes: 1.9 hours at 1 kHz. The same limit holds for reading,
/// because a replay keeps all records in memory.
const MAX_BYTES: u64 = 1 << 30;

/// Reason why a recording cannot be read or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The file or stream failed.
    #[error("the recording: {0}")]
    Io(#[from] io::Error),
    /// The data is not a recording.
    #[error("a recording begins with PLHR, this with {0:?}")]
    Magic([u8; 4]),
    /// The recording has another version.
    #[error("the recording has version {0}, this reads version 1")]
    Version(u16),
    /// The header's description of the device cannot be read.
    #[error("the recording's header is damaged: {0}")]
    Header(String),
    /// The recording has reached its size limit. What was written so far is a whole recording.
    #[error("the recording has reached its limit of {0} bytes")]
    Full(u64),
    /// A record has a number that is not finite, or a time that runs backwards.
    #[error("record {0} of the recording is damaged")]
    Damaged(usize),
}

/// Writes a recording of at most 1 GiB (1.9 hours at 1 kHz), see [`with_limit`](Self::with_limit).
#[derive(Debug)]
pub struct Recorder<W: Write> {
    out: W,
    written: u64,
    limit: u64,
}

impl<W: Write> Recorder<W> {
    /// Creates a recorder and writes the header.
    ///
    /// # Errors
    /// Returns errors of the stream, and an error if the info cannot be encoded.
    pub fn new(mut out: W, info: &DeviceInfo) -> Result<Self, RecordError> {
        let info = postcard::to_stdvec(info).map_err(|e| RecordError::Header(e.to_string()))?;
        out.write_all(&MAGIC)?;
        out.write_all(&VERSION.to_le_bytes())?;
        out.write_all(&(info.len() as u32).to_le_bytes())?;
        out.write_all(&info)?;
        let written = (MAGIC.len() + 6 + info.len()) as u64;
        Ok(Self { out, written, limit: MAX_BYTES })
    }

    /// Sets the size limit of the whole recording, bytes. A limit above 1 GiB counts as 1 GiB,
    /// because a longer recording could not be read. Default: 1 GiB.
    #[must_use]
    pub fn with_limit(self, bytes: u64) -> Self {
        Self { limit: bytes.min(MAX_BYTES), ..self }
    }

    /// Writes the record of one period.
    ///
    /// # Errors
    /// Returns [`RecordError::Full`] if the record would exceed the size limit, and errors of the
    /// stream.
    pub fn write(&mut self, record: &Record) -> Result<(), RecordError> {
        if self.written + RECORD as u64 > self.limit {
            return Err(RecordError::Full(self.limit));
        }
        let s = &record.sample;
        let velocity = s.velocity.unwrap_or([f64::NAN; 3]);
        let numbers = [record.now, record.dt]
            .into_iter()
            .chain(s.position)
            .chain(s.orientation)
            .chain(velocity)
            .chain(record.wrench.force)
            .chain(record.wrench.torque);
        let mut bytes = [0u8; RECORD];
        for (chunk, x) in bytes.chunks_exact_mut(8).zip(numbers) {
            chunk.copy_from_slice(&x.to_le_bytes());
        }
        let (buttons, sequence) = (s.buttons, s.sequence.map_or(0, |n| n.wrapping_add(1)));
        bytes[NUMBERS * 8..][..4].copy_from_slice(&buttons.to_le_bytes());
        bytes[NUMBERS * 8 + 4..].copy_from_slice(&sequence.to_le_bytes());
        self.out.write_all(&bytes)?;
        self.written += RECORD as u64;
        Ok(())
    }

    /// Flushes the stream and returns it.
    ///
    /// # Errors
    /// Returns errors of the stream.
    pub fn finish(mut self) -> Result<W, RecordError> {
        self.out.flush()?;
        Ok(self.out)
    }
}

/// Replays a recording as a device. The hand follows the recorded path and ignores the force.
#[derive(Debug, Clone)]
pub struct Replay {
    info: DeviceInfo,
    records: Vec<Record>,
    next: usize,
    repeat: bool,
}

impl Replay {
    /// Reads a whole recording. A last record that was cut short is left out.
    ///
    /// # Errors
    /// Returns an error if the data is not a recording, is damaged or is longer than 1 GiB, and
    /// errors of the stream.
    pub fn read(from: impl Read) -> Result<Self, RecordError> {
        Self::read_at_most(from, MAX_BYTES)
    }

    fn read_at_most(mut from: impl Read, limit: u64) -> Result<Self, RecordError> {
        let mut head = [0u8; 10];
        from.read_exact(&mut head)?;
        let [a, b, c, d, v0, v1, l0, l1, l2, l3] = head;
        if [a, b, c, d] != MAGIC {
            return Err(RecordError::Magic([a, b, c, d]));
        }
        let version = u16::from_le_bytes([v0, v1]);
        if version != VERSION {
            return Err(RecordError::Version(version));
        }
        let length = u32::from_le_bytes([l0, l1, l2, l3]);
        if length > LONGEST_INFO {
            return Err(RecordError::Header(format!("{length} bytes of description")));
        }
        let mut info = vec![0u8; length as usize];
        from.read_exact(&mut info)?;
        let mut info: DeviceInfo =
            postcard::from_bytes(&info).map_err(|e| RecordError::Header(e.to_string()))?;
        info.check().map_err(|e| RecordError::Header(e.to_string()))?;
        // A replay exerts no force, whatever device it was recorded from.
        info.simulated = true;
        let mut records: Vec<Record> = Vec::new();
        let mut bytes = [0u8; RECORD];
        let mut read = (head.len() + length as usize) as u64;
        loop {
            read += RECORD as u64;
            match from.read_exact(&mut bytes) {
                Ok(()) => {}
                Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => break,
                Err(e) => return Err(e.into()),
            }
            if read > limit {
                return Err(RecordError::Full(limit));
            }
            let record = parse(&bytes);
            let before = records.last().map_or(f64::NEG_INFINITY, |r| r.now);
            let finite =
                [record.now, record.dt].into_iter().chain(record.sample.position).all(f64::is_finite);
            if !finite || record.now < before || record.dt <= 0.0 {
                return Err(RecordError::Damaged(records.len()));
            }
            records.push(record);
        }
        Ok(Self { info, records, next: 0, repeat: false })
    }

    /// Makes the replay start again at its end instead of being gone.
    pub fn repeating(self) -> Self {
        Self { repeat: true, ..self }
    }

    /// Returns the records.
    pub fn records(&self) -> &[Record] {
        &self.records
    }
}

fn parse(bytes: &[u8; RECORD]) -> Record {
    let mut n = [0.0f64; NUMBERS];
    for (x, chunk) in n.iter_mut().zip(bytes.chunks_exact(8)) {
        let mut b = [0u8; 8];
        b.copy_from_slice(chunk);
        *x = f64::from_le_bytes(b);
    }
    let mut buttons = [0u8; 4];
    buttons.copy_from_slice(&bytes[NUMBERS * 8..][..4]);
    let mut sequence = [0u8; 8];
    sequence.copy_from_slice(&bytes[NUMBERS * 8 + 4..]);
    let velocity = [n[9], n[10], n[11]];
    Record {
        now: n[0],
        dt: n[1],
        sample: Sample {
            position: [n[2], n[3], n[4]],
            orientation: [n[5], n[6], n[7], n[8]],
            velocity: (!velocity[0].is_nan()).then_some(velocity),
            buttons: u32::from_le_bytes(buttons),
            force_on: true,
            sequence: u64::from_le_bytes(sequence).checked_sub(1),
        },
        wrench: Wrench { force: [n[12], n[13], n[14]], torque: [n[15], n[16], n[17]] },
    }
}

impl HapticDevice for Replay {
    fn info(&self) -> DeviceInfo {
        self.info.clone()
    }

    fn exchange(&mut self, _: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        scheduler.wait();
        if self.next >= self.records.len() && self.repeat {
            self.next = 0;
        }
        let record = self.records.get(self.next).ok_or(Fault::Gone)?;
        self.next += 1;
        Ok(record.sample)
    }

    fn safe_stop(&mut self) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Cycle, HandModel, LocalModel, LoopConfig, LoopEvent, Sink, VirtualConfig, VirtualDevice,
        VirtualScheduler,
    };

    fn replay_info(bytes: &[u8]) -> DeviceInfo {
        Replay::read(bytes).unwrap().info()
    }

    /// A stream that never ends.
    struct Endless<I>(I);
    impl<I: Iterator<Item = u8>> Read for Endless<I> {
        fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
            Ok(to.iter_mut().zip(&mut self.0).map(|(to, byte)| *to = byte).count())
        }
    }

    struct Write<'a>(&'a mut Recorder<Vec<u8>>);
    impl Sink for Write<'_> {
        fn event(&mut self, _: LoopEvent) {}
        fn record(&mut self, record: &Record) {
            self.0.write(record).unwrap();
        }
    }

    #[test]
    fn the_same_hand_twice() {
        let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::LIGHT).unwrap();
        let hand = device.handle();
        let mut recorder = Recorder::new(Vec::new(), &device.info()).unwrap();
        let mut cycle = Cycle::new(device, LoopConfig::default()).unwrap();
        let mut scheduler = VirtualScheduler::new(1000.0);
        let mut path = Vec::new();
        for k in 0..300 {
            hand.set_target([0.01 * (f64::from(k) * 0.05).sin(), 0.0, 0.0]);
            hand.set_buttons(u32::from(k > 100));
            cycle.step(&mut scheduler, &LocalModel::default(), &mut Write(&mut recorder));
            path.push(cycle.core().last().position);
        }
        let bytes = recorder.finish().unwrap();
        let replay = Replay::read(&bytes[..]).unwrap();
        assert_eq!(replay.records().len(), 300);
        let mut cycle = Cycle::new(replay, LoopConfig::default()).unwrap();
        let mut events: Vec<LoopEvent> = Vec::new();
        let mut scheduler = VirtualScheduler::new(1000.0);
        for want in path {
            cycle.step(&mut scheduler, &LocalModel::default(), &mut events);
            assert_eq!(cycle.core().last().position, want);
        }
        assert!(events.contains(&LoopEvent::Pressed(0)));
        cycle.step(&mut scheduler, &LocalModel::default(), &mut events);
        assert!(events.contains(&LoopEvent::Lost), "at the end of the recording there is no device");
        // A recording stops at its limit and is whole up to there. One that is longer is not read,
        // because a replay keeps it in memory.
        let limit = bytes.len() as u64 / 2;
        let mut short = Recorder::new(Vec::new(), &replay_info(&bytes)).unwrap().with_limit(limit);
        let source = Replay::read(&bytes[..]).unwrap();
        let refused = source.records().iter().find_map(|record| short.write(record).err());
        assert!(matches!(refused, Some(RecordError::Full(at)) if at == limit), "{refused:?}");
        let short = short.finish().unwrap();
        assert!(short.len() as u64 <= limit && short.len() as u64 + RECORD as u64 > limit);
        assert!(Replay::read(&short[..]).unwrap().records().len() > 100);
        let endless = bytes.iter().chain(bytes[bytes.len() - RECORD..].iter().cycle());
        let endless = Endless(endless.copied());
        assert!(matches!(Replay::read_at_most(endless, 1 << 20), Err(RecordError::Full(_))));
        // A recording that is cut at any byte gives a recording or an error, but never a panic.
        for cut in 0..bytes.len().min(2000) {
            let _ = Replay::read(&bytes[..cut]);
        }
        let mut wrong = bytes.clone();
        wrong[4] = 9;
        assert!(matches!(Replay::read(&wrong[..]), Err(RecordError::Version(9))));
        assert!(matches!(Replay::read(&b"not a recording"[..]), Err(RecordError::Magic(_))));
    }
}
