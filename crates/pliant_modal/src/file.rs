//! The `.modal` file format.
//!
//! ```text
//! 8   magic "PLIANTMB"
//! 4   format version, u32
//! 8   payload length, u64
//! 32  BLAKE3 of the payload: the model's content hash
//! payload:
//!   4   length of the description, u32
//!   ..  description (postcard): counts and everything small
//!   ..  surface positions f32 x 3 n, triangles u32 x 3 t, texture coordinates f32 x 2 n (when there), anchored u8 x n
//!   ..  displacement f32 x 3 n m, rotation f32 x 3 n m, both [mode][vertex][axis]
//!   ..  sections (when there), each: tag of 4 bytes, length u64, content
//! ```
//!
//! Section `MESH` is the simulation mesh, with `c` corners, `t` tetrahedra and `k` nodes: c u32, t
//! u32, corners f32 x 3 c, tetrahedra u32 x 4 t, scales f32 x m, displacements i16 x 3 k m, and a
//! place u32 x 1, f32 x 6 for each surface vertex. It follows section `NLIN`, which is the reduced
//! elasticity of `p` points: material u8 (0 neo-Hookean, 1 St. Venant-Kirchhoff), `p` u32, weights
//! f64 x p, gradients f32 x 9 p m. A model without it has linear elasticity only. Section `STIF`,
//! f32 x t, follows `MESH` where the moduli differ: their factor in each tetrahedron. All numbers
//! are little-endian. A reader checks magic, version, length and hash before it decodes the
//! payload.

use std::{
    fs, io,
    io::Write,
    path::Path,
    sync::atomic::{AtomicU64, Ordering},
};

use serde::{Deserialize, Serialize};

use crate::{
    BakeInfo, FileError, FlexibilitySite, Material, ModalModel, ModelError, ModelParts, ReducedElasticity,
    SimulationMesh, SurfaceMesh, VertexPlace,
};

/// First bytes of a `.modal` file.
pub const MAGIC: [u8; 8] = *b"PLIANTMB";

/// Version of the format that this build reads and writes.
pub const FORMAT_VERSION: u32 = 1;

/// Tag of the section with the reduced elasticity.
const REDUCED: [u8; 4] = *b"NLIN";

/// Tag of the section with the simulation mesh.
const MESH: [u8; 4] = *b"MESH";

/// Tag of the section with the stiffness of the tetrahedra.
const STIFFNESS: [u8; 4] = *b"STIF";

const HEADER: usize = 8 + 4 + 8 + 32;

#[derive(Serialize, Deserialize)]
struct Description {
    info: BakeInfo,
    vertices: u32,
    triangles: u32,
    modes: u32,
    textured: bool,
    free: bool,
    omega: Vec<f64>,
    damping: Vec<f64>,
    participation: Vec<[f64; 3]>,
    mass: f64,
    center_of_mass: [f64; 3],
    inertia: [[f64; 3]; 3],
    sites: Vec<FlexibilitySite>,
}

