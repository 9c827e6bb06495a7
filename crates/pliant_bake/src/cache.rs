//! Content-addressed cache of bakes. A model that was already baked from the same input by the same
//! method is read from its file.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use pliant_mesh::{Surface, TetMesh, io::write_whole};
use pliant_modal::{Damping, FORMAT_VERSION, ModalModel};
use web_time::Instant;

use crate::{Bake, BakeConfig, BakeError, BakeTimes, Paint, Stage, bake};

/// Version of the bake method, which is part of every key.
///
/// Raise the version with every change that alters the result of a bake of the same input.
pub const METHOD_VERSION: u32 = 8;

/// First bytes of a file of the cache. The [`BakeKey`] of its bake (32 bytes) and the model, as in
/// a `.modal` file, follow.
const MAGIC: [u8; 8] = *b"PLBAKE\x001";

/// Age after which an unfinished file counts as abandoned by a writer that was killed.
const ABANDONED: Duration = Duration::from_secs(3600);

/// Key that identifies the input of a bake.
///
/// The key is a BLAKE3 hash of the bits of mesh and skin, of every number of the configuration, and
/// of the versions of the method and of the file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BakeKey([u8; 32]);

impl BakeKey {
    /// Computes the key of a bake. [`BakeConfig::export_matrices`] is not part of the key, because
    /// it does not change the model.
    pub fn new(mesh: &TetMesh, skin: Option<&Surface>, config: &BakeConfig) -> Self {
        let mut hash = Hasher(blake3::Hasher::new_derive_key("pliant bake"));
        hash.words(&[METHOD_VERSION, FORMAT_VERSION]);
        // The destructuring makes the compiler report a new field that is missing here.
        let BakeConfig {
            name,
            element,
            modes,
            material,
            young,
            poisson,
            density,
            damping,
            anchors,
            regions,
            paint,
            sites,
            site_radii,
            export_matrices: _,
        } = config;
        hash.text(name);
        hash.text(&element.to_string());
        hash.count(*modes);
        hash.text(&material.map_or_else(String::new, |material| material.to_string()));
        hash.numbers(&[*young, *poisson, *density]);
        match damping {
            Damping::Rayleigh { alpha, beta } => hash.tagged(0, &[*alpha, *beta]),
            Damping::Ratio(zeta) => hash.tagged(1, &[*zeta]),
            other => hash.text(&format!("{other:?}")),
        }
        hash.count(anchors.len());
        anchors.iter().for_each(|anchor| hash.text(&anchor.to_string()));
        hash.count(regions.len());
        regions.iter().for_each(|region| hash.text(&region.to_string()));
        hash.count(usize::from(paint.is_some()));
        if let Some(Paint { surface, stiffness, density, anchored }) = paint {
            hash.surface(surface);
            for values in [stiffness, density, anchored] {
                hash.count(values.len());
                hash.numbers(values);
            }
        }
        hash.count(sites.map_or(0, |sites| sites.saturating_add(1)));
        hash.count(site_radii.len());
        hash.numbers(site_radii);
        let TetMesh { nodes, tets } = mesh;
        hash.count(nodes.len());
        hash.numbers(nodes.as_flattened());
        hash.count(tets.len());
        hash.words(tets.as_flattened());
        hash.count(usize::from(skin.is_some()));
        if let Some(skin) = skin {
            hash.surface(skin);
        }
        Self(*hash.0.finalize().as_bytes())
    }
}

impl std::fmt::Display for BakeKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

struct Hasher(blake3::Hasher);

impl Hasher {
    fn count(&mut self, count: usize) {
        self.0.update(&(count as u64).to_le_bytes());
    }

    fn text(&mut self, text: &str) {
        self.count(text.len());
        self.0.update(text.as_bytes());
    }

    fn tagged(&mut self, tag: u8, numbers: &[f64]) {
        self.0.update(&[tag]);
        self.numbers(numbers);
    }

