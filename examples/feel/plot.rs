//! A plot of the force over time in a corner of the window, with every period of the device loop.
#![allow(dead_code, reason = "each example uses the part that it needs")]

use std::collections::VecDeque;

use bevy::{
    asset::RenderAssetUsages,
    prelude::*,
    render::render_resource::{Extent3d, TextureDimension, TextureFormat},
};
use pliant::haptics::{DeviceId, HapticDevices, Record};

const WIDTH: usize = 440;
const HEIGHT: usize = 150;
/// Time span of the plot, s.
const SPAN: f64 = 12.0;
/// Distance of the grid lines, N.
const GRID: f64 = 1.0;
const BACK: [u8; 3] = [15, 20, 28];
const LINE: [u8; 3] = [48, 56, 68];

/// The plotted data: one trace per device.
#[derive(Resource)]
pub struct Traces {
    /// Force at the upper edge, N.
    pub top: f64,
    pub traces: Vec<Trace>,
}

/// The force of one device.
pub struct Trace {
    pub device: DeviceId,
    pub color: Color,
    points: VecDeque<(f64, f64)>,
    last: Option<[f64; 3]>,
    fresh: Vec<Record>,
    /// Largest change of the force from one period to the next, N.
    pub largest_step: f64,
    /// Largest force, N.
    pub largest: f64,
}

impl Trace {
    pub fn new(device: DeviceId, color: Color) -> Self {
        Self {
            device,
            color,
            points: VecDeque::new(),
            last: None,
            fresh: Vec::new(),
            largest_step: 0.0,
            largest: 0.0,
        }
    }

    /// Returns the periods since the last frame, for a recorder.
    pub fn take_records(&mut self) -> Vec<Record> {
        std::mem::take(&mut self.fresh)
    }
}

#[derive(Component)]
struct Picture;

/// Fills the [`Traces`], and draws them if there is a window.
pub fn plugin(app: &mut App) {
    app.add_systems(Startup, (begin, spawn)).add_systems(Update, (gather, draw).chain());
}

fn begin(mut devices: ResMut<HapticDevices>, traces: Res<Traces>) {
    for trace in &traces.traces {
        devices.set_recording(trace.device, true);
    }
}

/// Collects the records of the device loops since the last frame.
pub fn gather(mut devices: ResMut<HapticDevices>, mut traces: ResMut<Traces>) {
    for trace in &mut traces.traces {
        trace.fresh = devices.records(trace.device);
        for record in &trace.fresh {
            let force = record.wrench.force;
            let size = norm(force);
            if let Some(last) = trace.last {
                let step = norm(std::array::from_fn(|i| force[i] - last[i]));
                trace.largest_step = trace.largest_step.max(step);
            }
            trace.last = Some(force);
            trace.largest = trace.largest.max(size);
            trace.points.push_back((record.now, size));
        }
        let newest = trace.points.back().map_or(0.0, |p| p.0);
        while trace.points.front().is_some_and(|p| p.0 < newest - SPAN) {
            trace.points.pop_front();
        }
    }
}

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn spawn(mut commands: Commands, images: Option<ResMut<Assets<Image>>>, traces: Res<Traces>) {
    let Some(mut images) = images else { return };
    let size = Extent3d { width: WIDTH as u32, height: HEIGHT as u32, depth_or_array_layers: 1 };
    let [r, g, b] = BACK;
    let image = Image::new_fill(
        size,
        TextureDimension::D2,
        &[r, g, b, 255],
        TextureFormat::Rgba8UnormSrgb,
        RenderAssetUsages::default(),
    );
    let corner = Node {
        position_type: PositionType::Absolute,
        right: px(14),
        bottom: px(60),
        padding: UiRect::all(px(8)),
        flex_direction: FlexDirection::Column,
        row_gap: px(4),
        border_radius: BorderRadius::all(px(6)),
        ..default()
    };
    let title = format!("force on the hand, 0 to {:.0} N, {SPAN:.0} s, each period", traces.top);
    commands.spawn((corner, BackgroundColor(Color::srgb_u8(r, g, b)))).with_children(|corner| {
        corner.spawn((Text::new(title), TextFont { font_size: FontSize::Px(13.0), ..default() }));
        let size = Node { width: px(WIDTH as f32), height: px(HEIGHT as f32), ..default() };
        corner.spawn((Picture, ImageNode::new(images.add(image)), size));
    });
}

fn draw(
    traces: Res<Traces>,
    images: Option<ResMut<Assets<Image>>>,
    picture: Query<&ImageNode, With<Picture>>,
) {
    let (Some(mut images), Ok(node)) = (images, picture.single()) else { return };
    let Some(mut image) = images.get_mut(&node.image) else { return };
    let Some(data) = &mut image.data else { return };
    let mut paint = |x: usize, y: usize, [r, g, b]: [u8; 3]| {
        if let Some(pixel) = data.get_mut(4 * (y * WIDTH + x)..4 * (y * WIDTH + x) + 4) {
            pixel.copy_from_slice(&[r, g, b, 255]);
        }
    };
    let row = |newton: f64| {
        let up = (newton / traces.top).clamp(0.0, 1.0);
        ((1.0 - up) * (HEIGHT - 1) as f64) as usize
    };
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            paint(x, y, BACK);
        }
    }
    for line in 0..=(traces.top / GRID) as usize {
        for x in 0..WIDTH {
            paint(x, row(line as f64 * GRID), LINE);
        }
    }
    for trace in &traces.traces {
        let Some(newest) = trace.points.back().map(|p| p.0) else { continue };
        let [r, g, b, _] = trace.color.to_srgba().to_u8_array();
        let mut before: Option<(usize, usize)> = None;
        for &(now, force) in &trace.points {
            let x = ((1.0 - (newest - now) / SPAN).clamp(0.0, 1.0) * (WIDTH - 1) as f64) as usize;
            let y = row(force);
            // A vertical line, two pixels thick, connects this point to the last one.
            let from = before.filter(|(last, _)| x - last <= 1).map_or(y, |(_, y)| y);
            for y in from.min(y)..=from.max(y) {
                paint(x, y, [r, g, b]);
                paint(x, (y + 1).min(HEIGHT - 1), [r, g, b]);
            }
            before = Some((x, y));
        }
    }
}
