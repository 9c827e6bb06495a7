//! Rigid bodies of a host's app on a guest, over real QUIC on loopback.

use crate::support;

use bevy::prelude::*;
use pliant_body::PliantTick;
use pliant_net::{
    HostConfig, JoinConfig, NetHost, RemoteRigid, RigidArrived, RigidLeft, SessionCommands, SharedRigid,
};
use support::{alone, arrival, guest, host, messages, must, run_frames, run_until};

/// Something that goes along a path in each tick, after all bodies, as a physics engine moves it.
#[derive(Component)]
struct Goes;

/// Half a meter a second along x and a turn in 4 s, from the tick at which the test let it go, for
/// three seconds.
#[derive(Resource, Default)]
struct Since(Option<u64>);

fn place_at(ticks: f32) -> Transform {
    let time = ticks.min(120.0) / 40.0;
    Transform::from_xyz(1.0 + 0.5 * time, 0.25, -2.0)
        .with_rotation(Quat::from_rotation_y(std::f32::consts::FRAC_PI_2 * time))
}

fn go(tick: Res<PliantTick>, since: Res<Since>, mut going: Query<&mut Transform, With<Goes>>) {
    let ticks = since.0.map_or(0.0, |since| (tick.0 - since) as f32);
    for mut transform in &mut going {
        *transform = place_at(ticks).with_scale(transform.scale);
    }
}

/// The tick at which an entity shows its path, and how far off the path it is.
fn along(transform: &Transform) -> (f32, f32) {
    let ticks = (transform.translation.x - 1.0) / 0.5 * 40.0;
    let path = place_at(ticks);
    let turn = path.rotation.angle_between(transform.rotation);
    (ticks, path.translation.distance(transform.translation).max(turn))
}

#[test]
fn a_guest_sees_the_hosts_crates_where_they_are() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    host.init_resource::<Since>().add_systems(FixedPostUpdate, go);
    let crates: Vec<Entity> = ["crate", "ball"]
        .map(|name| host.world_mut().spawn((Goes, SharedRigid::named(name), Transform::default())).id())
        .to_vec();
    let mut guest = guest(&invite, JoinConfig::default());
    // The app has an entity for the crate, in a room of its own that is turned and twice as large.
    let turned = Quat::from_rotation_x(0.7);
    let room = Transform::from_xyz(0.0, 3.0, 0.0).with_rotation(turned).with_scale(Vec3::splat(2.0));
    let room = guest.world_mut().spawn(room).id();
    let size = Vec3::new(0.3, 0.4, 0.5);
    let own = (SharedRigid::named("crate"), Transform::from_scale(size), ChildOf(room));
    let own = guest.world_mut().spawn(own).id();
    arrival(&mut host, &mut guest);
    let ball = run_until(&mut [&mut host, &mut guest], "both are there and at their places", |apps| {
        let there = messages::<RigidArrived>(apps[1]);
        must!(there.len() == 2, "{there:?}");
        let ball = there.iter().find(|arrived| arrived.name == "ball").unwrap().entity;
        must!(apps[1].world().get::<GlobalTransform>(own).is_some(), "no place yet");
        let seen = apps[1].world().get::<GlobalTransform>(own).unwrap().translation();
        must!(seen.distance(place_at(0.0).translation) < 1e-5, "the crate is at {seen}");
        Ok(ball)
    });
    assert!(guest.world().get::<RemoteRigid>(own).is_some());
    let scale = guest.world().get::<Transform>(own).unwrap().scale;
    assert_eq!(scale, size, "its size is the app's");

    // What rests is sent no more; what goes is shown on its path, evenly.
    run_until(&mut [&mut host, &mut guest], "both rest", |apps| {
        apps[0].world().resource::<NetHost>().session().rigids().all(|(_, resting)| resting)
    });
    let tick = host.world().resource::<PliantTick>().0;
    host.world_mut().resource_mut::<Since>().0 = Some(tick);
    let mut last = 0.0;
    run_until(&mut [&mut host, &mut guest], "the crates go along their path", |apps| {
        let truth = apps[0].world().resource::<PliantTick>().0 - tick;
        for (entity, parent) in [(ball, false), (own, true)] {
            let place = match parent {
                true => apps[1].world().get::<GlobalTransform>(entity).unwrap().compute_transform(),
                false => *apps[1].world().get::<Transform>(entity).unwrap(),
            };
            let (ticks, off) = along(&place);
            // Where it starts and where it stops, a corner of the path lies between two ticks.
            assert!(off < 0.02, "off its path by {off} at tick {ticks} of {truth}");
            assert!(ticks < truth as f32 + 1.0, "shown at {ticks} of {truth}");
            if entity == ball {
                assert!(ticks > last - 1e-3, "it goes back from {last} to {ticks}");
                last = ticks;
            }
        }
        must!(last > 119.9, "shown at {last} of {truth}");
        Ok(())
    });
    run_until(&mut [&mut host, &mut guest], "both rest where they are", |apps| {
        apps[0].world().resource::<NetHost>().session().rigids().all(|(_, resting)| resting)
    });

    // A crate that is despawned leaves the guest; the app's own entity stays.
    crates.iter().for_each(|&entity| _ = host.world_mut().despawn(entity));
    run_until(&mut [&mut host, &mut guest], "both have left", |apps| {
        messages::<RigidLeft>(apps[1]).len() == 2
    });
    assert!(guest.world().get_entity(ball).is_err());
    assert!(guest.world().get::<RemoteRigid>(own).is_none());
    let (ticks, off) = along(&guest.world().get::<GlobalTransform>(own).unwrap().compute_transform());
    assert!((ticks - 120.0).abs() < 0.05 && off < 1e-3, "it stays: {ticks}, {off}");
}

