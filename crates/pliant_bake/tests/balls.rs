//! Balls that touch: Hertz, rolling and spinning.

use std::sync::Arc;

use pliant_bake::BakeConfig;
use pliant_mesh::shapes;
use pliant_modal::{Damping, Frame, Material, Sphere};

use crate::contact::{GRAVITY, ball, model, place, run, scene};

#[test]
fn a_sliding_ball_ends_rolling_at_five_sevenths_of_its_speed() {
    for (young, rate) in [(1e7, 240.0), (1e6, 60.0)] {
        let model = ball(young, None);
        let mut slide = scene(0.0, 0.3);
        (slide.rate, slide.velocity) = (rate, [1.0, 0.0, 0.0]);
        let mut body = place(&model, &slide);
        // It slides for 2 v / (7 mu g).
        run(&mut body, 1.5 * 2.0 / (7.0 * 0.3 * GRAVITY));
        let speed = body.frame().velocity()[0];
        let spin = body.frame().angular_velocity(&model).z * 0.1;
        println!(
            "E = {young:e} at {rate} Hz: {speed:.5} m/s, surface speed {spin:.5}, 5/7 = {:.5}",
            5.0 / 7.0
        );
        assert!((speed / (5.0 / 7.0) - 1.0).abs() < 0.01, "{young}: {speed}");
        assert!((spin + speed).abs() < 0.02 * speed, "{young}: it rolls, {spin} {speed}");
        run(&mut body, 1.0);
        let later = body.frame().velocity()[0];
        println!("    after another second {later:.5} m/s");
        assert!((later / speed - 1.0).abs() < 0.02, "{young}: {later}");
    }
}

/// Two spheres touch as one with the radius `r R / (r + R)` touches a plane, whatever the direction
/// in which the body is turned.
#[test]
fn a_ball_touches_a_ball_for_the_time_of_hertz_however_it_is_turned() {
    let (young, radius, speed, steps) = (1e6, 0.1f64, 0.2f64, 64.0);
    let plain = young / (1.0 - 0.3f64.powi(2));
    let model = ball(young, None);
    let mass = model.mass();
    for share in [0.3, 1.0, 5.0] {
        let other = share * radius;
        let both = radius * other / (radius + other);
        let time = 2.87 * (mass * mass / (both * plain * plain * speed)).powf(0.2);
        let mut times = vec![];
        for k in 0..12 {
            let at = |x: f64| (x * f64::from(k) + 0.3).sin();
            let mut hit = scene(0.0, 0.5);
            hit.settings.gravity = [0.0; 3];
            hit.rate = steps / time;
            let mut body = place(&model, &hit);
            body.set_obstacles(vec![Arc::new(Sphere { center: [0.0, -other, 0.0], radius: other })]).unwrap();
            let mut state = body.state().clone();
            let (turn, velocity) = ([at(1.1), at(1.7), at(2.3), at(0.7)], [0.0, -speed, 0.0]);
            state.frame = Frame::from_motion(&model, [0.0, radius, 0.0], turn, velocity, [0.0; 3]).unwrap();
            body.set_state(&state).unwrap();
            let mut lasted = 0.0;
            for _ in 0..(1.6 * steps) as usize {
                body.step().unwrap();
                lasted += f64::from(u8::from(body.contacts().report().force[1] > 0.0));
                assert!(body.contacts().report().contacts <= 1);
            }
            times.push(lasted / steps);
        }
        println!("r / R = {share}: time {times:.3?}");
        assert!(times.iter().all(|time| (time - 1.0).abs() < 0.06), "{share}: {times:?}");
    }
}

/// A ball that spins about the normal rubs with the torque of the pressure of Hertz,
/// `3 pi / 16 mu F a` (K. L. Johnson, *Contact Mechanics*, 1985), until it rests.
#[test]
fn a_ball_that_spins_on_the_spot_comes_to_rest_as_friction_says() {
    let (young, radius, friction) = (1e6, 0.1f64, 0.4);
    let model = ball(young, None);
    let mut body = place(&model, &scene(0.0, friction));
    run(&mut body, 3.0);
    let mut state = body.state().clone();
    let inertia = model.inertia()[1][1];
    let center = state.frame.center();
    let begun = 20.0;
    state.frame =
        Frame::from_motion(&model, center, [0.0, 0.0, 0.0, 1.0], [0.0; 3], [0.0, begun * inertia, 0.0])
            .unwrap();
    body.set_state(&state).unwrap();
    run(&mut body, 0.25);
    let from = body.frame().angular_velocity(&model).y;
    run(&mut body, 0.25);
    let slowed = 4.0 * (from - body.frame().angular_velocity(&model).y) * inertia;
    let weight = model.mass() * GRAVITY;
    let circle = (0.75 * weight * radius * (1.0 - 0.3f64.powi(2)) / young).cbrt();
    let want = 3.0 * std::f64::consts::PI / 16.0 * friction * weight * circle;
    println!("torque {slowed:.5} N m, the closed form {want:.5}");
    assert!((slowed / want - 1.0).abs() < 0.02, "{slowed} {want}");
    run(&mut body, 2.0 * begun * inertia / want);
    let spin = body.frame().angular_velocity(&model).norm();
    assert!(spin < 1e-6 * begun, "{spin}");
}

