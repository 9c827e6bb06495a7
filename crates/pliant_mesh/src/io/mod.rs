//! Reads and writes files of surfaces, tetrahedra and descriptions of shapes.
//!
//! The extension of a file determines its format:
//!
//! | Extension | Format | Read as | Written |
//! | --- | --- | --- | --- |
//! | `.obj` | Wavefront OBJ | surface | |
//! | `.stl` | STL, text and binary | surface | |
//! | `.ply` | Stanford PLY, text and binary | surface | text |
//! | `.gltf`, `.glb` | glTF 2.0 | surface | |
//! | `.ron` | [`Scene`], the project's own | distance field | |
//! | `.msh` | Gmsh MSH 2.2 and 4.1, text and binary | tetrahedra | text |
//! | `.vtk` | VTK legacy, text and binary | tetrahedra | text |
//! | `.mesh` | Medit, text | tetrahedra | text |
//! | `.veg` | Vega FEM, text | tetrahedra | text |
//!
//! For any bytes in a file, reading gives a mesh or an error and takes memory in proportion to the
//! file.

mod cursor;
mod gltf;
mod medit;
mod msh;
mod obj;
mod ply;
mod stl;
mod vega;
mod vtk;

use std::{
    fs,
    io::{Read as _, Write as _},
    path::Path,
    sync::atomic::{AtomicU64, Ordering},
};

use crate::{
    MeshError, Repair, StuffOptions, Surface, TetMesh,
    sdf::{Scene, SurfaceDistance},
    stuff,
};

pub use msh::MshVersion;
pub use pliant_path::is_below;

/// Largest accepted file, bytes.
const MAX_FILE: u64 = 1 << 30;

const SURFACES: &str = ".obj, .stl, .ply, .gltf or .glb";
const SCENES: &str = ".ron";
const TETS: &str = ".msh, .vtk, .mesh or .veg";
const ALL: &str = ".obj, .stl, .ply, .gltf or .glb (a surface), .ron (a description), .msh, .vtk, .mesh or .veg (tetrahedra)";

/// Contents of a file.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Input {
    /// Triangle surface.
    Surface(Surface),
    /// Description of a body by rounded parts.
    Sdf(Scene),
    /// Tetrahedra, ready to be baked.
    Tets(TetMesh),
}

impl Input {
    /// Returns the tetrahedra of the file, or those that [`stuff`] makes of the shape.
    ///
    /// A defective surface (holes, flipped faces, copies, crossing parts) is repaired first. The
    /// second value lists the repairs. `None` means that no repair was necessary.
    ///
    /// # Errors
    /// Returns the errors of [`SurfaceDistance::mended`] and [`stuff`].
    pub fn into_tets(
        self,
        options: &StuffOptions,
        progress: &mut dyn FnMut(f32),
    ) -> Result<(TetMesh, Option<Repair>), MeshError> {
        match self {
            Self::Surface(surface) => {
                let (solid, repair) = SurfaceDistance::mended(&surface)?;
                Ok((stuff(&solid, options, progress)?, repair))
            }
            Self::Sdf(scene) => Ok((stuff(&scene, options, progress)?, None)),
            Self::Tets(mesh) => Ok((mesh, None)),
        }
    }
}

/// Reads a file of any known format. The extension determines the format.
///
/// # Errors
/// Returns [`MeshError::UnknownFormat`] for an extension that is not in the module's table, and
/// otherwise the errors of [`read_surface`], [`read_tets`] and [`read_sdf`].
pub fn read(path: impl AsRef<Path>) -> Result<Input, MeshError> {
    let path = path.as_ref();
    match extension(path).as_str() {
        "obj" | "stl" | "ply" | "gltf" | "glb" => read_surface(path).map(Input::Surface),
        "msh" | "vtk" | "mesh" | "veg" => read_tets(path).map(Input::Tets),
        "ron" => read_sdf(path).map(Input::Sdf),
        _ => Err(unknown(path, ALL)),
    }
}

