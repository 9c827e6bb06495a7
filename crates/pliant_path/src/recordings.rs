//! A folder of recordings with a budget of its own.
//!
//! A game that records every session must not fill the disk. Each recording gets a new file, and
//! when all have more bytes than the budget, the oldest finished ones are removed. Files that
//! Pliant did not write are never removed: a recording is told by its name, which nobody else gives
//! a file by chance, and by its first bytes. Who renames a recording keeps it.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{MAIN_SEPARATOR, Path, PathBuf};
use std::time::SystemTime;

/// First part of the name of each recording.
const STEM: &str = "pliant-";

/// A folder of recordings of one kind, and the bytes that they may have together.
///
/// A recording that is being written is not removed, also when another program writes it: on
/// Windows a file that is open is left alone, and elsewhere one that is locked, as those of
/// [`create`](Self::create) are for as long as they are open.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingFolder {
    /// Path of the folder.
    pub path: PathBuf,
    /// Extension of the recordings, without a dot. Files with another one are not counted.
    pub extension: &'static str,
    /// First bytes of each recording. A file that begins otherwise is not removed.
    pub magic: &'static [u8],
    /// Most bytes of all recordings in the folder together.
    pub budget: u64,
}

/// What [`RecordingFolder::make_room`] has done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Room {
    /// Recordings that were removed, oldest first.
    pub removed: Vec<PathBuf>,
    /// Bytes of the recordings that are left.
    pub bytes: u64,
    /// Whether those are within the budget. If not, no further recording can be removed.
    pub is_enough: bool,
}

impl RecordingFolder {
    /// Whether a path names a folder of recordings, and not a file: a folder that exists, or a path
    /// that ends with a separator.
    pub fn is_named_by(path: &Path) -> bool {
        let text = path.to_string_lossy();
        text.ends_with('/') || text.ends_with(MAIN_SEPARATOR) || path.is_dir()
    }

    /// Creates a file for a new recording, and the folder if there is none. The name has the time
    /// in UTC, as in `pliant-20261124-181500-250.rrd`, so that names sort by age.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn create(&self) -> io::Result<(PathBuf, File)> {
        fs::create_dir_all(&self.path)?;
        let now = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
        let mut ms = u64::try_from(now.as_millis()).unwrap_or(u64::MAX);
        loop {
            let path = self.path.join(name(ms, self.extension));
            match File::create_new(&path) {
                Ok(file) => {
                    // Where files cannot be locked, no recording is removed.
                    #[cfg(not(windows))]
                    file.try_lock().ok();
                    return Ok((path, file));
                }
                // Another program began at the same moment.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => ms += 1,
                Err(error) => return Err(error),
            }
        }
    }

    /// Removes the oldest finished recordings until those that are left are within the budget.
    ///
    /// # Errors
    /// Errors of the operating system while it lists the folder. A recording that cannot be
    /// removed is left.
    pub fn make_room(&self) -> io::Result<Room> {
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            let entry = entry?;
            // Links are not followed.
            if is_name(&entry.file_name().to_string_lossy(), self.extension)
                && entry.file_type().is_ok_and(|kind| kind.is_file())
            {
                // A file may vanish in between.
                let bytes = entry.metadata().map_or(0, |data| data.len());
                found.push((entry.path(), bytes));
            }
        }
        if found.iter().map(|(_, bytes)| bytes).sum::<u64>() > self.budget {
            found.retain(|(path, _)| self.is_recording(path));
            found.sort_unstable();
        }
        let bytes = found.iter().map(|(_, bytes)| bytes).sum();
        let mut room = Room { removed: Vec::new(), bytes, is_enough: true };
        for (path, bytes) in found {
            if room.bytes <= self.budget {
                break;
            }
            if is_finished(&path) && fs::remove_file(&path).is_ok() {
                room.bytes -= bytes;
                room.removed.push(path);
            }
        }
        room.is_enough = room.bytes <= self.budget;
        Ok(room)
    }

    /// Whether a file begins as a recording does.
    fn is_recording(&self, path: &Path) -> bool {
        let mut head = vec![0; self.magic.len()];
        let read = File::open(path).and_then(|mut file| file.read_exact(&mut head));
        read.is_ok() && head == self.magic
    }
}

/// Whether nobody is writing a recording.
fn is_finished(path: &Path) -> bool {
    let mut options = File::options();
    options.read(true);
    // Windows opens a file that nobody else has open.
    #[cfg(windows)]
    std::os::windows::fs::OpenOptionsExt::share_mode(&mut options, 0);
    // A lock ends with the file.
    options.open(path).is_ok_and(|file| cfg!(windows) || file.try_lock().is_ok())
}

/// The name of a recording that began at this many milliseconds after 1970.
fn name(ms: u64, extension: &str) -> String {
    let (s, ms) = (ms / 1000, ms % 1000);
    let (days, s) = (s / 86_400, s % 86_400);
    // Days to the date of the Gregorian calendar, in eras of 400 years that begin in March
    // (Hinnant, "chrono-Compatible Low-Level Date Algorithms").
    let days = days + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    let year = era * 400 + year + u64::from(month <= 2);
    let (h, min, s) = (s / 3600, s / 60 % 60, s % 60);
    format!("{STEM}{year:04}{month:02}{day:02}-{h:02}{min:02}{s:02}-{ms:03}.{extension}")
}