#[test]
fn a_ball_touches_a_plane_for_the_time_of_hertz_however_it_is_turned() {
    let (young, radius) = (1e6, 0.1f64);
    let plain = young / (1.0 - 0.3f64.powi(2));
    let turns = [[0.0, 0.0, 0.0, 1.0], [0.3, 0.1, 0.2, 0.9], [-0.5, 0.4, 0.1, 0.7], [0.1, 0.8, -0.3, 0.4]];
    let mesh = shapes::sphere(14, radius).unwrap();
    let soft = |c: &mut BakeConfig| (c.sites, c.damping) = (None, Damping::Ratio(0.0));
    let linear = model(&mesh, young, |c| {
        soft(c);
        c.modes = 60;
    });
    let reduced = model(&mesh, young, |c| {
        soft(c);
        (c.modes, c.material) = (36, Some(Material::NeoHookean));
    });
    for (name, model) in [("linear", linear), ("reduced", reduced)] {
        let mass = model.mass();
        for speed in [0.05, 0.2, 0.5, 1.0] {
            let time = 2.87 * (mass * mass / (radius * plain * plain * speed)).powf(0.2);
            let depth = (15.0 * mass * speed * speed / (16.0 * radius.sqrt() * plain)).powf(0.4);
            let most = 4.0 / 3.0 * plain * radius.sqrt() * depth.powf(1.5);
            for (steps, bound) in [(16.0, 0.07), (64.0, 0.05)] {
                let (mut times, mut forces, mut kept, mut count) = (vec![], vec![], vec![], 0);
                for turn in turns {
                    let mut hit = scene(0.0, 0.0);
                    hit.settings.gravity = [0.0; 3];
                    hit.rate = steps / time;
                    let mut body = place(&model, &hit);
                    let mut state = body.state().clone();
                    let center = [0.0, radius, 0.0];
                    state.frame =
                        Frame::from_motion(&model, center, turn, [0.0, -speed, 0.0], [0.0; 3]).unwrap();
                    body.set_state(&state).unwrap();
                    let (mut lasted, mut largest) = (0.0, 0.0f64);
                    for _ in 0..(1.6 * steps) as usize {
                        body.step().unwrap();
                        let force = body.contacts().report().force[1];
                        count = count.max(body.contacts().report().contacts);
                        lasted += f64::from(u8::from(force > 0.0));
                        largest = largest.max(force);
                    }
                    times.push(lasted / steps);
                    forces.push(largest / most);
                    kept.push(body.frame().velocity()[1] / speed);
                }
                println!(
                    "{name}, a / R = {:.2}, {steps} steps: time {times:.3?}, force {forces:.3?}, e {kept:.3?}, {count} contacts",
                    (depth / radius).sqrt()
                );
                // The closed form is that of a half-space, and a wide contact knows of the ball's
                // end.
                let wide = if speed > 0.3 { 0.03 } else { 0.0 };
                for ((time, force), kept) in times.iter().zip(&forces).zip(&kept) {
                    assert!((time - 1.0).abs() <= bound + wide, "{name}, {speed}, {steps}: {time}");
                    assert!((force - 1.0).abs() < 0.08 + wide, "{name}, {speed}, {steps}: {force}");
                    assert!((0.8..1.0).contains(kept), "{name}, {speed}, {steps}: {kept}");
                }
                assert_eq!(count, 1, "{name}, {speed}, {steps}: one place");
            }
        }
    }
}

#[test]
fn a_pressed_ball_is_about_as_stiff_as_hertz_says() {
    let (young, radius) = (1e5, 0.1f64);
    let plain = young / (1.0 - 0.3f64.powi(2));
    let free = |modes| {
        model(&shapes::sphere(8, radius).unwrap(), young, |config| {
            (config.modes, config.sites) = (modes, None)
        })
    };
    for (name, model) in [
        ("30 modes", free(30)),
        ("240 modes", free(240)),
        ("reduced", ball(young, Some(Material::NeoHookean))),
    ] {
        for share in [0.1, 0.2, 0.3f64] {
            let depth = share * share * radius;
            let force = 4.0 / 3.0 * plain * radius.sqrt() * depth.powf(1.5);
            let mut press = scene(0.0, 0.0);
            press.settings.gravity = [0.0, -force / model.mass(), 0.0];
            press.settings.damping_scale = 20.0;
            let mut body = place(&model, &press);
            run(&mut body, 10.0);
            let got = radius - body.frame().center()[1];
            // The force that Hertz has at this depth.
            let hertz = 4.0 / 3.0 * plain * radius.sqrt() * got.max(0.0).powf(1.5);
            println!(
                "{name}, a / R = {share}: depth {:.3} of Hertz's, force {:.3}, {} contacts",
                got / depth,
                force / hertz,
                body.contacts().report().contacts
            );
            // The smallest circle of contact is half as wide as the spacing of the sites, and the
            // widest one is no longer that of a half-space.
            let bound = if share < 0.15 { 0.05 } else { 0.13 };
            assert!((force / hertz - 1.0).abs() < bound, "{name}, {share}: {}", force / hertz);
        }
    }
}
