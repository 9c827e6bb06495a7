//! Text on the window: the title and the metrics of the scene above, the keys below.

use bevy::prelude::*;

/// The metrics of the scene, shown under its title and printed at the end of a run without a
/// window.
///
/// Lines may be padded to align, because the font is monospaced.
#[derive(Resource, Default)]
pub struct Readout(pub String);

#[derive(Component)]
struct ReadoutText {
    title: String,
}

pub(super) fn build(app: &mut App, title: &str, keys: &[&'static str], orbits: bool) {
    let mut keys = keys.to_vec();
    if orbits {
        keys.extend(["right mouse: look around", "wheel: nearer, farther"]);
    }
    keys.push("Esc: end");
    let (title, keys) = (title.to_owned(), keys.join("    "));
    app.init_resource::<Readout>()
        .add_systems(Startup, move |commands: Commands| spawn(commands, &title, &keys))
        .add_systems(Update, write.run_if(resource_changed::<Readout>));
}

fn spawn(mut commands: Commands, title: &str, keys: &str) {
    let panel = |top: Val, bottom: Val| {
        (
            Node {
                position_type: PositionType::Absolute,
                left: px(14),
                top,
                bottom,
                // In a narrow window the keys take two lines.
                max_width: percent(96),
                padding: UiRect::axes(px(12), px(8)),
                border_radius: BorderRadius::all(px(6)),
                ..default()
            },
            BackgroundColor(Color::srgba(0.06, 0.08, 0.11, 0.72)),
        )
    };
    let font = |size: f32| TextFont { font_size: FontSize::Px(size), ..default() };
    commands.spawn(panel(px(14), Val::Auto)).with_child((
        Text::new(title),
        font(15.0),
        ReadoutText { title: title.into() },
    ));
    commands.spawn(panel(Val::Auto, px(14))).with_child((
        Text::new(keys),
        font(13.0),
        TextColor(Color::srgb(0.85, 0.88, 0.92)),
    ));
}

fn write(readout: Res<Readout>, mut texts: Query<(&mut Text, &ReadoutText)>) {
    for (mut text, readout_text) in &mut texts {
        text.0 = [readout_text.title.as_str(), readout.0.as_str()].join("\n").trim_end().to_owned();
    }
}
