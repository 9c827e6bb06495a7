//! Bevy's input moves a device through its source, and the tests read the position from the
//! device's loop.
#![cfg(feature = "plugin")]

use std::time::Duration;

use bevy::{
    asset::AssetPlugin,
    camera::{ComputedCameraValues, RenderTarget, RenderTargetInfo},
    input::{ButtonState, InputPlugin, mouse::MouseButtonInput},
    math::DVec3,
    picking::{
        PickingPlugin,
        pointer::{Location, PointerAction, PointerId, PointerInput},
    },
    prelude::*,
    time::TimeUpdateStrategy,
    transform::TransformPlugin,
    window::{PrimaryWindow, WindowRef},
};
use pliant_body::{ModalAsset, ModalBody, PliantBodyPlugin};

#[cfg(feature = "gamepad")]
use pliant_haptics::GamepadSource;
use pliant_haptics::{
    DeviceId, HapticDevices, HapticTool, HapticsPlugin, LoopConfig, PointerSource, PointerToolSystems,
    Positioned, PositionedHandle,
};

use crate::rig::block;
use crate::rig::machine;

/// Simulated time of a frame, s, whatever real time the machine takes.
const FRAME: f64 = 0.01;

struct Scene {
    app: App,
    device: DeviceId,
}

/// Creates an app with Bevy's own input and a [`Positioned`] device. Its tool is at `place`, with
/// the component that `source` makes of the device's handle.
fn scene<S: Component>(place: Transform, motion_scale: f64, source: impl Fn(PositionedHandle) -> S) -> Scene {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin::default(),
        TransformPlugin,
        InputPlugin,
        PickingPlugin,
        PliantBodyPlugin::default(),
        HapticsPlugin::default(),
    ))
    .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs_f64(FRAME)));
    app.finish();
    app.cleanup();
    app.world_mut().spawn(PointerId::Mouse);
    let device = Positioned::new("input");
    let source = source(device.handle());
    let device = app.world_mut().resource_mut::<HapticDevices>().add(device, LoopConfig::default()).unwrap();
    app.world_mut().spawn((HapticTool { motion_scale, ..HapticTool::new(device) }, source, place));
    let mut scene = Scene { app, device };
    scene.run(5);
    scene
}

impl Scene {
    fn run(&mut self, frames: usize) {
        for _ in 0..frames {
            self.app.update();
            std::thread::sleep(Duration::from_secs_f64(FRAME));
        }
    }

    fn tick(&self) -> pliant_haptics::LoopTick {
        self.app.world().resource::<HapticDevices>().get(self.device).unwrap().report.tick
    }

    /// Returns the number of periods that the loop has run.
    fn ticks(&self) -> u64 {
        self.app.world().resource::<HapticDevices>().get(self.device).unwrap().report.ticks
    }

    fn position(&self) -> DVec3 {
        self.tick().position.into()
    }

    /// Checks that the condition holds for twenty frames and 200 periods of the loop.
    #[track_caller]
    fn stays(&mut self, what: &str, so: impl Fn(&Self) -> bool) {
        let begun = self.ticks();
        let mut frames = 0;
        machine::until("frames and periods go on", || {
            assert!(so(self), "{what}: {:?}", self.tick());
            self.run(1);
            frames += 1;
            let ticks = self.ticks() - begun;
            if frames >= 20 && ticks >= 200 { Ok(()) } else { Err((frames, ticks)) }
        });
    }

    /// Runs until the device is within `near` of `place` (m, device axes), and then checks that it
    /// stays there for a while.
    #[track_caller]
    fn comes_to_rest_at(&mut self, place: DVec3, near: f64) {
        let there = |s: &Self| s.position().distance(place) < near;
        // The loop uses a real clock, and a busy machine stutters.
        machine::until("the device comes to its place", || {
            if there(self) {
                return Ok(());
            }
            self.run(1);
            Err((self.position(), place))
        });
        self.stays("it rests there", there);
    }

    #[track_caller]
    fn buttons_become(&mut self, wanted: u32) {
        machine::until("buttons", || {
            if self.tick().buttons == wanted {
                return Ok(());
            }
            self.run(1);
            Err((self.tick().buttons, wanted))
        });
    }

