//! How a body is made, as plain data.

use bevy::prelude::*;
use pliant_bake::BakeConfig;
use pliant_modal::Damping;
use serde::{Deserialize, Serialize};

use super::BakeBodyError;

/// How a [`BakeProcessor`](crate::BakeProcessor) or a [`BakeNode`](crate::BakeNode) makes a body:
/// the part of a [`BakeConfig`] that texts and numbers say. What is not given has its default.
#[derive(Reflect, Debug, Clone, PartialEq, Serialize, Deserialize)]
#[reflect(Debug, Default, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BakeSettings {
    /// Approximate number of tetrahedra. Default: 10,000.
    pub tets: usize,
    /// Number of coordinates, or of modes of a linear body, for which 60 is a good number. Default:
    /// 36.
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
    /// Regions that are fixed, such as `"y<0.02"`, beside what is painted. Default: none, a free
    /// body.
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

impl BakeSettings {
    /// Returns what the settings say for a bake, all else at its default.
    ///
    /// # Errors
    /// Returns an error for an anchor, a region or a material that cannot be read, and for numbers
    /// out of range.
    pub fn config(&self) -> Result<BakeConfig, BakeBodyError> {
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
        config.check()?;
        Ok(config)
    }
}