/// Reads a triangle surface with finite coordinates and valid indices.
///
/// The surface may be open or cross itself, which is acceptable for a visible skin.
/// [`Surface::repaired`] repairs a surface that is to be filled with tetrahedra. Polygons are split
/// into fans. A vertex with several texture coordinates is split into one copy for each.
///
/// # Errors
/// Returns [`MeshError::UnknownFormat`], [`MeshError::Read`], or [`MeshError::InFile`] with the
/// error in the file.
pub fn read_surface(path: impl AsRef<Path>) -> Result<Surface, MeshError> {
    let path = path.as_ref();
    Ok(surface_of(path, &[], || bytes(path))?.0)
}

/// Reads a surface as [`read_surface`] does, with the numbers that its vertices have of each of the
/// `attributes`: accessors of single floats of a glTF file, such as `_STIFFNESS`.
///
/// A list is as long as the vertices, with NaN where a part of the surface lacks the attribute, or
/// empty where all lack it. Files of other formats have none.
///
/// # Errors
/// Returns the errors of [`read_surface`].
pub fn read_painted(
    path: impl AsRef<Path>,
    attributes: &[&str],
) -> Result<(Surface, Vec<Vec<f32>>), MeshError> {
    let path = path.as_ref();
    surface_of(path, attributes, || bytes(path))
}

/// Reads a surface from the bytes of a file, as [`read_painted`] does. The extension of `path`
/// determines the format, and the other files of a `.gltf` are looked for beside it.
///
/// # Errors
/// Returns the errors of [`read_surface`].
pub fn parse_painted(
    path: impl AsRef<Path>,
    bytes: &[u8],
    attributes: &[&str],
) -> Result<(Surface, Vec<Vec<f32>>), MeshError> {
    surface_of(path.as_ref(), attributes, || Ok(bytes))
}

fn surface_of<B: AsRef<[u8]>>(
    path: &Path,
    attributes: &[&str],
    bytes: impl FnOnce() -> Result<B, MeshError>,
) -> Result<(Surface, Vec<Vec<f32>>), MeshError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let bare = |surface| (surface, vec![Vec::new(); attributes.len()]);
    let parse: &dyn Fn(&[u8]) -> Result<_, MeshError> = match extension(path).as_str() {
        "obj" => &|bytes| obj::parse(bytes).map(bare),
        "stl" => &|bytes| stl::parse(bytes).map(bare),
        "ply" => &|bytes| ply::parse(bytes).map(bare),
        "gltf" | "glb" => &|bytes| gltf::parse(bytes, folder, attributes),
        _ => return Err(unknown(path, SURFACES)),
    };
    let bytes = bytes()?;
    in_file(path, || {
        let read = parse(bytes.as_ref())?;
        read.0.check()?;
        Ok(read)
    })
}

/// Reads a tetrahedral mesh. The result passes [`TetMesh::check`].
///
/// Only the corners of 10-node tetrahedra are kept. Elements of other kinds and nodes that no
/// tetrahedron uses are ignored. Tetrahedra that are inside out are turned.
///
/// # Errors
/// Returns [`MeshError::UnknownFormat`], [`MeshError::Read`], or [`MeshError::InFile`] with the
/// error in the file.
pub fn read_tets(path: impl AsRef<Path>) -> Result<TetMesh, MeshError> {
    let path = path.as_ref();
    let parse = match extension(path).as_str() {
        "msh" => msh::parse,
        "vtk" => vtk::parse,
        "mesh" => medit::parse,
        "veg" => vega::parse,
        _ => return Err(unknown(path, TETS)),
    };
    let bytes = bytes(path)?;
    in_file(path, || {
        let mut mesh = parse(&bytes)?;
        mesh.drop_unused_nodes();
        mesh.orient();
        mesh.check()?;
        Ok(mesh)
    })
}

