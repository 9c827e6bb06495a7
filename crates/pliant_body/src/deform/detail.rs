//! Level of detail: as many modes as can be seen, and warping only where it shows.

use bevy::{
    camera::{Camera, primitives::Aabb},
    math::Vec3A,
    prelude::*,
};

use super::drawing::Drawing;

/// How finely a body is drawn. Every [`ModalBody`](crate::ModalBody) has one.
///
/// Modes are left out of the picture, the fastest first, and warping too, as long as no vertex moves by more than [`tolerance`](Self::tolerance)
/// in any view: a body far away, or one whose fast modes are still, is drawn with fewer. What is simulated, felt and sent is not touched.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct SurfaceDetail {
    /// How far the drawn surface may be from the exact one, in pixels of the view that shows it largest. Zero draws all modes. Default: `0.1`.
    pub tolerance: f32,
}

impl Default for SurfaceDetail {
    fn default() -> Self {
        Self { tolerance: 0.1 }
    }
}

/// What of a body's modes is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Detail {
    /// The first this many modes.
    pub modes: usize,
    /// Bent by modal warping.
    pub warped: bool,
}

impl Detail {
    /// Whether a picture with this detail is good enough where `needed` is asked for.
    pub fn covers(self, needed: Self) -> bool {
        self.modes >= needed.modes && (self.warped || !needed.warped)
    }

    /// The least detail at which no vertex is farther than `error` (m, body axes) from where all modes and warping (if the body `warps`) put it.
    ///
    /// The warp is the mean of the rotations from 0 to `w`, `R~(w) = int_0^1 exp(t [w]x) dt`; as `exp` turns no faster than its argument,
    /// `|R~(w) - R~(w')| <= |w - w'| / 2`, and no singular value of `R~` exceeds one. Leaving out mode `k` therefore moves a vertex by at most
    /// `|q_k| (reach_k + turn_k |d| / 2)`, and leaving out the warp by `|w| |d| / 2`, with `|d| <= sum |q_k| reach_k` and `|w| <= sum |q_k| turn_k`.
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

/// The views of a frame, as far as sizes on screen go.
pub(super) struct Views(Vec<View>);

struct View {
    eye: Vec3A,
    near: f32,
    /// Metres that a pixel covers: at one metre's distance in perspective, anywhere in an orthographic view.
    metres: f32,
    perspective: bool,
}

impl Views {
    /// Views of the cameras that are on.
    pub fn new<'a>(cameras: impl Iterator<Item = (&'a Camera, &'a GlobalTransform)>) -> Self {
        let view = |(camera, place): (&Camera, &GlobalTransform)| {
            let height = camera.physical_viewport_size()?.y as f32;
            let matrix = camera.clip_from_view();
            // Half the picture's height is one of clip space.
            let metres = 2.0 / (matrix.y_axis.y.abs() * height);
            let perspective = matrix.w_axis.w == 0.0;
            // Reversed depth without a far end: the near distance stands in the last column.
            let near = if perspective { matrix.w_axis.z.abs().max(1e-6) } else { 0.0 };
            (camera.is_active && metres.is_finite() && metres > 0.0).then_some(View {
                eye: place.translation_vec3a(),
                near,
                metres,
                perspective,
            })
        };
        Self(cameras.filter_map(view).collect())
    }

    /// Metres (world) that a pixel covers where the body is nearest, in the view where that is least; `None` when nobody looks.
    pub fn metres_per_pixel(&self, bounds: &Aabb, place: &GlobalTransform) -> Option<f32> {
        let affine = place.affine();
        let center = affine.transform_point3a(bounds.center);
        let radius = place.radius_vec3a(bounds.half_extents);
        self.0
            .iter()
            .map(|view| {
                let distance = (center.distance(view.eye) - radius).max(view.near);
                if view.perspective { view.metres * distance } else { view.metres }
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

    /// The farthest that leaving out what `detail` leaves out moves any vertex.
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
                // A rounding of single precision at one metre.
                assert!(off <= error + 2e-7, "{off} m for {error}, {detail:?}");
                kinds.insert((detail.modes, detail.warped));
            }
        }
        // The test saw bodies drawn with none of the modes, with some and with all, with and without warping.
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
        // An unsound scale asks for NaN: then everything is drawn.
        assert_eq!(Detail::needed(&drawing, &[1e-3; 4], true, f64::NAN).modes, 4);
    }
}