pub(crate) fn encode(parts: &ModelParts) -> Vec<u8> {
    let surface = &parts.surface;
    let description = Description {
        info: parts.info.clone(),
        vertices: surface.positions().len() as u32,
        triangles: surface.triangles().len() as u32,
        modes: parts.omega.len() as u32,
        textured: surface.uvs().is_some(),
        free: parts.free,
        omega: parts.omega.clone(),
        damping: parts.damping.clone(),
        participation: parts.participation.clone(),
        mass: parts.mass,
        center_of_mass: parts.center_of_mass,
        inertia: parts.inertia,
        sites: parts.sites.clone(),
    };
    // Serializing plain data to memory cannot fail. Every reader would refuse an empty description.
    let description = postcard::to_stdvec(&description).unwrap_or_default();
    let mut bytes = vec![0; HEADER];
    bytes.extend((description.len() as u32).to_le_bytes());
    bytes.extend(description);
    let mut floats = |values: &[f32]| bytes.extend(values.iter().flat_map(|x| x.to_le_bytes()));
    floats(surface.positions().as_flattened());
    bytes.extend(surface.triangles().as_flattened().iter().flat_map(|x| x.to_le_bytes()));
    let mut floats = |values: &[f32]| bytes.extend(values.iter().flat_map(|x| x.to_le_bytes()));
    floats(surface.uvs().unwrap_or_default().as_flattened());
    bytes.extend(surface.anchored().iter().map(|&a| u8::from(a)));
    let mut floats = |values: &[f32]| bytes.extend(values.iter().flat_map(|x| x.to_le_bytes()));
    floats(&parts.displacement);
    floats(&parts.rotation);
    if let Some(reduced) = &parts.reduced {
        let mut section = vec![match reduced.material {
            Material::NeoHookean => 0,
            Material::StVenantKirchhoff => 1,
        }];
        section.extend((reduced.weights.len() as u32).to_le_bytes());
        section.extend(reduced.weights.iter().flat_map(|x| x.to_le_bytes()));
        section.extend(reduced.gradients.iter().flat_map(|x| x.to_le_bytes()));
        let mut add = |tag: [u8; 4], section: Vec<u8>| {
            bytes.extend(tag);
            bytes.extend((section.len() as u64).to_le_bytes());
            bytes.extend(section);
        };
        add(REDUCED, section);
        if let Some(mesh) = &reduced.mesh {
            add(MESH, encode_mesh(mesh));
            if !mesh.stiffness.is_empty() {
                add(STIFFNESS, mesh.stiffness.iter().flat_map(|x| x.to_le_bytes()).collect());
            }
        }
    }

    let hash = blake3::hash(&bytes[HEADER..]);
    let length = (bytes.len() - HEADER) as u64;
    bytes[..8].copy_from_slice(&MAGIC);
    bytes[8..12].copy_from_slice(&FORMAT_VERSION.to_le_bytes());
    bytes[12..20].copy_from_slice(&length.to_le_bytes());
    bytes[20..HEADER].copy_from_slice(hash.as_bytes());
    bytes
}

fn encode_mesh(mesh: &SimulationMesh) -> Vec<u8> {
    let mut section = Vec::new();
    section.extend((mesh.corners.len() as u32).to_le_bytes());
    section.extend((mesh.tets.len() as u32).to_le_bytes());
    section.extend(mesh.corners.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
    section.extend(mesh.tets.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
    section.extend(mesh.scales.iter().flat_map(|x| x.to_le_bytes()));
    section.extend(mesh.displacements.iter().flat_map(|x| x.to_le_bytes()));
    for place in &mesh.vertices {
        section.extend(place.element.to_le_bytes());
        section.extend(place.at.iter().chain(&place.offset).flat_map(|x| x.to_le_bytes()));
    }
    section
}

pub(crate) fn stored_hash(bytes: &[u8]) -> crate::ModelHash {
    let mut hash = [0; 32];
    if let Some(stored) = bytes.get(20..HEADER) {
        hash.copy_from_slice(stored);
    }
    crate::ModelHash(hash)
}

/// Splits `count` little-endian words off the front of `bytes`.
fn words<'a, const N: usize>(
    what: &'static str,
    bytes: &mut &'a [u8],
    count: usize,
) -> Result<impl Iterator<Item = [u8; N]> + use<'a, N>, FileError> {
    let need = count.saturating_mul(N);
    if bytes.len() < need {
        return Err(FileError::Truncated { what, expected: need as u64, got: bytes.len() as u64 });
    }
    let (head, rest) = bytes.split_at(need);
    *bytes = rest;
    Ok(head.chunks_exact(N).map(|c| std::array::from_fn(|i| c[i])))
}

fn triples<T: Copy + Default>(flat: impl Iterator<Item = T>) -> Vec<[T; 3]> {
    let flat: Vec<T> = flat.collect();
    flat.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect()
}

