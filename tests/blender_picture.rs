//! Tests that a glTF file of two materials is drawn as a body with both, at rest and bent.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

#[path = "blender/mod.rs"]
mod bud;
mod drawing;

use std::{
    process::ExitCode,
    sync::{Arc, Mutex},
};

use bevy::{
    camera::RenderTarget,
    prelude::*,
    render::{
        render_resource::{TextureFormat, TextureUsages},
        view::screenshot::{Screenshot, ScreenshotCaptured},
    },
};
use pliant::{body::SurfaceDeformation, prelude::*};

const WIDTH: u32 = 240;
const HEIGHT: u32 = 240;

#[derive(Resource)]
struct Canvas(Handle<Image>);

fn studio() -> App {
    let mut app = bud::app(true);
    let world = app.world_mut();
    world.insert_resource(ClearColor(Color::BLACK));
    let mut canvas = Image::new_target_texture(WIDTH, HEIGHT, TextureFormat::Rgba8UnormSrgb, None);
    canvas.texture_descriptor.usage |= TextureUsages::COPY_SRC;
    let canvas = world.resource_mut::<Assets<Image>>().add(canvas);
    world.spawn((
        Camera3d::default(),
        RenderTarget::from(canvas.clone()),
        Transform::from_xyz(0.0, 0.25, 0.9).looking_at(Vec3::new(0.0, 0.2, 0.0), Vec3::Y),
    ));
    world.spawn((
        DirectionalLight { illuminance: 8_000.0, ..default() },
        Transform::from_xyz(-0.3, 0.5, 1.0).looking_at(Vec3::ZERO, Vec3::Y),
    ));
    world.insert_resource(Canvas(canvas));
    app
}

fn shoot(app: &mut App) -> Vec<u8> {
    let taken = Arc::<Mutex<Option<Vec<u8>>>>::default();
    let kept = taken.clone();
    let canvas = app.world().resource::<Canvas>().0.clone();
    app.world_mut().spawn(Screenshot::image(canvas)).observe(move |shot: On<ScreenshotCaptured>| {
        *kept.lock().unwrap() = shot.image.data.clone();
    });
    drawing::wait_for("a picture is read back", || {
        app.update();
        taken.lock().unwrap().take().ok_or_else(|| "none has come".to_owned())
    })
}

/// The number of red and of green pixels, and the mean column of each.
fn count(picture: &[u8]) -> [(usize, f64); 2] {
    [[0, 1], [1, 0]].map(|[here, other]| {
        let of = |(index, pixel): (usize, &[u8])| {
            let [here, other] = [here, other].map(|channel| u32::from(pixel[channel]));
            (here > 40 && here > 2 * other).then_some(index as u32 % WIDTH)
        };
        let columns: Vec<u32> = picture.chunks_exact(4).enumerate().filter_map(of).collect();
        (columns.len(), columns.iter().map(|&x| f64::from(x)).sum::<f64>() / columns.len().max(1) as f64)
    })
}

fn main() -> ExitCode {
    drawing::main(
        studio,
        &[
            ("both_materials_are_drawn_and_bend_with_the_body", |app| {
                drawn(app, SurfaceDeformation::Processor)
            }),
            ("the_compute_shader_draws_both_too", |app| drawn(app, SurfaceDeformation::Compute)),
        ],
    )
}

fn drawn(mut app: App, by: SurfaceDeformation) {
    app.insert_resource(by);
    bud::body(&mut app);
    // A model of 0.2 by 0.4 m at 0.9 m covers about a sixth of the picture.
    let all = (WIDTH * HEIGHT) as usize;
    let rest = drawing::wait_for("both halves are drawn", || {
        let [cap, stem] = count(&shoot(&mut app));
        let right = |half: (usize, f64)| (all / 40..all / 6).contains(&half.0);
        if right(cap) && right(stem) { Ok([cap, stem]) } else { Err(format!("{cap:?}, {stem:?} of {all}")) }
    });
    let middle = f64::from(WIDTH - 1) / 2.0;
    assert!(rest.iter().all(|half| (half.1 - middle).abs() < 2.0), "{rest:?}");
    app.insert_resource(BodyGravity(Vec3::X * 6.0));
    (0..80).for_each(|_| app.update());
    let bent = drawing::wait_for("it is bent to the right", || {
        let [cap, stem] = count(&shoot(&mut app));
        let bent = cap.1 > rest[0].1 + 4.0 && stem.1 > rest[1].1 + 0.5;
        if bent { Ok([cap, stem]) } else { Err(format!("{cap:?}, {stem:?}, at rest {rest:?}")) }
    });
    println!("{by:?}: pixels and mean column of cap and stem at rest {rest:?}, bent {bent:?}");
    if let Some(folder) = std::env::var_os("PLIANT_PICTURES") {
        let picture = shoot(&mut app);
        let ppm: Vec<u8> = picture.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
        let path = std::path::Path::new(&folder).join(format!("bud-{by:?}.ppm"));
        std::fs::write(path, [format!("P6\n{WIDTH} {HEIGHT}\n255\n").into_bytes(), ppm].concat()).unwrap();
    }
}