/// Reads the description of a body, see [`Scene`].
///
/// # Errors
/// Returns [`MeshError::UnknownFormat`], [`MeshError::Read`], or [`MeshError::InFile`] with the
/// error of [`Scene::from_ron`].
pub fn read_sdf(path: impl AsRef<Path>) -> Result<Scene, MeshError> {
    let path = path.as_ref();
    if extension(path) != "ron" {
        return Err(unknown(path, SCENES));
    }
    let bytes = bytes(path)?;
    in_file(path, || Scene::from_ron(&String::from_utf8_lossy(&bytes)))
}

/// Writes Gmsh MSH 4.1 as text. Reading the file back gives the same mesh to the last bit.
///
/// The file appears under its name only when it is complete. An error leaves no file, or the
/// earlier file.
///
/// # Errors
/// Returns the errors of [`TetMesh::check`], or [`MeshError::Write`].
pub fn write_msh(path: impl AsRef<Path>, mesh: &TetMesh) -> Result<(), MeshError> {
    write_msh_version(path, mesh, MshVersion::V4_1)
}

/// Writes Gmsh MSH as text in the wanted version, otherwise as [`write_msh`] does.
///
/// # Errors
/// Returns the errors of [`write_msh`].
pub fn write_msh_version(
    path: impl AsRef<Path>,
    mesh: &TetMesh,
    version: MshVersion,
) -> Result<(), MeshError> {
    mesh.check()?;
    write_text(path.as_ref(), &msh::format(mesh, version))
}

/// Writes tetrahedra in the format of the extension, otherwise as [`write_msh`] does.
///
/// # Errors
/// Returns [`MeshError::UnknownFormat`] or the errors of [`write_msh`].
pub fn write_tets(path: impl AsRef<Path>, mesh: &TetMesh) -> Result<(), MeshError> {
    let path = path.as_ref();
    let format: &dyn Fn(&TetMesh) -> String = match extension(path).as_str() {
        "msh" => &|mesh| msh::format(mesh, MshVersion::V4_1),
        "vtk" => &vtk::format,
        "mesh" => &medit::format,
        "veg" => &vega::format,
        _ => return Err(unknown(path, TETS)),
    };
    mesh.check()?;
    write_text(path, &format(mesh))
}

/// Writes a surface without its texture coordinates as `.ply`.
///
/// # Errors
/// Returns [`MeshError::UnknownFormat`] for another extension, the errors of [`Surface::check`],
/// and [`MeshError::Write`].
pub fn write_surface(path: impl AsRef<Path>, surface: &Surface) -> Result<(), MeshError> {
    let path = path.as_ref();
    if extension(path) != "ply" {
        return Err(unknown(path, ".ply"));
    }
    surface.check()?;
    write_text(path, &ply::format(surface))
}

fn extension(path: &Path) -> String {
    path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase()
}

fn unknown(path: &Path, expected: &'static str) -> MeshError {
    MeshError::UnknownFormat { path: path.to_owned(), expected }
}

fn in_file<T>(path: &Path, parse: impl FnOnce() -> Result<T, MeshError>) -> Result<T, MeshError> {
    parse().map_err(|source| MeshError::InFile { path: path.to_owned(), source: Box::new(source) })
}

fn bytes(path: &Path) -> Result<Vec<u8>, MeshError> {
    let failed = |source| MeshError::Read { path: path.to_owned(), source };
    let mut bytes = Vec::new();
    fs::File::open(path).and_then(|f| f.take(MAX_FILE + 1).read_to_end(&mut bytes)).map_err(failed)?;
    if bytes.len() as u64 > MAX_FILE {
        return Err(MeshError::parameter("size of the file", format!("at most {MAX_FILE} bytes"), "more"));
    }
    Ok(bytes)
}

fn write_text(path: &Path, text: &str) -> Result<(), MeshError> {
    write_whole(path, |file| file.write_all(text.as_bytes()))
        .map_err(|source| MeshError::Write { path: path.to_owned(), source })
}