    /// Creates a window of 800 x 600 and a camera 2 m in front of the origin.
    fn window(&mut self) -> Entity {
        let window = Window { resolution: (800, 600).into(), ..Default::default() };
        let size = RenderTargetInfo { physical_size: UVec2::new(800, 600), scale_factor: 1.0 };
        let clip_from_view = Mat4::perspective_infinite_reverse_rh(1.0, 800.0 / 600.0, 0.1);
        let computed = ComputedCameraValues { clip_from_view, target_info: Some(size), ..Default::default() };
        let world = self.app.world_mut();
        world.spawn((Camera { computed, ..Default::default() }, Transform::from_xyz(0.0, 0.0, 2.0)));
        world.spawn((window, PrimaryWindow)).id()
    }

    /// Puts the pointer at `at`, m from the center of the view in the plane z = 0.
    fn point(&mut self, window: Entity, at: Vec2) {
        let pixels_a_meter = 300.0 / (2.0 * 0.5f32.tan());
        let position = Vec2::new(400.0, 300.0) + Vec2::new(at.x, -at.y) * pixels_a_meter;
        let target = RenderTarget::Window(WindowRef::Entity(window)).normalize(None).unwrap();
        let action = PointerAction::Move { delta: Vec2::ZERO };
        let input = PointerInput::new(PointerId::Mouse, Location { target, position }, action);
        self.app.world_mut().write_message(input);
    }

    fn press(&mut self, window: Entity, button: MouseButton, state: ButtonState) {
        self.app.world_mut().write_message(MouseButtonInput { button, state, window });
    }
}

#[test]
fn the_pointer_moves_the_device_to_where_it_points() {
    let turned = Transform::from_rotation(Quat::from_rotation_z(std::f32::consts::FRAC_PI_2));
    for (place, scale, want) in [
        (Transform::IDENTITY, 1.0, DVec3::new(0.1, 0.05, 0.0)),
        // A quarter turn about z takes the device's x axis to the world's y axis. 1 m of the hand
        // is 2 m of the world.
        (turned, 2.0, DVec3::new(0.025, -0.05, 0.0)),
    ] {
        let mut s = scene(place, scale, PointerSource::new);
        let window = s.window();
        s.comes_to_rest_at(DVec3::ZERO, 1e-9);
        s.point(window, Vec2::new(0.1, 0.05));
        s.comes_to_rest_at(want, 1e-4);
        s.press(window, MouseButton::Left, ButtonState::Pressed);
        s.press(window, MouseButton::Middle, ButtonState::Pressed);
        s.buttons_become(0b101);
        // The pointer stands still. The hand stays where it is, and its buttons come up.
        s.press(window, MouseButton::Left, ButtonState::Released);
        s.press(window, MouseButton::Middle, ButtonState::Released);
        s.buttons_become(0);
        s.comes_to_rest_at(want, 1e-4);
    }
}

#[test]
fn a_press_that_is_somebody_elses_is_not_the_tools_and_one_that_is_ends() {
    #[derive(Resource)]
    struct Panel(bool);
    let mut s = scene(Transform::IDENTITY, 1.0, PointerSource::new);
    s.app
        .insert_resource(Panel(true))
        .configure_sets(PreUpdate, PointerToolSystems::Press.run_if(|panel: Res<Panel>| !panel.0));
    let window = s.window();
    s.point(window, Vec2::ZERO);
    s.press(window, MouseButton::Left, ButtonState::Pressed);
    s.stays("the panel's", |s| s.tick().buttons == 0);
    // The button was pressed on the panel, so it still belongs to the panel after the pointer has
    // left the panel.
    s.app.world_mut().resource_mut::<Panel>().0 = false;
    s.stays("still the panel's", |s| s.tick().buttons == 0);
    s.press(window, MouseButton::Right, ButtonState::Pressed);
    s.buttons_become(0b10);
    s.app.world_mut().resource_mut::<Panel>().0 = true;
    s.stays("a hand that passes over the panel does not let go", |s| s.tick().buttons == 0b10);
    s.press(window, MouseButton::Right, ButtonState::Released);
    s.buttons_become(0);
    s.press(window, MouseButton::Left, ButtonState::Released);
    s.app.world_mut().resource_mut::<Panel>().0 = false;
    s.run(2);
    s.press(window, MouseButton::Left, ButtonState::Pressed);
    s.buttons_become(0b1);
}

