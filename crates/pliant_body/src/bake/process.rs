//! Baking when assets are processed.

use std::path::Path;

use bevy::{
    asset::{
        io::Writer,
        processor::{Process, ProcessContext, ProcessError},
    },
    prelude::*,
    tasks::futures_lite::AsyncWriteExt,
};
use pliant_bake::{Paint, bake};
use pliant_mesh::{StuffOptions, io::Input};
use pliant_modal::ModalModel;

use super::{BakeBodyError, BakeSettings};
use crate::ModalAssetLoader;

/// Bakes a surface file (`.glb`, `.gltf` with its data inside, `.obj`, `.stl`, `.ply`) when assets
/// are processed, so that the game loads a baked body. [`BakePlugin`](crate::BakePlugin) registers
/// it.
///
/// A file is baked if the `.meta` file beside it says so, here `bud.glb.meta`:
///
/// ```text
/// (
///     meta_format_version: "1.0",
///     asset: Process(
///         processor: "BakeProcessor",
///         settings: (modes: 30, young: 4e4, anchors: ["y<0.02"]),
///     ),
/// )
/// ```
///
/// `assets.load::<ModalAsset>("bud.glb")` is then the baked body, with the surface of the file and
/// its texture coordinates. A game of processed assets needs neither this processor nor the feature
/// `bake`. What is painted on the surface of a `.glb` ([`Paint::ATTRIBUTES`]) counts. Its custom
/// properties are not read here: the settings have what they say.
#[derive(Debug, Default, Clone, Copy, TypePath)]
pub struct BakeProcessor;

impl Process for BakeProcessor {
    type Settings = BakeSettings;
    type OutputLoader = ModalAssetLoader;

    async fn process(
        &self,
        context: &mut ProcessContext<'_>,
        settings: &Self::Settings,
        writer: &mut Writer,
    ) -> Result<(), ProcessError> {
        let path = context.path().path().to_path_buf();
        let mut bytes = Vec::new();
        let read = context.asset_reader().read_to_end(&mut bytes).await;
        read.map_err(|error| ProcessError::AssetTransformError(error.into()))?;
        let model = bake_file(settings, &path, &bytes);
        let model = model.map_err(|error| ProcessError::AssetTransformError(error.into()))?;
        let written = writer.write_all(&model.to_bytes()).await;
        written.map_err(|error| ProcessError::AssetSaveError(error.into()))
    }
}

fn bake_file(settings: &BakeSettings, path: &Path, bytes: &[u8]) -> Result<ModalModel, BakeBodyError> {
    // Invalid settings are refused before the long work starts.
    let mut config = settings.config()?;
    let (skin, paint) = Paint::parse(path, bytes)?;
    config.paint = paint;
    config.check()?;
    let options = StuffOptions::with_target(settings.tets);
    let (tets, repair) = Input::Surface(skin.clone()).into_tets(&options, &mut |_| ())?;
    if let Some(repair) = repair {
        warn!("{}: the surface was mended: {repair}", path.display());
    }
    Ok(bake(&tets, Some(&skin), &config, &mut |_, _| ())?.model)
}
