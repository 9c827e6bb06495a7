//! The baked body as a Bevy asset, and the loader of `.modal` files.

use std::sync::Arc;

use bevy::{
    asset::{Asset, AssetLoader, LoadContext, io::Reader},
    reflect::{Reflect, TypePath},
};
use pliant_modal::{FileError, ModalModel};
use thiserror::Error;

/// A baked body, shared by every [`ModalBody`](crate::ModalBody) that shows it.
///
/// The asset holds the modes, the surface and the quantities measured by the bake. The loader makes
/// it from a `.modal` file (`asset_server.load("bodies/imp.modal")`). Code makes it from a baked or
/// received model: `assets.add(ModalAsset::from(model))`.
#[derive(Asset, Reflect, Clone, Debug)]
#[reflect(opaque)]
#[reflect(Debug, Clone)]
pub struct ModalAsset(pub Arc<ModalModel>);

impl From<ModalModel> for ModalAsset {
    fn from(model: ModalModel) -> Self {
        Self(Arc::new(model))
    }
}

impl From<Arc<ModalModel>> for ModalAsset {
    fn from(model: Arc<ModalModel>) -> Self {
        Self(model)
    }
}

/// Loads `.modal` files. [`ModalModel::from_bytes`] checks the version, the hash and every number.
#[derive(Default, TypePath)]
pub struct ModalAssetLoader;

/// The reason why a `.modal` file could not be loaded as a [`ModalAsset`].
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ModalAssetError {
    /// The bytes could not be read.
    #[error("the file could not be read: {0}")]
    Read(#[from] std::io::Error),
    /// The bytes are not a model of this version, are truncated, or were altered.
    #[error("not a usable .modal file: {0}")]
    Model(#[from] FileError),
}

impl AssetLoader for ModalAssetLoader {
    type Asset = ModalAsset;
    type Settings = ();
    type Error = ModalAssetError;

    async fn load(
        &self,
        reader: &mut dyn Reader,
        _settings: &Self::Settings,
        _load_context: &mut LoadContext<'_>,
    ) -> Result<Self::Asset, Self::Error> {
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes).await?;
        Ok(ModalModel::from_bytes(&bytes)?.into())
    }

    fn extensions(&self) -> &[&str] {
        &["modal"]
    }
}
