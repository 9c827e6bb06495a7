//! Fuzzes `.modal` files. A model that was read must be writable and readable with the same hash.
#![no_main]

use libfuzzer_sys::fuzz_target;
use pliant_modal::ModalModel;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(model) = ModalModel::from_bytes(bytes) {
        let again = ModalModel::from_bytes(&model.to_bytes());
        assert_eq!(again.map(|m| m.hash()).ok(), Some(model.hash()));
    }
});
