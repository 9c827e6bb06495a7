//! The `.modal` file: round trip, and every way of being wrong.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a failed test should panic")]

mod rod;

use pliant_modal::{FileError, ModalModel};
use proptest::prelude::*;

#[test]
fn round_trip_is_exact_and_the_hash_is_the_contents() {
    let model = rod::rod(1e6, 7, 0.02, false);
    let bytes = model.to_bytes();
    let back = ModalModel::from_bytes(&bytes).unwrap();
    assert_eq!(back, model);
    assert_eq!(back.hash(), model.hash());
    assert_ne!(rod::rod(1.01e6, 7, 0.02, false).hash(), model.hash());
}

#[test]
fn foreign_cut_padded_altered_and_future_files_are_named() {
    let bytes = rod::rod(1e6, 3, 0.02, false).to_bytes();
    assert!(matches!(ModalModel::from_bytes(b"solid ascii stl"), Err(FileError::Magic(_))));
    assert!(matches!(ModalModel::from_bytes(&[]), Err(FileError::Magic(_))));
    for cut in [9, 30, 60, bytes.len() - 1] {
        assert!(
            matches!(ModalModel::from_bytes(&bytes[..cut]), Err(FileError::Truncated { .. })),
            "cut at {cut}"
        );
    }
    let mut padded = bytes.clone();
    padded.push(0);
    assert!(matches!(ModalModel::from_bytes(&padded), Err(FileError::Truncated { .. })));
    let mut altered = bytes.clone();
    *altered.last_mut().unwrap() ^= 1;
    assert!(matches!(ModalModel::from_bytes(&altered), Err(FileError::Hash { .. })));
    let mut future = bytes;
    future[8] = 99;
    assert!(matches!(ModalModel::from_bytes(&future), Err(FileError::Version { got: 99, .. })));
    assert!(matches!(ModalModel::read("/nonexistent/body.modal"), Err(FileError::Io { .. })));
}

proptest! {
    /// A payload whose hash is right but whose content is not (someone made it so) is refused or harmless; never a panic.
    #[test]
    fn forged_payloads_never_panic(position in 0usize..2_000, value: u8, cut in 0usize..200) {
        let mut bytes = rod::rod(1e6, 3, 0.02, false).to_bytes();
        let header = 52;
        let place = header + position % (bytes.len() - header);
        bytes[place] = value;
        bytes.truncate(bytes.len() - cut);
        let length = (bytes.len() - header) as u64;
        bytes[12..20].copy_from_slice(&length.to_le_bytes());
        let hash = blake3::hash(&bytes[header..]);
        bytes[20..52].copy_from_slice(hash.as_bytes());
        let _ = ModalModel::from_bytes(&bytes);
    }
}