impl ModalModel {
    /// Encodes the model as the content of a `.modal` file.
    pub fn to_bytes(&self) -> Vec<u8> {
        encode(self.parts())
    }

    /// Decodes the content of a `.modal` file.
    ///
    /// This function never panics and allocates no more than a small multiple of the size of
    /// `bytes`.
    ///
    /// # Errors
    /// Returns a separate error for content that is another kind of file, has another version, is
    /// cut short, padded, altered, or inconsistent.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, FileError> {
        let magic = bytes.get(..8).unwrap_or(bytes);
        if magic != MAGIC {
            return Err(FileError::Magic(magic.to_vec()));
        }
        let Some(header) = bytes.get(..HEADER) else {
            return Err(FileError::Truncated {
                what: "header",
                expected: HEADER as u64,
                got: bytes.len() as u64,
            });
        };
        let version = u32::from_le_bytes(std::array::from_fn(|i| header[8 + i]));
        if version != FORMAT_VERSION {
            return Err(FileError::Version { expected: FORMAT_VERSION, got: version });
        }
        let length = u64::from_le_bytes(std::array::from_fn(|i| header[12 + i]));
        let payload = &bytes[HEADER..];
        if payload.len() as u64 != length {
            return Err(FileError::Truncated {
                what: "payload",
                expected: length,
                got: payload.len() as u64,
            });
        }
        let hash = blake3::hash(payload);
        if hash.as_bytes() != &header[20..HEADER] {
            let expected = stored_hash(bytes).to_string();
            return Err(FileError::Hash { expected, got: hash.to_hex().to_string() });
        }
        Ok(Self::from_checked_bytes(decode(payload)?, bytes)?)
    }

    /// Reads a `.modal` file.
    ///
    /// # Errors
    /// Returns [`FileError::Io`] if the file cannot be read, or [`FileError::In`] around the error
    /// of [`ModalModel::from_bytes`]. Both name the file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let path = path.as_ref();
        let name = || path.display().to_string();
        let bytes = fs::read(path).map_err(|source| FileError::Io { path: name(), source })?;
        Self::from_bytes(&bytes).map_err(|source| FileError::In { path: name(), source: Box::new(source) })
    }

    /// Writes a `.modal` file.
    ///
    /// The data are written to a new temporary file in the same folder, which is then renamed, so a
    /// reader never sees half a file. On Unix the folder is synced as well. A link to a file stays
    /// a link. If the path is not a regular file (a device, a pipe), the data are written directly
    /// into it.
    ///
    /// # Errors
    /// Returns [`FileError::Io`] if the operating system refuses.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), FileError> {
        let path = path.as_ref();
        write_whole(path, &self.to_bytes())
            .map_err(|source| FileError::Io { path: path.display().to_string(), source })
    }
}

fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // `canonicalize` fails for a file that does not exist yet. Such a path is used as it is.
    let goal = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    if fs::metadata(&goal).is_ok_and(|goal| !goal.is_file()) {
        return fs::OpenOptions::new().write(true).open(&goal)?.write_all(bytes);
    }
    let name = goal.file_name().ok_or(io::ErrorKind::InvalidFilename)?;
    let (mut file, partial) = new_partial(&goal, name)?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(&partial, &goal))
        .inspect_err(|_| {
            // The first error is the one to report. A failure to remove the temporary file adds no
            // information.
            let _ = fs::remove_file(&partial);
        })?;
    // Not every file system syncs folders, and the file is there in any case.
    #[cfg(unix)]
    if let Some(folder) = goal.parent() {
        // A bare name is in the current folder.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let _ = fs::File::open(folder).and_then(|folder| folder.sync_all());
    }
    Ok(())
}

