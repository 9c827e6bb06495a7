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
use pliant_bake::{AnchorSyntax, BakeConfig, MaterialSyntax, RegionSyntax, bake};
use pliant_mesh::{
    StuffOptions,
    io::{Input, parse_surface},
};
use pliant_modal::{Damping, ModalModel};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::BakeBodyError;
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
/// `bake`. Painted attributes and custom properties of a `.glb` are not read here.
#[derive(Debug, Default, Clone, Copy, TypePath)]
pub struct BakeProcessor;

/// The settings of a [`BakeProcessor`]. What is not given has its default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BakeSettings {
    /// Approximate number of tetrahedra. Default: 10,000.
    pub tets: usize,
    /// Number of coordinates, or of modes of a linear body. Default: 36.
    pub modes: usize,
    /// Material for large strains: `"neo-hookean"`, `"st-venant-kirchhoff"`, or `"linear"` for
    /// none. Default: neo-Hookean.
    pub material: String,
    /// Young's modulus, Pa. Default: 1e5.
    pub young: f64,
    /// Poisson ratio. Default: 0.4.
    pub poisson: f64,
    /// Density, kg/m^3. Default: 1000.
    pub density: f64,
    /// Damping ratio of every mode. Default: 0.03.
    pub damping_ratio: f64,
    /// Regions that are fixed, such as `"y<0.02"`. Default: none, a free body.
    pub anchors: Vec<String>,
    /// Parts that are stiffer or heavier, such as `"y>0.2: stiffness 50"`. Default: none.
    pub regions: Vec<String>,
}

impl Default for BakeSettings {
    fn default() -> Self {
        let config = BakeConfig::default();
        let material = config.material_name();
        let BakeConfig { modes, young, poisson, density, .. } = config;
        let (anchors, regions) = (Vec::new(), Vec::new());
        Self { tets: 10_000, modes, material, young, poisson, density, damping_ratio: 0.03, anchors, regions }
    }
}

/// The reason why a file could not be baked.
#[derive(Debug, Error)]
enum BakeFileError {
    #[error("{0}")]
    Anchor(#[from] AnchorSyntax),
    #[error("{0}")]
    Region(#[from] RegionSyntax),
    #[error("{0}")]
    Material(#[from] MaterialSyntax),
    #[error("{0}")]
    Bake(#[from] BakeBodyError),
}

impl BakeSettings {
    fn bake(&self, path: &Path, bytes: &[u8]) -> Result<ModalModel, BakeFileError> {
        let config = BakeConfig {
            modes: self.modes,
            young: self.young,
            poisson: self.poisson,
            density: self.density,
            damping: Damping::Ratio(self.damping_ratio),
            anchors: self.anchors.iter().map(|text| text.parse()).collect::<Result<_, _>>()?,
            regions: self.regions.iter().map(|text| text.parse()).collect::<Result<_, _>>()?,
            ..BakeConfig::of_material(&self.material)?
        };
        // Invalid settings are refused before the long work starts.
        config.check().map_err(BakeBodyError::from)?;
        let skin = parse_surface(path, bytes).map_err(BakeBodyError::from)?;
        let options = StuffOptions::with_target(self.tets);
        let filled = Input::Surface(skin.clone()).into_tets(&options, &mut |_| ());
        let (tets, repair) = filled.map_err(BakeBodyError::from)?;
        if let Some(repair) = repair {
            warn!("{}: the surface was mended: {repair}", path.display());
        }
        let baked = bake(&tets, Some(&skin), &config, &mut |_, _| ()).map_err(BakeBodyError::from)?;
        Ok(baked.model)
    }
}

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
        let model = settings.bake(&path, &bytes);
        let model = model.map_err(|error| ProcessError::AssetTransformError(error.into()))?;
        let written = writer.write_all(&model.to_bytes()).await;
        written.map_err(|error| ProcessError::AssetSaveError(error.into()))
    }
}
