//! Writes stiffness and mass as MatrixMarket files for independent checks.

use std::fs;
use std::io::{BufWriter, Write};
use std::path::Path;

use pliant_mesh::io::write_whole;

use crate::BakeError;
use crate::fem::ANCHORED;
use crate::sparse::BlockCsr;

/// Writes `K.mtx` (N/m) and `M.mtx` (kg) into `folder`.
///
/// The files hold the lower triangles (`coordinate real symmetric`) for the degrees of freedom that
/// are not anchored, in node order: row `3 i + axis + 1` for the `i`-th free node. Each file
/// appears either complete or not at all, and neither appears without the other.
pub(crate) fn export(folder: &Path, matrix: &BlockCsr, number: &[u32]) -> Result<(), BakeError> {
    let failed = |path: &Path| {
        let path = path.to_path_buf();
        move |source| BakeError::Export { path, source }
    };
    fs::create_dir_all(folder).map_err(failed(folder))?;
    // `free` holds the matrix row of each free node in natural order. `rank` is the inverse.
    let free: Vec<u32> = number.iter().copied().filter(|&n| n != ANCHORED).collect();
    let mut rank = vec![0usize; free.len()];
    for (natural, &row) in free.iter().enumerate() {
        rank[row as usize] = natural;
    }
    let paths = ["K", "M"].map(|name| folder.join(format!("{name}.mtx")));
    for (index, path) in paths.iter().enumerate() {
        let written = write_whole(path, |file| write(file, index == 0, matrix, &free, &rank));
        if let Err(source) = written {
            if index > 0 && paths[0].is_file() {
                // The caller needs the first error, so a second error is ignored.
                let _ = fs::remove_file(&paths[0]);
            }
            return Err(failed(path)(source));
        }
    }
    Ok(())
}

/// Refuses a path that cannot be a folder, before the long computation starts.
pub(crate) fn check_folder(folder: &Path) -> Result<(), BakeError> {
    if folder.exists() && !folder.is_dir() {
        let source = std::io::ErrorKind::NotADirectory.into();
        return Err(BakeError::Export { path: folder.to_path_buf(), source });
    }
    Ok(())
}

fn write(
    file: &mut fs::File,
    stiffness: bool,
    matrix: &BlockCsr,
    free: &[u32],
    rank: &[usize],
) -> std::io::Result<()> {
    let mut file = BufWriter::with_capacity(1 << 20, file);
    let n = 3 * free.len();
    let mut entries = 0usize;
    each_entry(stiffness, matrix, free, rank, &mut |_, _, _| {
        entries += 1;
        Ok(())
    })?;
    writeln!(file, "%%MatrixMarket matrix coordinate real symmetric")?;
    writeln!(file, "{n} {n} {entries}")?;
    each_entry(stiffness, matrix, free, rank, &mut |row, column, value| {
        // `{:e}` writes the shortest text that parses back to the same number.
        writeln!(file, "{} {} {value:e}", row + 1, column + 1)
    })?;
    file.flush()
}

fn each_entry(
    stiffness: bool,
    matrix: &BlockCsr,
    free: &[u32],
    rank: &[usize],
    visit: &mut dyn FnMut(usize, usize, f64) -> std::io::Result<()>,
) -> std::io::Result<()> {
    for (natural, &row) in free.iter().enumerate() {
        for at in matrix.offsets[row as usize]..matrix.offsets[row as usize + 1] {
            let other = rank[matrix.columns[at] as usize];
            if other > natural {
                continue;
            }
            for k in 0..3 {
                for l in 0..3 {
                    if 3 * other + l > 3 * natural + k || (!stiffness && k != l) {
                        continue;
                    }
                    let value =
                        if stiffness { matrix.stiffness[9 * at + 3 * k + l] } else { matrix.mass[at] };
                    visit(3 * natural + k, 3 * other + l, value)?;
                }
            }
        }
    }
    Ok(())
}