    fn numbers(&mut self, numbers: &[f64]) {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_bits().to_le_bytes()).collect();
        self.0.update(&bytes);
    }

    fn surface(&mut self, surface: &Surface) {
        let Surface { positions, triangles, uvs } = surface;
        self.count(positions.len());
        self.numbers(positions.as_flattened());
        self.count(triangles.len());
        self.words(triangles.as_flattened());
        self.count(uvs.as_ref().map_or(0, |uvs| uvs.len() + 1));
        let bits = uvs.iter().flatten().flatten().map(|x| x.to_bits());
        self.words(&bits.collect::<Vec<u32>>());
    }

    fn words(&mut self, words: &[u32]) {
        let bytes: Vec<u8> = words.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.0.update(&bytes);
    }
}

/// Folder of baked models, each a `.bake` file that is named by its [`BakeKey`] and contains it.
///
/// Any number of programs may use one folder at the same time, because a file appears either
/// complete or not at all. A file that was truncated, altered or replaced by another is rejected,
/// and the model is baked again. A file that says that it belongs to this bake is believed: the
/// folder must be writable by its user only. When the folder exceeds its
/// [`limit`](Self::with_limit) in bytes, the least recently used files are removed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BakeCache {
    folder: PathBuf,
    limit: u64,
}

impl BakeCache {
    /// Default size limit of a cache, bytes: 1 GiB.
    pub const DEFAULT_LIMIT: u64 = 1 << 30;

    /// Makes a cache in `folder`. The folder is created when the cache first stores a model.
    pub fn new(folder: impl Into<PathBuf>) -> Self {
        Self { folder: folder.into(), limit: Self::DEFAULT_LIMIT }
    }

    /// Returns the cache of the current user, which all programs share.
    ///
    /// The cache is the folder `pliant/bakes` in the system's folder for cached data. Returns
    /// `None` when the environment names no such folder.
    pub fn of_user() -> Option<Self> {
        dirs::cache_dir().map(|base| Self::new(base.join("pliant/bakes")))
    }

    /// Sets the size limit in bytes. A single model that is larger is not stored.
    #[must_use]
    pub fn with_limit(self, bytes: u64) -> Self {
        Self { limit: bytes, ..self }
    }

    /// Returns the folder of the cache.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the path of the file for a key, whether or not the file exists.
    pub fn path(&self, key: BakeKey) -> PathBuf {
        self.folder.join(format!("{key}.bake"))
    }

    /// Reads the model of a key, if the file exists and belongs to the key.
    fn find(&self, key: BakeKey) -> Option<ModalModel> {
        let path = self.path(key);
        let file = fs::metadata(&path).ok()?;
        if !file.is_file() || file.len() > self.limit {
            return None;
        }
        let bytes = fs::read(&path).ok()?;
        let model = bytes.strip_prefix(&MAGIC)?.strip_prefix(&key.0)?;
        // The hash inside the model proves that the file is complete.
        let model = ModalModel::from_bytes(model).ok()?;
        // The new modification time marks the file as recently used. A failure is ignored, so that
        // a read-only folder works too.
        if let Ok(file) = fs::File::options().append(true).open(&path) {
            let _ = file.set_modified(SystemTime::now());
        }
        Some(model)
    }

    fn keep(&self, key: BakeKey, model: &ModalModel) -> std::io::Result<()> {
        let bytes = model.to_bytes();
        if (MAGIC.len() + key.0.len() + bytes.len()) as u64 > self.limit {
            return Ok(());
        }
        fs::create_dir_all(&self.folder)?;
        write_whole(&self.path(key), |file| {
            file.write_all(&MAGIC)?;
            file.write_all(&key.0)?;
            file.write_all(&bytes)
        })?;
        self.prune(key)
    }