/// Writes a file either completely or not at all.
///
/// The function writes a temporary file in the same folder and then renames it, so that no reader
/// sees a partial file. The temporary file is new: a file or link that waits at its name is neither
/// followed nor overwritten. On Unix the folder is synced as well, so that the new name outlives a
/// loss of power. A link to a file stays a link. A path that is not a regular file (a device,
/// a pipe) is written directly.
///
/// # Errors
/// Returns the errors of `write` and of the operating system. An earlier file is then still intact.
pub fn write_whole(
    path: &Path,
    write: impl FnOnce(&mut fs::File) -> std::io::Result<()>,
) -> std::io::Result<()> {
    // A file that does not exist yet has no other name.
    let goal = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    if fs::metadata(&goal).is_ok_and(|goal| !goal.is_file()) {
        return write(&mut fs::OpenOptions::new().write(true).open(&goal)?);
    }
    let name = goal.file_name().ok_or_else(|| std::io::Error::other("the path names no file"))?;
    let (mut file, part) = new_part(&goal, name)?;
    write(&mut file).and_then(|()| file.sync_all()).and_then(|()| fs::rename(&part, &goal)).inspect_err(
        |_| {
            // The caller needs the first error.
            let _ = fs::remove_file(&part);
        },
    )?;
    // Not every file system syncs folders, and the file is there in any case.
    #[cfg(unix)]
    if let Some(folder) = goal.parent() {
        // A bare name is in the current folder.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let _ = fs::File::open(folder).and_then(|folder| folder.sync_all());
    }
    Ok(())
}

