//! The `.modal` file: round trip and all kinds of invalid files.

use crate::nonlinear_rod;
use crate::rod;

use nonlinear_rod::nonlinear_rod;
use pliant_modal::{FileError, Material, ModalModel, ModelParts, ReducedElasticity};
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
fn a_material_comes_back_and_a_file_without_one_has_none() {
    let model = nonlinear_rod(1e6, 7, 0.02);
    let bytes = model.to_bytes();
    let back = ModalModel::from_bytes(&bytes).unwrap();
    assert_eq!(back, model);
    assert_eq!(back.material(), Some(Material::StVenantKirchhoff));
    let plain = rod::rod(1e6, 7, 0.02, false);
    assert_eq!(ModalModel::from_bytes(&plain.to_bytes()).unwrap().material(), None);
    // The section follows what a file without it ends with.
    let forged = |at: usize, value: u8| {
        let mut bytes = bytes.clone();
        bytes[at] = value;
        seal(&mut bytes);
        ModalModel::from_bytes(&bytes).unwrap_err().to_string()
    };
    let section = bytes.windows(4).rposition(|w| w == b"NLIN").unwrap();
    assert!(forged(section, b'X').contains("section"), "{}", forged(section, b'X'));
    assert!(forged(section + 12, 9).contains("material"), "{}", forged(section + 12, 9));
    assert!(forged(section + 13, 200).contains("cubature"), "{}", forged(section + 13, 200));
    // The section's length: shorter than what it holds, and longer than the file.
    let length = bytes[section + 4];
    let shorter = forged(section + 4, length.wrapping_sub(4));
    assert!(shorter.contains("cubature") || shorter.contains("section"), "{shorter}");
    assert!(forged(section + 10, 1).contains("section"), "{}", forged(section + 10, 1));
}

