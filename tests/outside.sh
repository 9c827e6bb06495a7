#!/usr/bin/env bash
# A game outside of this workspace, made from the packaged crates and nothing else of the checkout:
# it is built, and runs without a window. Takes as long as Bevy takes to compile.
#
#   tests/outside.sh [PLIANT_FEATURE ...]
#
# BEVY: what the game writes after `bevy = `. Default: "0.19", which needs the headers of ALSA,
#       udev and Wayland on Linux.
# LOCK: a Cargo.lock to start from, so that what was compiled before is used again.
set -euo pipefail
cd "$(dirname "$0")/.."
root="$PWD"
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$root/target}"
[ -n "${SKIP_PACKAGE:-}" ] ||
    cargo package --quiet --workspace --exclude pliant_examples --no-verify --allow-dirty

work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
for crate in "$CARGO_TARGET_DIR"/package/pliant*.crate; do tar -xzf "$crate" -C "$work"; done
mkdir -p "$work/game/src" "$work/game/assets"
cp assets/pip.modal "$work/game/assets/"
[ -z "${LOCK:-}" ] || cp "$LOCK" "$work/game/Cargo.lock"

features="$(printf '"%s", ' "$@")"
[ $# -gt 0 ] || features=""
{
    printf '[package]\nname = "game"\nversion = "0.1.0"\nedition = "2024"\n\n[workspace]\n\n'
    printf '[dependencies]\nbevy = %s\n' "${BEVY:-\"0.19\"}"
    printf 'pliant = { version = "0.1", features = [%s] }\n\n[patch.crates-io]\n' "${features%, }"
    for folder in "$work"/pliant*-*; do
        name="$(basename "$folder")"
        printf '%s = { path = "../%s" }\n' "${name%-*}" "$name"
    done
    # The profiles of the workspace.
    sed -n '/^\[profile\.dev/,/^\[profile\.release/p' Cargo.toml | grep -v 'profile.release' |
        awk '/^\[profile/ { drop = /pliant_(lab|cli)/ } !drop'
} >"$work/game/Cargo.toml"

cat >"$work/game/src/main.rs" <<'RUST'
use bevy::{prelude::*, render::{RenderPlugin, settings::WgpuSettings}, window::ExitCondition};
use pliant::prelude::*;

fn main() -> AppExit {
    let headless = DefaultPlugins
        .set(AssetPlugin { file_path: concat!(env!("CARGO_MANIFEST_DIR"), "/assets").into(), ..default() })
        .set(WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() })
        .set(RenderPlugin {
            render_creation: WgpuSettings { backends: None, ..default() }.into(),
            ..default()
        })
        .disable::<bevy::winit::WinitPlugin>()
        .add(bevy::app::ScheduleRunnerPlugin::run_loop(std::time::Duration::from_millis(1)));
    App::new()
        .add_plugins((headless, PliantPlugins::default()))
        .add_systems(Startup, setup)
        .add_observer(pull)
        .add_systems(Update, look)
        .run()
}

fn setup(mut commands: Commands, assets: Res<AssetServer>, mut materials: ResMut<Assets<StandardMaterial>>) {
    commands.spawn((
        ModalBody::new(assets.load("pip.modal")),
        MeshMaterial3d(materials.add(Color::srgb(0.9, 0.5, 0.4))),
    ));
    commands.spawn((Camera3d::default(), Transform::from_xyz(0.4, 0.4, 0.7).looking_at(Vec3::ZERO, Vec3::Y)));
}

fn pull(ready: On<BodyReady>, mut commands: Commands) {
    commands.spawn((Grab::new(0, 0.02, bevy::math::DVec3::new(0.1, 0.3, 0.0)), GrabOf(ready.entity)));
}

fn look(tick: Res<PliantTick>, forces: Query<&GrabForce>, mut exit: MessageWriter<AppExit>) {
    if let (Ok(hand), 120..) = (forces.single(), tick.0) {
        println!("the hand feels {:.3} N after {} ticks", hand.force.length(), tick.0);
        let felt = hand.force.is_finite() && hand.force.length() > 1e-3;
        exit.write(if felt { AppExit::Success } else { AppExit::error() });
    }
}
RUST
cd "$work/game"
echo "crates of the game: $(cargo tree -e normal --prefix none | awk '{print $1,$2}' | sort -u | wc -l)"
[ -n "${TREE_ONLY:-}" ] || timeout "${SECONDS_AT_MOST:-3600}" cargo run