#[test]
fn buttons_come_up_where_the_pointer_points_at_nothing() {
    let mut s = scene(Transform::IDENTITY, 1.0, PointerSource::new);
    let window = s.window();
    s.point(window, Vec2::new(0.1, 0.05));
    s.press(window, MouseButton::Left, ButtonState::Pressed);
    s.buttons_become(1);
    // The camera moves on by 4 m. The tool is then behind the camera, and no ray meets a plane
    // there.
    let world = s.app.world_mut();
    let camera = world.query_filtered::<Entity, With<Camera>>().single(world).unwrap();
    world.get_mut::<Transform>(camera).unwrap().translation.z = -2.0;
    s.run(3);
    s.press(window, MouseButton::Left, ButtonState::Released);
    s.buttons_become(0);
}

#[test]
fn with_empty_hands_the_pointer_lies_on_the_surface() {
    let mut s = scene(Transform::IDENTITY, 1.0, PointerSource::new);
    let window = s.window();
    let model = ModalAsset(std::sync::Arc::new(block::block(1e5, 12)));
    let handle = s.app.world_mut().resource_mut::<Assets<ModalAsset>>().add(model);
    s.app.world_mut().spawn((ModalBody::new(handle), InheritedVisibility::VISIBLE));
    s.run(5);
    // The block is 4 cm thick, so its face is 2 cm nearer to the camera. The ray there is 1 %
    // nearer to the center of the view.
    s.point(window, Vec2::new(0.05, 0.0));
    s.comes_to_rest_at(DVec3::new(0.0495, 0.0, 0.02), 1e-4);
}

#[cfg(feature = "gamepad")]
#[test]
fn the_gamepad_moves_the_device_as_long_as_a_stick_is_held() {
    use bevy::input::gamepad::{
        GamepadAxis, GamepadButton, GamepadConnection, GamepadConnectionEvent, RawGamepadAxisChangedEvent,
        RawGamepadButtonChangedEvent, RawGamepadEvent,
    };
    let mut s = scene(Transform::IDENTITY, 1.0, GamepadSource::new);
    let pad = s.app.world_mut().spawn_empty().id();
    let axis = |s: &mut Scene, axis, value| {
        let event = RawGamepadAxisChangedEvent::new(pad, axis, value);
        s.app.world_mut().write_message(RawGamepadEvent::Axis(event));
    };
    let button = |s: &mut Scene, button, value| {
        let event = RawGamepadButtonChangedEvent::new(pad, button, value);
        s.app.world_mut().write_message(RawGamepadEvent::Button(event));
    };
    s.comes_to_rest_at(DVec3::ZERO, 1e-9);
    let connected = GamepadConnection::Connected { name: "pad".into(), vendor_id: None, product_id: None };
    s.app.world_mut().write_message(GamepadConnectionEvent::new(pad, connected));
    s.comes_to_rest_at(DVec3::ZERO, 1e-9);

    // The motion is twenty frames of 10 ms at 0.15 m/s.
    let moved = 20.0 * FRAME * 0.15;
    let mut want = DVec3::ZERO;
    for (stick, way) in [
        (GamepadAxis::LeftStickX, DVec3::X),
        (GamepadAxis::RightStickY, DVec3::Y),
        (GamepadAxis::LeftStickY, DVec3::NEG_Z),
    ] {
        axis(&mut s, stick, 1.0);
        s.run(20);
        axis(&mut s, stick, 0.0);
        want += way * moved;
        s.comes_to_rest_at(want, 1e-4);
    }
    // Half of the range outside Bevy's dead zone (0.05 by default) gives half of the speed.
    axis(&mut s, GamepadAxis::LeftStickX, -0.525);
    s.run(20);
    axis(&mut s, GamepadAxis::LeftStickX, 0.0);
    want.x -= 0.5 * moved;
    s.comes_to_rest_at(want, 1e-3);

    button(&mut s, GamepadButton::South, 1.0);
    button(&mut s, GamepadButton::RightTrigger2, 1.0);
    s.buttons_become(0b100001);
    // The gamepad is unplugged while a stick is deflected. The device stays, and no button is down.
    let stays = s.position();
    let gone = GamepadConnectionEvent::new(pad, GamepadConnection::Disconnected);
    axis(&mut s, GamepadAxis::LeftStickX, 1.0);
    s.app.world_mut().write_message(gone);
    s.buttons_become(0);
    s.comes_to_rest_at(stays, 2e-3);
}