/// Corrects length and hash of a changed file.
fn seal(bytes: &mut [u8]) {
    let header = 52;
    let length = (bytes.len() - header) as u64;
    bytes[12..20].copy_from_slice(&length.to_le_bytes());
    let hash = blake3::hash(&bytes[header..]);
    bytes[20..52].copy_from_slice(hash.as_bytes());
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

fn folder(name: &str) -> std::path::PathBuf {
    let folder = std::env::temp_dir().join(format!("pliant_modal-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

#[test]
fn what_is_wrong_in_a_file_names_the_file() {
    let folder = folder("names");
    let path = folder.join("broken.modal");
    std::fs::write(&path, b"solid ascii stl").unwrap();
    let error = ModalModel::read(&path).unwrap_err();
    assert!(matches!(&error, FileError::In { source, .. } if matches!(**source, FileError::Magic(_))));
    assert!(error.to_string().contains("broken.modal"), "{error}");
    let error = rod::rod(1e6, 3, 0.02, false).write(folder.join("no/such.modal")).unwrap_err();
    assert!(error.to_string().contains("such.modal"), "{error}");
    std::fs::remove_dir_all(folder).unwrap();
}

#[cfg(unix)]
#[test]
fn a_link_stays_a_link_and_a_device_stays_a_device() {
    use std::os::unix::fs::FileTypeExt;

    let folder = folder("links");
    let (file, link, null) =
        (folder.join("real.modal"), folder.join("link.modal"), folder.join("null.modal"));
    let model = rod::rod(1e6, 3, 0.02, false);
    model.write(&file).unwrap();
    std::os::unix::fs::symlink("real.modal", &link).unwrap();
    let other = rod::rod(2e6, 3, 0.02, false);
    other.write(&link).unwrap();
    assert!(link.symlink_metadata().unwrap().is_symlink());
    assert_eq!(ModalModel::read(&file).unwrap().hash(), other.hash());
    std::os::unix::fs::symlink("/dev/null", &null).unwrap();
    model.write(&null).unwrap();
    assert!(std::fs::metadata("/dev/null").unwrap().file_type().is_char_device());
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 3, "nothing is left over");
    std::fs::remove_dir_all(folder).unwrap();
}

#[cfg(unix)]
#[test]
fn a_link_that_waits_at_the_temporary_name_is_not_followed() {
    let folder = folder("planted");
    let (path, victim) = (folder.join("rod.modal"), folder.join("victim"));
    std::fs::write(&victim, "somebody else's").unwrap();
    for number in 0..256 {
        let partial = folder.join(format!("rod.modal.{}.{number}.partial", std::process::id()));
        std::os::unix::fs::symlink(&victim, partial).unwrap();
    }
    rod::rod(1e6, 3, 0.02, false).write(&path).unwrap();
    assert_eq!(std::fs::read_to_string(&victim).unwrap(), "somebody else's");
    assert!(path.symlink_metadata().unwrap().is_file());
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn threads_that_write_one_file_leave_one_whole_file() {
    let folder = folder("threads");
    let path = folder.join("rod.modal");
    let models = [rod::rod(1e6, 3, 0.02, false), rod::rod(1e6, 4, 0.02, false)];
    std::thread::scope(|scope| {
        for thread in 0..4 {
            let (path, model) = (&path, &models[thread % 2]);
            scope.spawn(move || (0..20).for_each(|_| model.write(path).unwrap()));
        }
    });
    let read = ModalModel::read(&path).unwrap();
    assert!(models.iter().any(|model| model.hash() == read.hash()));
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1, "nothing is left over");
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn parts_that_cannot_be_stepped_or_told_are_refused_by_name() {
    let refused = |change: &dyn Fn(&mut ModelParts)| {
        let mut parts = rod::rod(1e6, 3, 0.02, false).parts().clone();
        change(&mut parts);
        ModalModel::from_parts(parts).unwrap_err().to_string()
    };
    // The square of 1e200 overflows and that of 1e-200 is zero. Neither is a valid stiffness.
    assert!(refused(&|p| p.omega[2] = 1e200).contains("omega[2]"));
    assert!(refused(&|p| p.omega[0] = 1e-200).contains("omega[0]"));
    assert!(refused(&|p| p.damping[1] = 1e300).contains("damping[1]"));
    assert!(refused(&|p| p.sites[0].flexibility[0][1] = 1.0).contains("symmetric"));
    let not_definite = refused(&|p| {
        p.sites[0].flexibility[0][1] = 1.0;
        p.sites[0].flexibility[1][0] = 1.0;
    });
    assert!(not_definite.contains("semi-definite"), "{not_definite}");
    assert!(refused(&|p| p.sites[0].flexibility[2][2] = -1.0).contains("semi-definite"));
    // The lower triangle alone is positive definite.
    let skew = refused(&|p| p.inertia[0][1] = 0.3 * p.inertia[1][1]);
    assert!(skew.contains("inertia[0]: expected a symmetric matrix"), "{skew}");
    assert!(refused(&|p| p.inertia[1][1] *= -1.0).contains("positive definite"));
    assert!(
        refused(&|p| p.info.name = "x".repeat(257)).contains("name: expected at most 256 bytes, got 257")
    );
    assert!(refused(&|p| p.info.anchors = vec![String::new(); 65]).contains("anchors"));
    assert!(refused(&|p| p.info.anchors = vec!["x".repeat(300)]).contains("anchor"));
    let refused = |change: &dyn Fn(&mut ReducedElasticity)| {
        let mut parts = nonlinear_rod(1e6, 3, 0.02).parts().clone();
        change(parts.reduced.as_mut().unwrap());
        ModalModel::from_parts(parts).unwrap_err().to_string()
    };
    assert!(refused(&|r| r.weights[2] = -1.0).contains("cubature weights[2]"));
    assert!(refused(&|r| r.gradients[5] = f32::NAN).contains("cubature gradients[5]"));
    assert!(refused(&|r| r.gradients.truncate(7)).contains("cubature gradients"));
    assert!(refused(&|r| r.weights.clear()).contains("cubature point"));
}

proptest! {
    /// A forged payload with a correct hash is refused or harmless, and never causes a panic.
    #[test]
    fn forged_payloads_never_panic(position in 0usize..2_000, value: u8, cut in 0usize..200) {
        let header = 52;
        for model in [rod::rod(1e6, 3, 0.02, false), nonlinear_rod(1e6, 3, 0.02)] {
            let whole = model.to_bytes();
            // From the front and from the back, where the section is.
            for place in [header + position % (whole.len() - header), whole.len() - 1 - position % 2_000] {
                let mut bytes = whole.clone();
                bytes[place] = value;
                bytes.truncate(bytes.len() - cut);
                seal(&mut bytes);
                let _ = ModalModel::from_bytes(&bytes);
            }
        }
    }
}
