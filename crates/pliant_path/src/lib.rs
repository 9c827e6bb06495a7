//! Paths in files from someone else, and folders of recordings with a budget.
//!
//! A scene and a document of a mesh name files by the same rule, and the recordings of sessions and
//! of the viewer make room in their folders by the same rule. It is a crate of its own, without
//! dependencies, because a game that makes no bodies itself leaves `pliant_mesh` out and still
//! reads scenes.

mod recordings;

pub use recordings::{RecordingFolder, Room};

/// Longest path, bytes.
const LONGEST: usize = 1024;

/// Returns whether a path in a file from someone else names a file below a folder, on every system,
/// whatever system this is: names of folders and of a file only, with `/` between them.
///
/// A file that is safe on the system where it was checked must not reach beyond its folder on
/// another one. Windows also separates by `\`, ends a drive or begins a stream of a file by `:`,
/// ignores dots and spaces at the end of a name, and takes names such as `NUL` and `com1.rrd` for
/// devices, in any folder.
///
/// The function reads only the text. It does not tell whether a link leads out of the folder.
///
/// ```
/// use pliant_path::is_below;
///
/// assert!(is_below("folder/skin.bin"));
/// assert!(!is_below("../skin.bin") && !is_below("C:skin.bin") && !is_below("nul.bin"));
/// ```
pub fn is_below(path: &str) -> bool {
    path.len() <= LONGEST
        && !path.contains(|c: char| matches!(c, '\\' | ':') || c.is_control())
        && path.split('/').all(|name| !name.is_empty() && !name.ends_with(['.', ' ']) && !is_device(name))
}

/// Returns whether Windows takes a name for a device. It ignores what follows the first dot, and
/// spaces before that.
fn is_device(name: &str) -> bool {
    let stem = name.split_once('.').map_or(name, |(stem, _)| stem).trim_end_matches(' ');
    let is = |device: &&str| stem.eq_ignore_ascii_case(device);
    if ["CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$", "CLOCK$"].iter().any(is) {
        return true;
    }
    let ports = stem.split_at_checked(3);
    ports.is_some_and(|(port, number)| {
        ["COM", "LPT"].iter().any(|device| port.eq_ignore_ascii_case(device))
            // Windows takes a raised digit for a digit.
            && matches!(number.chars().next(), Some('0'..='9' | '¹' | '²' | '³'))
            && number.chars().count() == 1
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_from_others_name_files_below_a_folder_on_every_system() {
        for (path, below) in [
            ("a.bin", true),
            ("a/b.bin", true),
            (".hidden", true),
            ("a b/ü..c.rrd", true),
            ("a/%2e%2e/b", true),
            ("", false),
            ("/", false),
            ("/a", false),
            ("a/", false),
            ("a//b", false),
            (".", false),
            ("..", false),
            ("./a", false),
            ("../a", false),
            ("a/./b", false),
            ("a/../b", false),
            ("a/.../b", false),
            ("\\a", false),
            ("a\\b", false),
            ("..\\a", false),
            ("\\\\server\\share", false),
            ("\\\\?\\C:\\a", false),
            ("C:/a", false),
            ("C:a", false),
            ("a:stream", false),
            ("a.bin::$DATA", false),
            ("http://a/b", false),
            ("a\0", false),
            ("a\nb", false),
            ("a\u{7f}", false),
            ("a\u{85}", false),
            ("a.", false),
            ("a ", false),
            ("a. ", false),
            ("a./b", false),
            ("a /b", false),
            ("NUL", false),
            ("nul", false),
            ("con.txt", false),
            ("Con .txt", false),
            ("aux.tar.gz", false),
            ("a/prn/b", false),
            ("COM1.rrd", false),
            ("com0", false),
            ("LPT9", false),
            ("COM¹", false),
            ("lpt³.modal", false),
            ("CONIN$", false),
            ("conout$.txt", false),
            ("clock$", false),
            // Names that only resemble those of devices.
            ("console", true),
            ("null.bin", true),
            ("COM", true),
            ("COM10", true),
            ("COMx", true),
            ("com.1", true),
            ("LPTé", true),
            ("a.nul", true),
            ("my con.txt", true),
        ] {
            assert_eq!(is_below(path), below, "{path:?}");
        }
        assert!(is_below(&"a".repeat(LONGEST)) && !is_below(&"a".repeat(LONGEST + 1)));
    }
}