/// Who leaves gets its own entities back, and those that the session has spawned are gone. Who
/// joins again has both again.
#[test]
fn crates_leave_with_the_session() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    for name in ["crate", "ball"] {
        host.world_mut().spawn((SharedRigid::named(name), Transform::from_xyz(1.0, 2.0, 3.0)));
    }
    let mut guest = guest(&invite, JoinConfig::default());
    let own = guest.world_mut().spawn((SharedRigid::named("crate"), Transform::default())).id();
    arrival(&mut host, &mut guest);
    run_until(&mut [&mut host, &mut guest], "both are there", |apps| {
        messages::<RigidArrived>(apps[1]).len() == 2
    });
    guest.world_mut().commands().leave_session();
    run_until(&mut [&mut host, &mut guest], "the guest has left", |apps| {
        let mut all = apps[1].world_mut().query::<(Entity, &SharedRigid, Option<&RemoteRigid>)>();
        let all: Vec<_> = all.iter(apps[1].world()).map(|(entity, _, remote)| (entity, remote)).collect();
        all == [(own, None)]
    });
    run_frames(&mut [&mut host, &mut guest], 3);
    assert_eq!(guest.world().get::<Transform>(own).unwrap().translation, Vec3::new(1.0, 2.0, 3.0));
    let mut left: Vec<String> = messages::<RigidLeft>(&guest).into_iter().map(|left| left.name).collect();
    left.sort();
    assert_eq!(left, ["ball", "crate"]);

    guest.world_mut().commands().join_session(invite, JoinConfig::default());
    run_until(&mut [&mut host, &mut guest], "both are there again", |apps| {
        must!(messages::<RigidArrived>(apps[1]).len() == 4, "{:?}", messages::<RigidArrived>(apps[1]));
        must!(apps[1].world().get::<RemoteRigid>(own).is_some(), "the app's own does not follow");
        Ok(())
    });
    // A name that changes is another rigid body.
    let mut all = host.world_mut().query::<&mut SharedRigid>();
    for mut shared in all.iter_mut(host.world_mut()) {
        if shared.name == "ball" {
            shared.name = "balloon".into();
        }
    }
    run_until(&mut [&mut host, &mut guest], "it has its new name", |apps| {
        let mut all = apps[1].world_mut().query_filtered::<&SharedRigid, With<RemoteRigid>>();
        let mut names: Vec<String> = all.iter(apps[1].world()).map(|shared| shared.name.clone()).collect();
        names.sort();
        must!(names == ["balloon", "crate"], "{names:?}");
        Ok(())
    });
}