    /// Removes the least recently used files until the rest fits, and the files that killed writers
    /// left.
    fn prune(&self, newest: BakeKey) -> std::io::Result<()> {
        let now = SystemTime::now();
        let mut kept = Vec::new();
        for entry in fs::read_dir(&self.folder)? {
            let Ok(entry) = entry else { continue };
            let (path, Ok(file)) = (entry.path(), entry.metadata()) else { continue };
            let used = file.modified().unwrap_or(SystemTime::UNIX_EPOCH);
            let name = entry.file_name().to_string_lossy().into_owned();
            // Only files whose names have the form of this cache's names may be removed.
            let ours = name.len() > 64 && name.as_bytes()[..64].iter().all(u8::is_ascii_hexdigit);
            if !file.is_file() || !ours {
                continue;
            }
            // Earlier versions left `.modal` and `.partial` files.
            let unfinished = name.ends_with(".part") || name.ends_with(".partial");
            if unfinished && now.duration_since(used).is_ok_and(|age| age > ABANDONED) {
                let _ = fs::remove_file(&path);
            } else if (name.ends_with(".bake") || name.ends_with(".modal")) && path != self.path(newest) {
                kept.push((used, path, file.len()));
            }
        }
        kept.sort();
        let newest = fs::metadata(self.path(newest)).map_or(0, |file| file.len());
        let mut total = newest + kept.iter().map(|(_, _, bytes)| bytes).sum::<u64>();
        for (_, path, bytes) in kept {
            if total <= self.limit {
                break;
            }
            // The error is ignored, because another program may have removed the file first.
            let _ = fs::remove_file(path);
            total -= bytes;
        }
        Ok(())
    }
}

/// Result of [`bake_cached`].
#[derive(Debug)]
pub struct CachedBake {
    /// Baked model and its times. When the model was read from the cache, `total` is the time of
    /// the call and all other times are zero.
    pub bake: Bake,
    /// Whether the model was read from the cache.
    pub cached: bool,
    /// Error that prevented the cache from storing the model, if any. The bake itself is valid.
    pub not_kept: Option<std::io::Error>,
}

