//! Level of detail: draws only the modes that are visible, and warps only where the warping is
//! visible.

use bevy::{
    camera::{Camera, primitives::Aabb},
    math::Vec3A,
    prelude::*,
};

use super::drawing::Drawing;

/// The level of detail of a body's surface. Every [`ModalBody`](crate::ModalBody) has one.
///
/// The fastest modes, and the warping, are omitted as long as this moves no vertex by more than
/// [`tolerance`](Self::tolerance) in any view. A body that is far away, or whose fast modes do not
/// move, is drawn with fewer modes. The simulation, the force on the hand and the network are not
/// affected.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct SurfaceDetail {
    /// Largest distance of the drawn surface from the exact surface, in pixels of the view that
    /// shows the body largest. Zero draws all modes. Default: `0.1`.
    pub tolerance: f32,
}

impl Default for SurfaceDetail {
    fn default() -> Self {
        Self { tolerance: 0.1 }
    }
}

/// The part of a body's modes that is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Detail {
    /// Number of drawn modes, from the first.
    pub modes: usize,
    /// Whether modal warping is applied.
    pub warped: bool,
}

impl Detail {
    /// Whether a picture with this detail is sufficient where `needed` is required.
    pub fn covers(self, needed: Self) -> bool {
        self.modes >= needed.modes && (self.warped || !needed.warped)
    }

    /// Returns the least detail that keeps every vertex within `error` (m, body axes) of its exact
    /// position.
    ///
    /// The exact position uses all modes, and warping if the body `warps`.
    ///
    /// The warp is the mean of the rotations from 0 to `w`, `R~(w) = int_0^1 exp(t [w]x) dt`. As
    /// `exp` turns no faster than its argument, `|R~(w) - R~(w')| <= |w - w'| / 2`, and no singular
    /// value of `R~` exceeds one. Omitting mode `k` therefore moves a vertex by at most
    /// `|q_k| (reach_k + turn_k |d| / 2)`, and omitting the warp by at most `|w| |d| / 2`, with
    /// `|d| <= sum |q_k| reach_k` and `|w| <= sum |q_k| turn_k`.
    pub fn needed(drawing: &Drawing, q: &[f64], warps: bool, error: f64) -> Self {
        let sum = |by: &[f32]| -> f64 { q.iter().zip(by).map(|(q, &by)| q.abs() * f64::from(by)).sum() };
        let whole = sum(&drawing.reach);
        let lever = if warps { whole / 2.0 } else { 0.0 };
        let mut modes = q.len();
        let mut left_out = 0.0;
        while modes > 0 {
            let of = |by: &[f32]| f64::from(by.get(modes - 1).copied().unwrap_or(0.0));
            let next = left_out + q[modes - 1].abs() * (of(&drawing.reach) + of(&drawing.turn) * lever);
            if next > error || error.is_nan() {
                break;
            }
            left_out = next;
            modes -= 1;
        }
        let warped = warps && left_out + sum(&drawing.turn) * lever > error;
        Self { modes, warped }
    }
}

/// The views of a frame, reduced to what sizes on screen need.
pub(super) struct Views(Vec<CameraView>);

struct CameraView {
    eye: Vec3A,
    near: f32,
    /// Meters that a pixel covers: at a distance of one meter in perspective, anywhere in an
    /// orthographic view.
    meters: f32,
    perspective: bool,
}

impl Views {
    /// Returns the views of the active cameras.
    pub fn new<'a>(cameras: impl Iterator<Item = (&'a Camera, &'a GlobalTransform)>) -> Self {
        let view = |(camera, place): (&Camera, &GlobalTransform)| {
            let height = camera.physical_viewport_size()?.y as f32;
            let matrix = camera.clip_from_view();
            // Half of the picture's height is one unit of clip space.
            let meters = 2.0 / (matrix.y_axis.y.abs() * height);
            let perspective = matrix.w_axis.w == 0.0;
            // In a reversed-depth projection without a far plane, the last column holds the near
            // distance.
            let near = if perspective { matrix.w_axis.z.abs().max(1e-6) } else { 0.0 };
            (camera.is_active && meters.is_finite() && meters > 0.0).then_some(CameraView {
                eye: place.translation_vec3a(),
                near,
                meters,
                perspective,
            })
        };
        Self(cameras.filter_map(view).collect())
    }

    /// Returns the meters (world) that a pixel covers at the nearest point of the body, as the
    /// least over all views. Returns `None` if there is no view.
    pub fn meters_per_pixel(&self, bounds: &Aabb, place: &GlobalTransform) -> Option<f32> {
        let affine = place.affine();
        let center = affine.transform_point3a(bounds.center);
        let radius = place.radius_vec3a(bounds.half_extents);
        self.0
            .iter()
            .map(|view| {
                let distance = (center.distance(view.eye) - radius).max(view.near);
                if view.perspective { view.meters * distance } else { view.meters }
            })
            .reduce(f32::min)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::drawing::Drawings;
    use super::*;
    use crate::tests::model;

    /// Returns the largest distance by which the parts omitted by `detail` move any vertex.
    fn moved(drawing: &Drawing, q: &[f64], detail: Detail) -> f64 {
        let shape = |q: &[f64], warped: bool| {
            let q: Vec<f32> = q.iter().map(|&q| q as f32).collect();
            let mut positions = vec![[0.0; 3]; drawing.model.surface().positions().len()];
            drawing.model.basis().reconstruct(&q, warped, &mut positions);
            positions
        };
        shape(q, true)
            .iter()
            .zip(&shape(&q[..detail.modes], detail.warped))
            .map(|(a, b)| f64::from(Vec3::from(*a).distance(Vec3::from(*b))))
            .fold(0.0, f64::max)
    }

    #[test]
    fn what_is_left_out_moves_nothing_farther_than_allowed() {
        let drawing = Drawings::default().get(&Arc::new(model::bar()), 0.9);
        let mut kinds = std::collections::HashSet::new();
        for amplitude in [1e-4, 1e-2, 0.3, 2.0] {
            for error in [1e-6, 1e-4, 1e-3, 0.05] {
                let q = [amplitude, 0.3 * amplitude, -0.05 * amplitude, 0.002 * amplitude];
                let detail = Detail::needed(&drawing, &q, true, error);
                let off = moved(&drawing, &q, detail);
                // The margin is a rounding error of single precision at one meter.
                assert!(off <= error + 2e-7, "{off} m for {error}, {detail:?}");
                kinds.insert((detail.modes, detail.warped));
            }
        }
        // The test covers bodies drawn with no modes, with some modes and with all modes, with and
        // without warping.
        let has = |test: &dyn Fn(&(usize, bool)) -> bool| kinds.iter().any(test);
        assert!(has(&|k| k.0 == 0) && has(&|k| k.0 == 4) && has(&|k| (1..4).contains(&k.0)));
        assert!(has(&|k| k.1) && has(&|k| !k.1 && k.0 > 0), "{kinds:?}");
    }

    #[test]
    fn no_tolerance_draws_all_that_moves() {
        let drawing = Drawings::default().get(&Arc::new(model::bar()), 0.9);
        let detail = Detail::needed(&drawing, &[1e-3, 0.0, 0.0, 1e-9], true, 0.0);
        assert_eq!(detail, Detail { modes: 4, warped: true });
        assert_eq!(Detail::needed(&drawing, &[0.0; 4], true, 0.0), Detail { modes: 0, warped: false });
        // An invalid scale gives an error of NaN, for which everything is drawn.
        assert_eq!(Detail::needed(&drawing, &[1e-3; 4], true, f64::NAN).modes, 4);
    }
}
