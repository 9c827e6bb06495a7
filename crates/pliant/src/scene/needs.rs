//! What a scene needs of the program and of the disk.

use std::{collections::HashMap, path::Path};

use super::error::nearest;
use super::locate::Step::{self, Field, Item};
use super::{BakeEntry, PatchEntry, SceneError, SceneErrorKind, SceneFile, hands};
use crate::modal::ModalModel;

/// Returns whether this program was compiled with a feature of this crate that scenes may need.
pub(super) fn compiled(feature: &str) -> bool {
    [
        ("net", cfg!(feature = "net")),
        ("haptics", cfg!(feature = "haptics")),
        ("rerun", cfg!(feature = "rerun")),
        ("bake", cfg!(feature = "bake")),
    ]
    .contains(&(feature, true))
}

impl SceneFile {
    /// Returns the requests of the scene that a program without some features cannot meet.
    ///
    /// `has` says for each feature of this crate whether the program was compiled with it. A
    /// `network` needs `net`, a `device` needs `haptics`, a `recording` needs `rerun`, and the
    /// `bake` of a body needs `bake`. Each unmet request gives one error
    /// ([`SceneErrorKind::Feature`]) at its position.
    ///
    /// ```
    /// # use pliant::scene::SceneFile;
    /// let scene = SceneFile::from_ron("(bodies: [], recording: (file: \"out.rrd\"))", "my.ron")?;
    /// assert!(scene.lacking(|_| true).is_empty());
    /// let error = scene.lacking(|feature| feature != "rerun")[0].to_string();
    /// assert!(error.starts_with("my.ron:1:25: this scene asks for a recording, and this program was compiled without `rerun`"), "{error}");
    /// # Ok::<(), pliant::scene::SceneError>(())
    /// ```
    pub fn lacking(&self, has: impl Fn(&str) -> bool) -> Vec<SceneError> {
        let scene = self.scene();
        let mut asked: Vec<(Vec<Step>, &str, &str)> = Vec::new();
        if scene.network.is_some() {
            asked.push((vec![Field("network")], "a network", "net"));
        }
        if scene.device.is_some() {
            asked.push((vec![Field("device")], "a device", "haptics"));
        }
        if scene.recording.is_some() {
            asked.push((vec![Field("recording")], "a recording", "rerun"));
        }
        for (entry, _) in scene.bodies.iter().enumerate().filter(|(_, body)| body.bake.is_some()) {
            asked.push((vec![Field("bodies"), Item(entry), Field("bake")], "a bake", "bake"));
        }
        asked.retain(|(.., feature)| !has(feature));
        let missing = |(path, what, feature): (Vec<Step>, &str, &str)| {
            let message = format!(
                "this scene asks for {what}, and this program was compiled without `{feature}` (a feature of `pliant`)"
            );
            self.error(&path, SceneErrorKind::Feature, message)
        };
        asked.into_iter().map(missing).collect()
    }

    /// Reads the files that the scene names and reports those that are missing or invalid.
    ///
    /// Nothing is played. Files are looked up under the folder of assets. Models are read whole and
    /// must have the vertices that hands hold by number. Shapes are read too if the feature `bake`
    /// is compiled; otherwise they must only open.
    ///
    /// Each model file is read once, however many bodies use it; the files may be longer than
    /// `MAX_BYTES`. Errors are [`SceneErrorKind::Asset`], and [`SceneErrorKind::Open`] for a
    /// `recording` whose folder does not exist. The folder of the recording is looked up below the
    /// working directory and is not created.
    pub fn check_files(&self, assets: impl AsRef<Path>) -> Vec<SceneError> {
        let (assets, scene) = (assets.as_ref(), self.scene());
        let mut wrong = Vec::new();
        // For each model file: its number of vertices, or its error. For each body: its model file.
        let mut read: HashMap<&str, Result<usize, String>> = HashMap::new();
        let mut models: HashMap<String, &str> = HashMap::new();
        for (entry, body) in scene.bodies.iter().enumerate() {
            let here = [Field("bodies"), Item(entry)];
            if let Some(file) = body.model.as_deref() {
                let model = read.entry(file).or_insert_with(|| {
                    there(assets, file)?;
                    let model = ModalModel::read(assets.join(file)).map_err(|error| error.to_string())?;
                    Ok(model.surface().positions().len())
                });
                models.extend((0..body.count()).map(|copy| (body.name_of(copy), file)));
                if let Err(error) = model {
                    let message = format!("the body `{}` cannot be loaded: {error}", body.name);
                    let path = [here.as_slice(), &[Field("model")]].concat();
                    wrong.push(self.error(&path, SceneErrorKind::Asset, message));
                }
            }
            if let Some(Err(error)) = body.bake.as_ref().map(|bake| readable(assets, bake)) {
                let message = format!("the body `{}` cannot be made: {error}", body.name);
                let path = [here.as_slice(), &[Field("bake"), Field("shape")]].concat();
                wrong.push(self.error(&path, SceneErrorKind::Asset, message));
            }
        }
        for (entry, grab) in scene.grabs.iter().enumerate() {
            let PatchEntry::Vertex(vertex) = grab.patch else { continue };
            let Some(Ok(count)) = models.get(&grab.body).and_then(|model| read.get(model)) else { continue };
            if let Err(problem) = hands::vertex_there(vertex, *count) {
                let path = [Field("grabs"), Item(entry), Field("patch")];
                let message = hands::cannot_hold(grab, &problem);
                wrong.push(self.error(&path, SceneErrorKind::Asset, message));
            }
        }
        if let Some(error) = self.recording_writable(false) {
            wrong.push(error);
        }
        wrong
    }

    /// Returns the error that keeps the recording's file from being written, if the scene has a
    /// recording.
    ///
    /// With `make`, the file is created; the content of an existing file stays.
    pub(super) fn recording_writable(&self, make: bool) -> Option<SceneError> {
        let file = Path::new(self.scene().recording.as_ref()?.file.as_deref()?);
        let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
        let problem = if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
            format!("there is no folder {}", folder.display())
        } else if file.is_dir() {
            "it is a folder".to_owned()
        } else if make {
            // Opening in append mode keeps the content, in case the scene is not played after all.
            std::fs::OpenOptions::new().append(true).create(true).open(file).err()?.to_string()
        } else {
            return None;
        };
        let message = format!("cannot record to {}: {problem}", file.display());
        Some(self.error(&[Field("recording"), Field("file")], SceneErrorKind::Open, message))
    }
}

/// Checks that a file exists; otherwise the message suggests a similar name.
fn there(assets: &Path, file: &str) -> Result<(), String> {
    let path = assets.join(file);
    if path.exists() {
        return Ok(());
    }
    let folder = path.parent().unwrap_or(assets);
    let excerpt = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut message = format!("there is no {name} in {}", excerpt.display());
    let mut others: Vec<String> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .take(1000)
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    others.sort_unstable();
    if let Some(near) = nearest(&name, others.iter().map(String::as_str)) {
        message.push_str(&format!("; did you mean `{near}`?"));
    }
    Err(message)
}

#[cfg(feature = "bake")]
fn readable(assets: &Path, bake: &BakeEntry) -> Result<(), String> {
    there(assets, &bake.shape)?;
    crate::mesh::io::read(assets.join(&bake.shape)).map(drop).map_err(|error| error.to_string())
}

#[cfg(not(feature = "bake"))]
fn readable(assets: &Path, bake: &BakeEntry) -> Result<(), String> {
    there(assets, &bake.shape)?;
    let path = assets.join(&bake.shape);
    std::fs::File::open(&path).map(drop).map_err(|error| format!("{}: {error}", path.display()))
}