/// Bakes as [`bake()`](crate::bake()) does, unless `cache` already has the model for the same
/// input.
///
/// A cache that cannot be read or written only costs the time of the bake. With
/// [`BakeConfig::export_matrices`] the mesh is always baked, because the matrices are needed.
///
/// # Errors
/// Returns the errors of [`bake()`](crate::bake()).
pub fn bake_cached(
    cache: &BakeCache,
    mesh: &TetMesh,
    skin: Option<&Surface>,
    config: &BakeConfig,
    progress: &mut dyn FnMut(Stage, f64),
) -> Result<CachedBake, BakeError> {
    config.check()?;
    let begun = Instant::now();
    let key = BakeKey::new(mesh, skin, config);
    if config.export_matrices.is_none()
        && let Some(model) = cache.find(key)
    {
        progress(Stage::Surface, 1.0);
        let times = BakeTimes { total: begun.elapsed().as_secs_f64(), ..Default::default() };
        return Ok(CachedBake { bake: Bake { model, times }, cached: true, not_kept: None });
    }
    let bake = bake(mesh, skin, config, progress)?;
    let not_kept = cache.keep(key, &bake.model).err();
    Ok(CachedBake { bake, cached: false, not_kept })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use pliant_mesh::shapes;
    use pliant_modal::Element;

    use super::*;

    static FOLDERS: AtomicUsize = AtomicUsize::new(0);

    struct Folder(PathBuf);

    impl Folder {
        fn new() -> Self {
            let number = FOLDERS.fetch_add(1, Ordering::Relaxed);
            let name = format!("pliant_bake-cache-{}-{number}", std::process::id());
            Self(std::env::temp_dir().join(name))
        }

        fn files(&self) -> usize {
            fs::read_dir(&self.0).map_or(0, Iterator::count)
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    fn bar() -> TetMesh {
        shapes::bar([4, 2, 2], [0.4, 0.2, 0.2]).unwrap()
    }

    fn config() -> BakeConfig {
        BakeConfig {
            modes: 4,
            sites: Some(4),
            element: Element::Tet4,
            anchors: vec!["x<0.001".parse().unwrap()],
            ..BakeConfig::linear()
        }
    }

    fn made(cache: &BakeCache, config: &BakeConfig) -> CachedBake {
        bake_cached(cache, &bar(), None, config, &mut |_, _| ()).unwrap()
    }

    #[test]
    fn an_unchanged_bake_is_read_and_a_changed_one_made() {
        let folder = Folder::new();
        let cache = BakeCache::new(&folder.0);
        let first = made(&cache, &config());
        assert!(!first.cached && first.not_kept.is_none());
        let second = made(&cache, &config());
        assert!(second.cached);
        assert_eq!(second.bake.model, first.bake.model);
        assert!(!made(&cache, &BakeConfig { young: 1.1e5, ..config() }).cached);
        assert_eq!(folder.files(), 2);
        // An export of the matrices bypasses the cache.
        let export = BakeConfig { export_matrices: Some(folder.0.join("matrices")), ..config() };
        assert!(!made(&cache, &export).cached);
        assert!(folder.0.join("matrices/K.mtx").is_file());
    }

    #[test]
    fn every_part_of_the_input_is_in_the_key() {
        let (mesh, plain) = (bar(), config());
        let mut keys = vec![BakeKey::new(&mesh, None, &plain)];
        let painted = || Paint::new(bar().boundary().0);
        let changes: [&dyn Fn(&mut BakeConfig); 15] = [
            &|c| c.name = "x".into(),
            &|c| c.element = Element::Tet10,
            &|c| c.modes = 5,
            &|c| c.young = 1.0,
            &|c| c.poisson = 0.1,
            &|c| c.density = 1.0,
            &|c| c.damping = Damping::Ratio(0.5),
            &|c| c.damping = Damping::Rayleigh { alpha: 0.5, beta: 0.0 },
            &|c| c.anchors.clear(),
            &|c| c.regions = vec!["x>0.1: stiffness 2".parse().unwrap()],
            &|c| c.regions = vec!["x>0.1: density 2".parse().unwrap()],
            &|c| c.paint = Some(painted()),
            &|c| c.paint = Some(Paint { density: vec![1.0], ..painted() }),
            &|c| c.sites = None,
            &|c| c.site_radii = vec![0.03, 0.06],
        ];
        for change in changes {
            let mut other = plain.clone();
            change(&mut other);
            keys.push(BakeKey::new(&mesh, None, &other));
        }
        let mut moved = mesh.clone();
        moved.nodes[3][1] += 1e-16;
        assert_ne!(moved.nodes[3][1], mesh.nodes[3][1]);
        keys.push(BakeKey::new(&moved, None, &plain));
        let mut turned = mesh.clone();
        turned.tets[0].swap(0, 1);
        keys.push(BakeKey::new(&turned, None, &plain));
        let skin = mesh.boundary().0;
        keys.push(BakeKey::new(&mesh, Some(&skin), &plain));
        let mut textured = skin;
        textured.uvs = Some(vec![[0.0; 2]; textured.positions.len()]);
        keys.push(BakeKey::new(&mesh, Some(&textured), &plain));
        for (i, a) in keys.iter().enumerate() {
            assert!(keys[..i].iter().all(|b| a != b), "key {i} is another's too");
        }
        let exported = BakeConfig { export_matrices: Some("x".into()), ..plain };
        assert_eq!(BakeKey::new(&mesh, None, &exported), keys[0]);
    }

    #[test]
    fn cut_altered_and_foreign_files_are_baked_again() {
        let folder = Folder::new();
        let cache = BakeCache::new(&folder.0);
        let truth = made(&cache, &config()).bake.model;
        let path = cache.path(BakeKey::new(&bar(), None, &config()));
        let good = fs::read(&path).unwrap();
        let other = BakeConfig { young: 3e5, ..config() };
        made(&cache, &other);
        let foreign = fs::read(cache.path(BakeKey::new(&bar(), None, &other))).unwrap();
        let mut altered = good.clone();
        altered[good.len() / 2] ^= 1;
        for bad in [&good[..good.len() - 1], &[], &altered, &foreign, b"solid ascii stl"] {
            fs::write(&path, bad).unwrap();
            let again = made(&cache, &config());
            assert!(!again.cached && again.bake.model == truth);
            assert_eq!(fs::read(&path).unwrap(), good, "put right");
        }
        // A folder takes the place of the file, and then a file takes the place of the folder.
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        let kept = made(&cache, &config());
        assert!(!kept.cached && kept.not_kept.is_some());
        let blocked = BakeCache::new(folder.0.join("file"));
        fs::write(folder.0.join("file"), "").unwrap();
        let kept = made(&blocked, &config());
        assert!(kept.not_kept.is_some() && kept.bake.model == truth);
    }

    #[test]
    fn a_file_that_answers_for_another_key_is_baked_again() {
        // All that the file says of itself is the same: only the mesh is another.
        let folder = Folder::new();
        let cache = BakeCache::new(&folder.0);
        let other = shapes::bar([4, 2, 2], [0.4, 0.2, 0.3]).unwrap();
        let truth = made(&cache, &config()).bake.model;
        let foreign = bake_cached(&cache, &other, None, &config(), &mut |_, _| ()).unwrap().bake.model;
        assert_ne!(truth, foreign);
        let paths = [&bar(), &other].map(|mesh| cache.path(BakeKey::new(mesh, None, &config())));
        fs::copy(&paths[1], &paths[0]).unwrap();
        let again = made(&cache, &config());
        assert!(again.bake.model == truth, "the other mesh's model is given for this one");
        assert!(!again.cached && made(&cache, &config()).cached, "baked again, and put right");
    }

    #[test]
    fn the_folder_stays_within_its_limit_and_keeps_what_is_used() {
        let folder = Folder::new();
        let one = made(&BakeCache::new(&folder.0), &config()).bake.model.to_bytes().len() as u64;
        let cache = BakeCache::new(&folder.0).with_limit(3 * one + one / 2);
        let at = |k: usize| BakeConfig { young: 1e5 + k as f64, ..config() };
        fs::write(folder.0.join("notes.txt"), "not ours").unwrap();
        // Some file systems have a coarse clock, so all files are made a minute older.
        let age = || {
            for entry in fs::read_dir(&folder.0).unwrap() {
                let file = fs::File::options().append(true).open(entry.unwrap().path()).unwrap();
                let modified = file.metadata().unwrap().modified().unwrap();
                file.set_modified(modified - Duration::from_secs(60)).unwrap();
            }
        };
        for k in 1..6 {
            made(&cache, &at(k));
            age();
            // The first model is used in every round.
            assert!(made(&cache, &config()).cached, "after {k}");
            age();
        }
        assert_eq!(folder.files(), 4, "three models and a file that is not the cache's");
        assert!(made(&cache, &at(5)).cached && !made(&cache, &at(1)).cached);
        let none = BakeCache::new(folder.0.join("small")).with_limit(10);
        assert!(!made(&none, &config()).cached && !made(&none, &config()).cached);
    }

    #[test]
    fn many_at_once_are_no_trouble() {
        let folder = Folder::new();
        let cache = BakeCache::new(&folder.0);
        std::thread::scope(|scope| {
            let all: Vec<_> = (0..8).map(|_| scope.spawn(|| made(&cache, &config()))).collect();
            let models: Vec<_> = all.into_iter().map(|t| t.join().unwrap().bake.model).collect();
            assert!(models.windows(2).all(|pair| pair[0] == pair[1]));
        });
        assert_eq!(folder.files(), 1, "nothing half-written is left");
        assert!(made(&cache, &config()).cached);
    }
}