/// Whether a file's name is one that [`name`] gives.
fn is_name(text: &str, extension: &str) -> bool {
    let Some(rest) = text.strip_prefix(STEM).and_then(|rest| rest.strip_suffix(extension)) else {
        return false;
    };
    let Some(rest) = rest.strip_suffix('.') else { return false };
    let parts: Vec<&str> = rest.split('-').collect();
    parts.len() == 3
        && parts
            .iter()
            .zip([8, 6, 3])
            .all(|(part, length)| part.len() == length && part.bytes().all(|digit| digit.is_ascii_digit()))
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a failed test should panic")]
mod tests {
    use super::*;
    use std::io::Write;

    const MAGIC: &[u8] = b"MAGIC";

    fn folder(test: &str, budget: u64) -> RecordingFolder {
        let path = std::env::temp_dir().join(format!("pliant_path_{}_{test}", std::process::id()));
        fs::remove_dir_all(&path).ok();
        RecordingFolder { path, extension: "rec", magic: MAGIC, budget }
    }

    /// Writes a recording of this many bytes and returns it.
    fn record(folder: &RecordingFolder, bytes: usize) -> (PathBuf, File) {
        let (path, mut file) = folder.create().unwrap();
        file.write_all(&[MAGIC, &vec![0; bytes - MAGIC.len()]].concat()).unwrap();
        (path, file)
    }

    #[test]
    fn the_oldest_finished_recordings_are_removed_and_nothing_else() {
        let folder = folder("oldest", 1000);
        let finished: Vec<PathBuf> = (0..4).map(|_| record(&folder, 300).0).collect();
        assert!(finished.is_sorted(), "names sort by age: {finished:?}");
        let left = |room: &Room| (room.removed.clone(), room.bytes, room.is_enough);
        let room = folder.make_room().unwrap();
        assert_eq!(left(&room), (vec![finished[0].clone()], 900, true));
        assert!(folder.make_room().unwrap().removed.is_empty(), "what fits stays");

        // Files of others: another kind, another name, other content, a link, a folder.
        let of_others = ["pliant-20200101-000000-000.rrd", "old.rec", "pliant-20200101-000000-000.rec"];
        of_others.iter().for_each(|name| fs::write(folder.path.join(name), [7; 5000]).unwrap());
        fs::create_dir(folder.path.join("pliant-20200101-000000-001.rec")).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(&finished[1], folder.path.join("pliant-20200101-000000-002.rec")).unwrap();
        let (running, file) = record(&folder, 300);
        let room = folder.make_room().unwrap();
        assert_eq!(left(&room), (vec![finished[1].clone()], 900, true), "others' files do not count");

        let small = RecordingFolder { budget: 299, ..folder.clone() };
        let room = small.make_room().unwrap();
        assert_eq!(left(&room), (finished[2..].to_vec(), 300, false), "one is being written");
        drop(file);
        assert_eq!(left(&small.make_room().unwrap()), (vec![running], 0, true), "it has ended");
        let others = fs::read_dir(&folder.path).unwrap().count();
        assert_eq!(others, 4 + usize::from(cfg!(unix)), "files of others are left");
        fs::remove_dir_all(&folder.path).unwrap();
    }

    #[test]
    fn a_recording_has_a_name_of_its_own_with_the_time() {
        assert_eq!(name(0, "rrd"), "pliant-19700101-000000-000.rrd");
        assert_eq!(name(1_709_251_199_999, "rrd"), "pliant-20240229-235959-999.rrd");
        assert_eq!(name(1_795_635_240_007, "rec"), "pliant-20261125-193400-007.rec");
        assert_eq!(name(4_102_444_800_000, "rec"), "pliant-21000101-000000-000.rec");
        assert!(is_name("pliant-20261125-193400-007.rec", "rec"));
        for other in [
            "pliant-20261125-193400-007.rrd",
            "pliant-20261125-193400-007rec",
            "pliant-20261125-193400-07.rec",
            "pliant-20261125-193400-0007.rec",
            "pliant-20261125-193400-007-best.rec",
            "pliant-2026112x-193400-007.rec",
            "pliant-.rec",
            "my pliant-20261125-193400-007.rec",
        ] {
            assert!(!is_name(other, "rec"), "{other}");
        }
        let folder = folder("names", 0);
        let mut names: Vec<PathBuf> = (0..50).map(|_| folder.create().unwrap().0).collect();
        names.dedup();
        assert_eq!(names.len(), 50, "files of the same moment");
        fs::remove_dir_all(&folder.path).unwrap();
    }

    #[test]
    fn a_folder_exists_or_its_path_ends_with_a_separator() {
        let temporary = std::env::temp_dir();
        assert!(RecordingFolder::is_named_by(&temporary));
        assert!(RecordingFolder::is_named_by(Path::new("no such folder/")));
        assert!(!RecordingFolder::is_named_by(Path::new("no such file")));
    }
}