/// Creates a temporary file beside `goal` that did not exist before.
fn new_part(goal: &Path, name: &std::ffi::OsStr) -> std::io::Result<(fs::File, std::path::PathBuf)> {
    /// Most names that are tried, because files of killed writers may have them.
    const MAX: usize = 1000;
    // Two threads that write the same file use different temporary files, and the last rename wins.
    static WRITES: AtomicU64 = AtomicU64::new(0);
    let mut last = std::io::Error::from(std::io::ErrorKind::AlreadyExists);
    for _ in 0..MAX {
        let number = WRITES.fetch_add(1, Ordering::Relaxed);
        let mut part = name.to_owned();
        part.push(format!(".{}.{number}.part", std::process::id()));
        let part = goal.with_file_name(part);
        match fs::OpenOptions::new().write(true).create_new(true).open(&part) {
            Ok(file) => return Ok((file, part)),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => last = error,
            Err(error) => return Err(error),
        }
    }
    Err(last)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    fn folder(name: &str) -> std::path::PathBuf {
        let folder = std::env::temp_dir().join(format!("pliant_mesh-{name}-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        folder
    }

    #[cfg(unix)]
    #[test]
    fn a_link_stays_a_link_and_a_device_stays_a_device() {
        use std::os::unix::fs::{FileTypeExt, symlink};

        let folder = folder("links");
        let (link, null) = (folder.join("link.msh"), folder.join("null.msh"));
        fs::write(folder.join("real.msh"), "something old").unwrap();
        symlink("real.msh", &link).unwrap();
        symlink("/dev/null", &null).unwrap();
        let mesh = shapes::sphere(4, 0.1).unwrap();
        write_msh(&link, &mesh).unwrap();
        assert!(link.symlink_metadata().unwrap().is_symlink());
        assert_eq!(read_tets(folder.join("real.msh")).unwrap().tets.len(), mesh.tets.len());
        write_msh(&null, &mesh).unwrap();
        assert!(fs::metadata("/dev/null").unwrap().file_type().is_char_device());
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 3, "nothing is left over");
        fs::remove_dir_all(folder).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn a_link_that_waits_at_the_temporary_name_is_not_followed() {
        let folder = folder("planted");
        let (path, victim) = (folder.join("ball.msh"), folder.join("victim"));
        fs::write(&victim, "somebody else's").unwrap();
        for number in 0..64 {
            let part = folder.join(format!("ball.msh.{}.{number}.part", std::process::id()));
            std::os::unix::fs::symlink(&victim, part).unwrap();
        }
        write_msh(&path, &shapes::sphere(4, 0.1).unwrap()).unwrap();
        assert_eq!(fs::read_to_string(&victim).unwrap(), "somebody else's");
        assert!(path.symlink_metadata().unwrap().is_file());
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_written_mesh_is_read_back_and_nothing_else_is_left() {
        let folder = folder("round-trip");
        let path = folder.join("ball.msh");
        let mesh = shapes::sphere(4, 0.1).unwrap();
        fs::write(&path, "something old").unwrap();
        write_msh(&path, &mesh).unwrap();
        assert_eq!(read_tets(&path).unwrap(), mesh);
        assert!(matches!(read(&path), Ok(Input::Tets(read)) if read == mesh));
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        for name in ["ball.vtk", "ball.mesh", "ball.veg", "BALL.MSH"] {
            write_tets(folder.join(name), &mesh).unwrap();
            assert_eq!(read_tets(folder.join(name)).unwrap(), mesh, "{name}");
        }
        assert!(matches!(write_tets(folder.join("ball.obj"), &mesh), Err(MeshError::UnknownFormat { .. })));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_failed_write_leaves_what_was_there() {
        let folder = folder("failed-write");
        let path = folder.join("bad.msh");
        fs::write(&path, "something old").unwrap();
        let mut mesh = shapes::cube(1, 1.0).unwrap();
        mesh.nodes[0][0] = f64::NAN;
        assert!(matches!(write_msh(&path, &mesh), Err(MeshError::NotFinite { .. })));
        assert_eq!(fs::read_to_string(&path).unwrap(), "something old");
        let nowhere = folder.join("no/such/folder.msh");
        mesh.nodes[0][0] = 0.0;
        assert!(matches!(write_msh(&nowhere, &mesh), Err(MeshError::Write { .. })));
        // A folder has the name of the file. The temporary file must not stay behind.
        fs::create_dir(folder.join("taken.msh")).unwrap();
        assert!(matches!(write_msh(folder.join("taken.msh"), &mesh), Err(MeshError::Write { .. })));
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 2);
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn what_cannot_be_read_is_named_with_its_path() {
        let folder = folder("bad-input");
        let message = |name: &str, content: &[u8]| {
            let path = folder.join(name);
            fs::write(&path, content).unwrap();
            read(&path).unwrap_err().to_string()
        };
        assert!(message("a.xyz", b"").contains("a.xyz: the extension names no known format"));
        assert!(message("a.obj", b"").contains("a.obj: expected at least one triangle"));
        assert!(
            message("a.msh", b"")
                .contains("a.msh: MSH, line 1: expected $MeshFormat, found the end of the file")
        );
        assert!(message("b.msh", b"\x7fELF\xff\xfe\0\0").contains("expected $MeshFormat"));
        assert!(matches!(read(folder.join("none.obj")), Err(MeshError::Read { .. })));
        assert!(matches!(read_tets(folder.join("a.obj")), Err(MeshError::UnknownFormat { .. })));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_surface_that_is_to_be_filled_is_mended_and_refused_where_it_bounds_nothing() {
        let folder = folder("open");
        let (ball, _) = shapes::sphere(4, 0.1).unwrap().boundary();
        let mut text: String = ball.positions.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
        let faces: Vec<String> =
            ball.triangles.iter().map(|t| format!("f {} {} {}\n", t[0] + 1, t[1] + 1, t[2] + 1)).collect();
        text += &faces.concat();
        let path = folder.join("ball.obj");
        let filled = |text: &str| {
            fs::write(&path, text).unwrap();
            read(&path)?.into_tets(&StuffOptions::with_target(1000), &mut |_| ())
        };
        let (sound, none) = filled(&text).unwrap();
        sound.check().unwrap();
        assert_eq!(none, None);
        // The text is cut within the last line, and after the line before it.
        let cut = text.len() - 8;
        assert!(matches!(filled(&text[..cut]), Err(MeshError::InFile { .. })));
        let cut = text.len() - faces[faces.len() - 1].len();
        let (mended, repair) = filled(&text[..cut]).unwrap();
        assert_eq!(repair, Some(Repair { covered_holes: 1, ..Repair::default() }));
        assert_eq!(repair.unwrap().to_string(), "1 hole covered");
        // The missing triangle itself covers the hole.
        assert!((mended.volume() / sound.volume() - 1.0).abs() < 1e-3, "{}", mended.volume());
        // Without every second triangle the holes are too large a part of the ball.
        let half: String = ball.positions.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
        let half = half + &faces.iter().step_by(2).cloned().collect::<String>();
        assert!(matches!(filled(&half), Err(MeshError::Open { .. })));
        // Both sides of one triangle form a closed surface with nothing inside.
        let doubled = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 3 2\n";
        assert!(matches!(filled(doubled), Err(MeshError::Parameter { name: "box around the shape", .. })));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_written_surface_is_read_again() {
        let folder = std::env::temp_dir().join(format!("pliant-ply-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let (surface, _) = crate::shapes::bar([3, 2, 1], [1.0, 1.0 / 3.0, 1e-9]).unwrap().boundary();
        let file = folder.join("bar.ply");
        write_surface(&file, &surface).unwrap();
        assert_eq!(read_surface(&file).unwrap(), surface);
        let none = Surface::default();
        assert!(matches!(write_surface(&file, &none), Err(MeshError::Empty { .. })));
        assert!(matches!(
            write_surface(folder.join("bar.stl"), &surface),
            Err(MeshError::UnknownFormat { .. })
        ));
        fs::remove_dir_all(&folder).unwrap();
    }

    mod any_bytes {
        use super::*;
        use proptest::{prelude::*, test_runner::RngSeed};

        /// A valid file with a few replaced bytes finds more errors than random bytes do.
        fn altered(text: String) -> impl Strategy<Value = Vec<u8>> {
            let length = text.len();
            proptest::collection::vec((0..length, any::<u8>()), 1..6).prop_map(move |changes| {
                let mut bytes = text.clone().into_bytes();
                for (at, byte) in changes {
                    bytes[at] = byte;
                }
                bytes
            })
        }

        fn any_reader(bytes: &[u8]) {
            let _ = Scene::from_ron(&String::from_utf8_lossy(bytes));
            for parse in [obj::parse, ply::parse, stl::parse, |b: &[u8]| {
                gltf::parse(b, Path::new("nowhere"), &["_STIFFNESS"]).map(|(surface, _)| surface)
            }] {
                let _ = parse(bytes).map(|s| s.check().and_then(|()| s.closed()));
                let _ = parse(bytes).map(|s| s.repaired());
            }
            for parse in [msh::parse, vtk::parse, medit::parse, vega::parse] {
                let _ = parse(bytes).map(|mut m| {
                    m.drop_unused_nodes();
                    m.orient();
                    m.check()
                });
            }
        }

        proptest! {
            #![proptest_config(ProptestConfig { failure_persistence: None, rng_seed: RngSeed::Fixed(2007), ..ProptestConfig::default() })]

            #[test]
            fn never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
                any_reader(&bytes);
            }

            #[test]
            fn in_an_altered_file_never_panic(bytes in prop_oneof![
                altered(msh::format(&shapes::cube(1, 1.0).unwrap(), MshVersion::V4_1)),
                altered(msh::format(&shapes::cube(1, 1.0).unwrap(), MshVersion::V2_2)),
                altered(vtk::format(&shapes::cube(1, 1.0).unwrap())),
                altered(medit::format(&shapes::cube(1, 1.0).unwrap())),
                altered(vega::format(&shapes::cube(1, 1.0).unwrap())),
                altered("v 0 0 0\nv 1 0 0\nvt 0 1\nv 0 1 0\nf 1/1 2/1 -1/-1\n".into()),
                altered("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                    element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n".into()),
                altered("solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n\
                    endfacet\nendsolid a\n".into()),
                altered(gltf::tests::document(gltf::tests::DATA, "3", gltf::tests::CHILDREN)),
            ]) {
                any_reader(&bytes);
            }
        }
    }
}