/// Creates a temporary file beside `goal` that did not exist before. A file or link that waits at
/// its name is neither followed nor overwritten.
fn new_partial(goal: &Path, name: &std::ffi::OsStr) -> io::Result<(fs::File, std::path::PathBuf)> {
    /// Most names that are tried, because files of killed writers may have them.
    const MAX: usize = 1000;
    // Two threads that write the same file use separate temporary files. The last rename wins.
    static WRITES: AtomicU64 = AtomicU64::new(0);
    let mut last = io::Error::from(io::ErrorKind::AlreadyExists);
    for _ in 0..MAX {
        let write = WRITES.fetch_add(1, Ordering::Relaxed);
        let mut partial = name.to_owned();
        partial.push(format!(".{}.{write}.partial", std::process::id()));
        let partial = goal.with_file_name(partial);
        match fs::OpenOptions::new().write(true).create_new(true).open(&partial) {
            Ok(file) => return Ok((file, partial)),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => last = error,
            Err(error) => return Err(error),
        }
    }
    Err(last)
}

fn decode(payload: &[u8]) -> Result<ModelParts, FileError> {
    let mut rest = payload;
    let length =
        words::<4>("description length", &mut rest, 1)?.next().map_or(0, u32::from_le_bytes) as usize;
    if rest.len() < length {
        return Err(FileError::Truncated {
            what: "description",
            expected: length as u64,
            got: rest.len() as u64,
        });
    }
    let (description, mut rest) = rest.split_at(length);
    let d: Description = postcard::from_bytes(description).map_err(|e| FileError::Decode(e.to_string()))?;
    let (n, t, m) = (d.vertices as usize, d.triangles as usize, d.modes as usize);
    for (what, got) in
        [("omega", d.omega.len()), ("damping", d.damping.len()), ("participation", d.participation.len())]
    {
        if got != m {
            return Err(ModelError::Length { what, expected: m, got }.into());
        }
    }
    let shape = n.saturating_mul(3).saturating_mul(m);
    let positions =
        triples(words::<4>("surface positions", &mut rest, n.saturating_mul(3))?.map(f32::from_le_bytes));
    let triangles =
        triples(words::<4>("surface triangles", &mut rest, t.saturating_mul(3))?.map(u32::from_le_bytes));
    let uvs = if d.textured {
        let flat: Vec<f32> = words::<4>("texture coordinates", &mut rest, n.saturating_mul(2))?
            .map(f32::from_le_bytes)
            .collect();
        Some(flat.chunks_exact(2).map(|c| [c[0], c[1]]).collect())
    } else {
        None
    };
    let anchored = words::<1>("anchored flags", &mut rest, n)?.map(|[b]| b != 0).collect();
    let displacement = words::<4>("displacement", &mut rest, shape)?.map(f32::from_le_bytes).collect();
    let rotation = words::<4>("rotation", &mut rest, shape)?.map(f32::from_le_bytes).collect();
    let reduced = if rest.is_empty() { None } else { Some(reduced(&mut rest, m, n)?) };
    if !rest.is_empty() {
        return Err(FileError::Truncated { what: "nothing more", expected: 0, got: rest.len() as u64 });
    }
    Ok(ModelParts {
        info: d.info,
        surface: SurfaceMesh::new(positions, triangles, uvs, anchored)?,
        omega: d.omega,
        damping: d.damping,
        displacement,
        rotation,
        participation: d.participation,
        free: d.free,
        mass: d.mass,
        center_of_mass: d.center_of_mass,
        inertia: d.inertia,
        sites: d.sites,
        reduced,
    })
}

/// Splits the next section off the front of `rest`.
fn section<'a>(rest: &mut &'a [u8], tag: [u8; 4]) -> Result<&'a [u8], FileError> {
    let found = words::<4>("section tag", rest, 1)?.next().unwrap_or_default();
    if found != tag {
        return Err(FileError::Decode(format!(
            "a section {:?} that this version does not know",
            found.escape_ascii().to_string()
        )));
    }
    let length = words::<8>("section length", rest, 1)?.next().map_or(0, u64::from_le_bytes);
    let whole = usize::try_from(length).ok().filter(|&length| length <= rest.len());
    let Some(length) = whole else {
        return Err(FileError::Truncated { what: "section", expected: length, got: rest.len() as u64 });
    };
    let (section, tail) = rest.split_at(length);
    *rest = tail;
    Ok(section)
}

