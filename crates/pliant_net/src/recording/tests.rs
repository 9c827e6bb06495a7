//! Recordings are whole, bounded, and safe to read whatever is in the file.

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

fn limits(bytes: u64, models: u64) -> RecordingLimits {
    RecordingLimits { bytes, models, folder: u64::MAX }
}

/// Data of a record by its kind, written without a limit.
type Raw<'a> = (u8, &'a mut dyn Read, u64);

/// Writes a file of any records, as somebody who means harm would.
fn packed(name: &str, records: &mut [Raw<'_>]) -> PathBuf {
    let path = file(name);
    let mut file = File::create(&path).unwrap();
    file.write_all(MAGIC).unwrap();
    let mut encoder = zstd::stream::write::Encoder::new(file, LEVEL).unwrap();
    for (kind, data, length) in records {
        let head = [&[*kind][..], &[0; 8], &(*length as u32).to_le_bytes()].concat();
        encoder.write_all(&head).unwrap();
        assert_eq!(io::copy(&mut data.take(*length), &mut encoder).unwrap(), *length);
    }
    encoder.finish().unwrap();
    path
}

fn played(path: &Path) -> Vec<usize> {
    let mut recording = SessionRecording::open(path).unwrap();
    std::iter::from_fn(|| recording.poll(Duration::MAX)).map(|(_, record)| record.len()).collect()
}

/// Bytes that do not compress, by xorshift (Marsaglia 2003).
fn noise(state: &mut u64, length: usize) -> Bytes {
    let next = |_| {
        *state ^= *state << 13;
        *state ^= *state >> 7;
        *state ^= *state << 17;
        (*state >> 24) as u8
    };
    (0..length).map(next).collect()
}

#[test]
fn a_bomb_of_zeros_is_not_unpacked() {
    for kind in [DATAGRAM, MESSAGE] {
        let path = packed("bomb", &mut [(kind, &mut io::repeat(0), 256 << 20)]);
        let bytes = path.metadata().unwrap().len();
        assert!(bytes < 64 << 10, "{bytes} bytes");
        assert_eq!(played(&path), [0; 0], "records of kind {kind} from a file of {bytes} bytes");
    }
    // The longest records that a session takes are played, and longer ones are not.
    for (kind, longest) in [(DATAGRAM, 65_535), (MESSAGE, MAX_MESSAGE as u64)] {
        let records = &mut [longest, longest + 1].map(|length| (kind, io::repeat(7), length));
        let mut records: Vec<_> =
            records.iter_mut().map(|(kind, data, length)| (*kind, data as &mut dyn Read, *length)).collect();
        assert_eq!(played(&packed("bomb", &mut records)), [longest as usize]);
    }
    std::fs::remove_file(file("bomb")).unwrap();
}

#[test]
fn a_file_of_too_much_data_is_refused_by_name() {
    let mut zeros: Vec<_> = (0..1000).map(|_| io::repeat(0)).collect();
    let mut records: Vec<Raw<'_>> =
        zeros.iter_mut().map(|zeros| (MESSAGE, zeros as &mut dyn Read, 200_000)).collect();
    let path = packed("much", &mut records);
    let bytes = path.metadata().unwrap().len();
    assert!(bytes < 64 << 10, "{bytes} bytes");
    let whole = 1000 * (13 + 200_000);
    for limit in [1 << 20, whole - 1] {
        let error = SessionRecording::limited(&path, limits(limit, 0)).err();
        let named = matches!(error, Some(RecordingError::TooLong { limit: told, .. }) if told == limit);
        assert!(named, "{bytes} bytes of file and {limit} of {whole} bytes of records: {error:?}");
    }
    assert!(SessionRecording::limited(&path, limits(whole, 0)).is_ok());
    std::fs::remove_file(path).unwrap();
}

fn model(name: &str) -> Vec<u8> {
    let assets = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");
    std::fs::read(Path::new(assets).join(name)).unwrap()
}

#[test]
fn models_are_kept_once_and_up_to_a_bound() {
    let (bud, jack) = (model("bud.modal"), model("jack.modal"));
    let (bud_bytes, jack_bytes) = (bud.len() as u64, jack.len() as u64);
    // A file that repeats a model, and has one that is no model, before the only message.
    let mut many = vec![&bud[..]; 50];
    many.extend([&jack[..], &bud[..9]]);
    let mut records: Vec<Raw<'_>> = many
        .iter_mut()
        .map(|bytes| {
            let length = bytes.len() as u64;
            (MODEL, bytes as &mut dyn Read, length)
        })
        .collect();
    let mut text = &b"a message"[..];
    records.push((MESSAGE, &mut text, 9));
    let path = packed("models", &mut records);
    let kept = SessionRecording::open(&path).unwrap().models.len();
    assert_eq!(kept, 2, "models kept of 51, of which 2 differ");
    assert_eq!(played(&path), [9], "a replay is given no models");
    let both = bud_bytes + jack_bytes;
    let within = |models| SessionRecording::limited(&path, limits(1 << 30, models));
    let error = within(both - 1).err();
    let named = matches!(error, Some(RecordingError::ModelsTooLarge { limit, .. }) if limit == both - 1);
    assert!(named, "{error:?}");
    assert_eq!(within(both).unwrap().models.len(), 2);

    // What is recorded has each model once as well, and no more than can be read again.
    for (most, expected) in [(both, 2), (both - 1, 1)] {
        let mut recorder = SessionRecorder::limited(&path, limits(1 << 30, most)).unwrap();
        for bytes in [&bud, &bud, &jack, &bud] {
            recorder.put_model(Duration::ZERO, &Arc::new(ModalModel::from_bytes(bytes).unwrap()));
        }
        drop(recorder);
        let mut records = open(&path, RecordingLimits::READ).unwrap();
        let written = std::iter::from_fn(|| read(&mut records)).count();
        assert_eq!(written, expected, "models written of 4, of which 2 differ");
    }
    std::fs::remove_file(path).unwrap();
}

#[test]
fn a_message_that_no_session_takes_ends_the_recording_and_leaves_it_whole() {
    let path = file("long");
    let mut recorder = SessionRecorder::create(&path, u64::MAX).unwrap();
    for length in [9, MAX_MESSAGE, MAX_MESSAGE + 1, 9] {
        recorder.put(Duration::ZERO, &SessionRecord::Message(vec![7; length].into()));
    }
    drop(recorder);
    assert_eq!(played(&path), [9, MAX_MESSAGE]);
    std::fs::remove_file(path).unwrap();
}

#[test]
fn a_recording_ends_at_its_limit_and_is_whole() {
    let path = file("limited");
    let records = records();
    let mut recorder = SessionRecorder::limited(&path, limits(20_000, 0)).unwrap();
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

/// A game that records every session into one folder.
#[test]
fn recordings_of_many_sessions_stay_within_the_budget_of_their_folder() {
    let folder = file("folder");
    std::fs::remove_dir_all(&folder).ok();
    let (budget, sessions) = (100_000, 20);
    let with_separator = folder.join("");
    let mut state = 1;
    let mut session = |to: &Path, budget, messages: u64| {
        let mut recorder = SessionRecorder::create(to, budget).unwrap();
        for n in 0..messages {
            let message = noise(&mut state, 10_000);
            recorder.put(Duration::from_secs(2 * n), &SessionRecord::Message(message));
        }
        let path = recorder.path.clone();
        drop(recorder);
        path
    };
    let bytes =
        || -> u64 { std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().metadata().unwrap().len()).sum() };
    let mut most = 0;
    // The first names a folder that is not there yet.
    let mut names: Vec<PathBuf> = (0..sessions)
        .map(|n| {
            let path = session(if n == 0 { &with_separator } else { &folder }, budget, 3);
            most = most.max(bytes());
            path
        })
        .collect();
    names.dedup();
    assert_eq!(names.len(), sessions, "each session has a file of its own");
    println!("{sessions} sessions of 30 kB each: at most {most} bytes in a folder of {budget}");
    assert!((60_000..=budget).contains(&most), "{most} bytes");
    let left: Vec<&PathBuf> = names.iter().filter(|path| path.exists()).collect();
    assert_eq!(left, names[sessions - 3..].iter().collect::<Vec<_>>(), "the newest stay");
    assert!(left.iter().all(|path| played(path) == [10_000; 3]), "and are whole");

    // One that does not fit alone removes the others and ends, and is whole up to there.
    let long = session(&folder, budget, 30);
    let played = played(&long);
    assert!((8..=11).contains(&played.len()), "{played:?}");
    assert!(bytes() <= budget + 20_000, "{} bytes", bytes());
    std::fs::remove_dir_all(&folder).unwrap();
}

/// A pipe that nobody reads is a disk that stands still.
#[cfg(unix)]
#[test]
fn a_disk_that_stands_still_holds_up_no_frame_and_no_end() {
    let path = file("pipe");
    let made = std::process::Command::new("mkfifo").arg(&path).status();
    assert!(made.is_ok_and(|status| status.success()), "mkfifo");
    let nobody = File::options().read(true).write(true).open(&path).unwrap();
    let mut recorder = SessionRecorder::create(&path, u64::MAX).unwrap();
    recorder.patience = Duration::from_millis(100);
    let began = std::time::Instant::now();
    let (mut state, mut most) = (1_u64, 0);
    for n in 0..20_000 {
        let datagram = noise(&mut state, 1000);
        recorder.put(Duration::from_millis(n), &SessionRecord::Datagram(datagram));
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
    let mut recorder = SessionRecorder::create(&path, u64::MAX).unwrap();
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
