//! Scenes that are read and checked, and the asset loader for scene files.

use std::{fs::File, io::Read, path::Path, sync::Arc};

use bevy::{
    asset::{Asset, AssetLoader, AsyncReadExt, LoadContext, io::Reader},
    reflect::TypePath,
};
use ron::extensions::Extensions;

use super::check::{self, SceneFault};
use super::locate::{Step, locate};
use super::syntax::refused;
use super::{MAX_BYTES, SceneDescription, SceneError, SceneErrorKind};

/// A scene that was read and checked, as a Bevy asset.
///
/// ```
/// use pliant::scene::SceneFile;
///
/// let scene = SceneFile::from_ron(r#"(bodies: [(name: "pip", model: "pip.modal")])"#, "in the documentation")?;
/// assert_eq!(scene.scene().bodies[0].name, "pip");
///
/// let wrong = SceneFile::from_ron(r#"(bodies: [(name: "pip", modle: "pip.modal")])"#, "pip.ron").unwrap_err();
/// assert!(wrong.to_string().starts_with("pip.ron:1:25: unknown field `modle` in Body; did you mean `model`?"));
/// # Ok::<(), pliant::scene::SceneError>(())
/// ```
#[derive(Asset, TypePath, Debug, Clone, PartialEq)]
pub struct SceneFile {
    origin: Arc<str>,
    /// The text, which locates mistakes that show later. Empty for a scene made in code.
    text: Arc<str>,
    scene: Arc<SceneDescription>,
}

impl SceneFile {
    /// Reads a scene file.
    ///
    /// # Errors
    /// Returns the errors of [`from_ron`](Self::from_ron), and [`SceneErrorKind::Read`] if the file
    /// cannot be read, is not text, or is longer than [`MAX_BYTES`].
    pub fn read(path: impl AsRef<Path>) -> Result<Self, SceneError> {
        let path = path.as_ref();
        let origin = path.display().to_string();
        let failed = |error: std::io::Error| {
            SceneError::without_place(
                &origin,
                SceneErrorKind::Read,
                format!("the scene cannot be read: {error}"),
            )
        };
        let file = File::open(path).map_err(failed)?;
        let mut bytes = Vec::new();
        file.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes).map_err(failed)?;
        Self::from_bytes(&bytes, &origin)
    }

    fn from_bytes(bytes: &[u8], origin: &str) -> Result<Self, SceneError> {
        if bytes.len() > MAX_BYTES {
            let message = format!("expected a scene of at most {MAX_BYTES} bytes, got a longer file");
            return Err(SceneError::without_place(origin, SceneErrorKind::Read, message));
        }
        match std::str::from_utf8(bytes) {
            Ok(text) => Self::from_ron(text, origin),
            Err(error) => {
                let good = String::from_utf8_lossy(&bytes[..error.valid_up_to()]);
                let message = "expected text in UTF-8, got bytes that are none".into();
                Err(SceneError::at(origin, &good, good.len(), SceneErrorKind::Read, message))
            }
        }
    }

    /// Reads a scene from a text. `origin` is the name of the text in errors.
    ///
    /// # Errors
    /// Each error has the line, the column and what was expected. The kinds are
    /// [`Syntax`](SceneErrorKind::Syntax) for a text that is not RON,
    /// [`Field`](SceneErrorKind::Field) for unknown or missing fields,
    /// [`Value`](SceneErrorKind::Value) for values out of their range, and
    /// [`Name`](SceneErrorKind::Name) for names that are defined twice or not at all. A text longer
    /// than [`MAX_BYTES`] gives [`SceneErrorKind::Read`].
    pub fn from_ron(text: &str, origin: impl AsRef<str>) -> Result<Self, SceneError> {
        let origin = origin.as_ref();
        if text.len() > MAX_BYTES {
            return Self::from_bytes(text.as_bytes(), origin);
        }
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let options = ron::Options::default().with_default_extension(Extensions::IMPLICIT_SOME);
        let scene: SceneDescription = options.from_str(text).map_err(|error| {
            // At the end of a text, the parser reports the position of the last character. It
            // reports the position after that character only if more text follows, so the parse is
            // repeated with a newline.
            let ended = format!("{text}\n");
            let again =
                options.from_str::<SceneDescription>(&ended).err().filter(|_| !text.trim().is_empty());
            refused(origin, text, &again.unwrap_or(error))
        })?;
        Self::checked(scene, origin, text)
    }

    /// Creates a scene from a description made in code.
    ///
    /// # Errors
    /// Returns the errors of [`from_ron`](Self::from_ron) without lines and columns.
    pub fn new(scene: SceneDescription) -> Result<Self, SceneError> {
        Self::checked(scene, "a scene made in code", "")
    }

    fn checked(scene: SceneDescription, origin: &str, text: &str) -> Result<Self, SceneError> {
        let checked = check::check(&scene);
        let file = Self { origin: origin.into(), text: text.into(), scene: Arc::new(scene) };
        match checked {
            Ok(()) => Ok(file),
            Err(SceneFault { path, kind, message, other }) => {
                let place =
                    other.map_or(0, |other| super::locate::line_and_column(text, locate(text, &other)).0);
                let place = if text.is_empty() { "another place".into() } else { format!("line {place}") };
                let message = message.replace("{line}", &place);
                Err(file.error(&path, kind, message))
            }
        }
    }

    /// Returns the description of the scene.
    pub fn scene(&self) -> &SceneDescription {
        &self.scene
    }

    /// Returns the name that errors use for the scene, usually the path of the file.
    pub fn origin(&self) -> &str {
        &self.origin
    }

    /// Creates an error about the value at `path`.
    pub(super) fn error(&self, path: &[Step], kind: SceneErrorKind, message: String) -> SceneError {
        if self.text.is_empty() {
            return SceneError::without_place(&self.origin, kind, message);
        }
        SceneError::at(&self.origin, &self.text, locate(&self.text, path), kind, message)
    }
}

/// Loads scene files (`.ron`) as [`SceneFile`]s.
#[derive(Default, TypePath)]
pub struct SceneFileLoader;

impl AssetLoader for SceneFileLoader {
    type Asset = SceneFile;
    type Settings = ();
    type Error = SceneError;

    async fn load(
        &self,
        reader: &mut dyn Reader,
        _settings: &Self::Settings,
        load_context: &mut LoadContext<'_>,
    ) -> Result<Self::Asset, Self::Error> {
        let origin = load_context.path().to_string();
        let mut bytes = Vec::new();
        let read = reader.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes).await;
        read.map_err(|error| {
            SceneError::without_place(
                &origin,
                SceneErrorKind::Read,
                format!("the scene cannot be read: {error}"),
            )
        })?;
        SceneFile::from_bytes(&bytes, &origin)
    }

    fn extensions(&self) -> &[&str] {
        &["scene.ron", "ron"]
    }
}
