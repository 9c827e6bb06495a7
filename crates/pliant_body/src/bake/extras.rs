//! Anchors and materials that a modeling program has stored with a model.

use pliant_bake::{Anchor, AnchorSyntax};
use serde::Deserialize;
use thiserror::Error;

use super::{BakeNode, BakeRequest};

/// Why the properties of a model do not say how to bake it.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum BakeExtrasError {
    /// The text is no JSON object, or a property has another type.
    #[error("the extras of the model cannot be read: {0}")]
    Json(String),
    /// An anchor cannot be read.
    #[error("the extras of the model have an anchor that cannot be read: {0}")]
    Anchor(#[from] AnchorSyntax),
}

#[derive(Deserialize)]
struct Extras {
    anchor: Option<Anchors>,
    stiffness: Option<f64>,
    density: Option<f64>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Anchors {
    One(String),
    Many(Vec<String>),
}

impl Extras {
    fn read(json: &str) -> Result<Self, BakeExtrasError> {
        let unread = |error: serde_json::Error| BakeExtrasError::Json(error.to_string());
        // A list would be read as the properties in their order.
        let object: serde_json::Map<String, serde_json::Value> =
            serde_json::from_str(json).map_err(unread)?;
        Self::deserialize(serde_json::Value::Object(object)).map_err(unread)
    }

    fn anchors(&self) -> Vec<String> {
        match &self.anchor {
            None => Vec::new(),
            Some(Anchors::One(one)) => vec![one.clone()],
            Some(Anchors::Many(many)) => many.clone(),
        }
    }
}

impl BakeRequest {
    /// Takes anchors and material from the custom properties of a model, which glTF calls extras:
    /// the JSON text in Bevy's `GltfExtras` of a node, or in its `GltfMeshExtras`.
    ///
    /// `anchor` is an [`Anchor`] such as `"y<0.01"`, or a list of them, in addition to those of the
    /// request. `stiffness` is Young's modulus, Pa, and `density` is in kg/m^3; both replace those
    /// of the request. Other properties are ignored. Numbers out of range fail the bake.
    ///
    /// # Errors
    /// Returns [`BakeExtrasError`] for a text that is no JSON object, and for a property of another
    /// type.
    ///
    /// ```
    /// # use bevy::prelude::*;
    /// # use pliant_body::{BakeExtrasError, BakeRequest};
    /// # fn bake(mesh: Handle<Mesh>) -> Result<BakeRequest, BakeExtrasError> {
    /// let extras = r#"{ "anchor": "y<0.01", "stiffness": 40000, "density": 950 }"#;
    /// BakeRequest::mesh(mesh).with_extras(extras)
    /// # }
    /// ```
    pub fn with_extras(mut self, json: &str) -> Result<Self, BakeExtrasError> {
        let extras = Extras::read(json)?;
        for anchor in &extras.anchors() {
            self.config.anchors.push(anchor.parse()?);
        }
        self.config.young = extras.stiffness.unwrap_or(self.config.young);
        self.config.density = extras.density.unwrap_or(self.config.density);
        Ok(self)
    }
}

impl BakeNode {
    /// Takes anchors and material from the custom properties of the node, as
    /// [`BakeRequest::with_extras`] does.
    ///
    /// # Errors
    /// Returns the errors of [`BakeRequest::with_extras`].
    pub fn with_extras(mut self, json: &str) -> Result<Self, BakeExtrasError> {
        let extras = Extras::read(json)?;
        let settings = &mut self.settings;
        for anchor in extras.anchors() {
            anchor.parse::<Anchor>()?;
            settings.anchors.push(anchor);
        }
        settings.young = extras.stiffness.unwrap_or(settings.young);
        settings.density = extras.density.unwrap_or(settings.density);
        Ok(self)
    }
}