fn used_up(section: &[u8]) -> Result<(), FileError> {
    match section.len() {
        0 => Ok(()),
        more => {
            Err(FileError::Truncated { what: "nothing more in a section", expected: 0, got: more as u64 })
        }
    }
}

/// Decodes the sections with the reduced elasticity of `modes` coordinates.
fn reduced(rest: &mut &[u8], modes: usize, vertices: usize) -> Result<ReducedElasticity, FileError> {
    let mut bytes = section(rest, REDUCED)?;
    let material = match words::<1>("material", &mut bytes, 1)?.next() {
        Some([0]) => Material::NeoHookean,
        Some([1]) => Material::StVenantKirchhoff,
        other => {
            let text = format!("a material {other:?} that this version does not know");
            return Err(FileError::Decode(text));
        }
    };
    let points = words::<4>("cubature points", &mut bytes, 1)?.next().map_or(0, u32::from_le_bytes) as usize;
    let weights = words::<8>("cubature weights", &mut bytes, points)?.map(f64::from_le_bytes).collect();
    let count = points.saturating_mul(9).saturating_mul(modes);
    let gradients = words::<4>("cubature gradients", &mut bytes, count)?.map(f32::from_le_bytes).collect();
    used_up(bytes)?;
    let mut mesh = if rest.is_empty() { None } else { Some(mesh(section(rest, MESH)?, modes, vertices)?) };
    if let Some(mesh) = &mut mesh
        && !rest.is_empty()
    {
        let mut bytes = section(rest, STIFFNESS)?;
        let stiffness = words::<4>("tetrahedra's stiffness", &mut bytes, mesh.tets.len())?;
        mesh.stiffness = stiffness.map(f32::from_le_bytes).collect();
        used_up(bytes)?;
    }
    Ok(ReducedElasticity { material, weights, gradients, mesh })
}

/// Decodes the section with the simulation mesh.
fn mesh(mut bytes: &[u8], modes: usize, vertices: usize) -> Result<SimulationMesh, FileError> {
    let counts: Vec<usize> =
        words::<4>("mesh counts", &mut bytes, 2)?.map(|word| u32::from_le_bytes(word) as usize).collect();
    let (corners, tets) = (counts[0], counts[1]);
    let corners =
        triples(words::<4>("corners", &mut bytes, corners.saturating_mul(3))?.map(f32::from_le_bytes));
    let flat: Vec<u32> =
        words::<4>("tetrahedra", &mut bytes, tets.saturating_mul(4))?.map(u32::from_le_bytes).collect();
    let tets = flat.as_chunks::<4>().0.to_vec();
    let scales = words::<4>("node scales", &mut bytes, modes)?.map(f32::from_le_bytes).collect();
    let places = vertices.saturating_mul(28);
    let nodes = bytes.len().saturating_sub(places) / 2;
    let displacements =
        words::<2>("node displacements", &mut bytes, nodes)?.map(i16::from_le_bytes).collect();
    let place = |word: [u8; 28]| {
        let at = |k: usize| std::array::from_fn(|i| word[4 * k + i]);
        let three = |k: usize| std::array::from_fn(|i| f32::from_le_bytes(at(k + i)));
        VertexPlace { element: u32::from_le_bytes(at(0)), at: three(1), offset: three(4) }
    };
    let vertices = words::<28>("vertex places", &mut bytes, vertices)?.map(place).collect();
    used_up(bytes)?;
    Ok(SimulationMesh { corners, tets, scales, displacements, vertices, stiffness: Vec::new() })
}
