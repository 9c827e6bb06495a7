//! Data of the session: users who join or leave, the session's state, the users of the hands, and
//! the hands of other users.
//!
//! Most network metrics (round trip, loss, rates, NACKs) are diagnostics, which are recorded like
//! all others without code here.

use bevy::{math::DVec3, prelude::*};
use pliant_body::{BodyState, Grab, VisualState};
use pliant_net::{
    GrabRefused, GuestState, HandOf, NetGuest, NetHost, NetPeer, NetStats, PeerState, RemoteHands,
    SessionClosed, User, UserJoined, UserLeft, Yourself,
};

use crate::{
    RerunScalars,
    collect::{Hands, Whose},
    frame::RecordedHand,
};

pub(crate) fn say_who_comes_and_goes(
    mut joined: MessageReader<UserJoined>,
    mut left: MessageReader<UserLeft>,
    mut refused: MessageReader<GrabRefused>,
    mut closed: MessageReader<SessionClosed>,
    mut own: ResMut<RerunScalars>,
) {
    for user in joined.read() {
        own.log(format!("{} joined", user.name));
    }
    for user in left.read() {
        own.log(format!("{} left: {}", user.name, user.reason));
    }
    for grab in refused.read() {
        own.warn(format!("the host refused a grab: {grab:?}"));
    }
    for session in closed.read() {
        own.warn(format!("the session ended: {}", session.reason));
    }
}

/// Returns the state of the session in words, and whether this app is in it. Returns `None` without
/// a session.
fn standing(
    host: Option<&NetHost>,
    guest: Option<&NetGuest>,
    peer: Option<&NetPeer>,
) -> Option<(String, bool)> {
    Some(match (host, guest, peer) {
        (Some(host), ..) if host.has_ended() => ("the session is over".to_owned(), false),
        (Some(host), ..) => (format!("hosting, {} guests", host.guests().count()), true),
        (None, Some(guest), _) => match guest.state() {
            GuestState::Joining => ("joining".into(), false),
            GuestState::In { user } => (format!("in the session as user {}", user.0), true),
            GuestState::Lost { reason } => (format!("the host is not to be heard: {reason}"), false),
            GuestState::Closed { reason } => (format!("not in the session: {reason}"), false),
        },
        (None, None, Some(peer)) => match peer.state() {
            PeerState::Joining => ("joining".into(), false),
            PeerState::In { user } => (format!("among peers as user {}", user.0), true),
            PeerState::Closed { reason } => (format!("not in the session: {reason}"), false),
        },
        (None, None, None) => return None,
    })
}

/// Logs the state of the connection when it changes.
pub(crate) fn say_how_it_stands(
    host: Option<Res<NetHost>>,
    guest: Option<Res<NetGuest>>,
    peer: Option<Res<NetPeer>>,
    mut own: ResMut<RerunScalars>,
    mut told: Local<String>,
) {
    let Some((standing, stands)) = standing(host.as_deref(), guest.as_deref(), peer.as_deref()) else {
        return;
    };
    if *told == standing {
        return;
    }
    if stands {
        own.log(standing.clone());
    } else {
        own.warn(standing.clone());
    }
    *told = standing;
}

/// The time of the last session metrics and the counters at that time.
#[derive(Default)]
pub(crate) struct Counted {
    let_go: u64,
    /// Simulated time of the last metrics, s.
    second: Option<f64>,
}

/// Records the state of the connection, its jitter, whether it is queueing, and the rate of dropped
/// datagrams, once per second.
pub(crate) fn log_metrics(
    host: Option<Res<NetHost>>,
    guest: Option<Res<NetGuest>>,
    peer: Option<Res<NetPeer>>,
    stats: Option<Res<NetStats>>,
    time: Res<Time>,
    mut own: ResMut<RerunScalars>,
    mut counted: Local<Counted>,
) {
    let now = time.elapsed_secs_f64();
    let passed = counted.second.map(|second| now - second);
    if passed.is_some_and(|passed| (0.0..1.0).contains(&passed)) {
        return;
    }
    let Some((_, stands)) = standing(host.as_deref(), guest.as_deref(), peer.as_deref()) else { return };
    counted.second = Some(now);
    own.set("net/connected", "", f64::from(u8::from(stands)));
    let Some(stats) = stats else { return };
    own.set("net/jitter", "ms", stats.jitter.as_secs_f64() * 1e3);
    own.set("net/queueing", "", f64::from(u8::from(stats.queueing)));
    let dropped = stats.dropped;
    let let_go =
        [dropped.send_queue_full, dropped.receive_queue_full, dropped.too_large, dropped.not_connected];
    let let_go: u64 = let_go.into_iter().sum();
    if let Some(passed) = passed.filter(|passed| *passed > 0.0) {
        own.set("net/let go", "/s", let_go.saturating_sub(counted.let_go) as f64 / passed);
    }
    counted.let_go = let_go;
}

/// Finds the name and the color of the user of each grab in this app.
pub(crate) fn see_whose_hands(
    mut hands: ResMut<Hands>,
    grabs: Query<(Entity, Option<&HandOf>), With<Grab>>,
    users: Query<&User>,
    you: Query<&User, With<Yourself>>,
) {
    hands.whose.clear();
    for (grab, of) in &grabs {
        let user = match of {
            Some(of) => users.get(of.0).ok(),
            None => you.iter().next(),
        };
        if let Some(user) = user {
            hands.whose.insert(grab, Whose { name: user.name.clone(), color: srgb(user.color) });
        }
    }
}

pub(crate) fn see_other_hands(
    mut others: ResMut<Hands>,
    bodies: Query<(&RemoteHands, &BodyState, &VisualState, &GlobalTransform)>,
    users: Query<&User>,
) {
    others.others.clear();
    for (hands, state, shown, place) in &bodies {
        for hand in &hands.0 {
            let user = users.iter().find(|user| user.id == hand.user);
            let name = user.map_or_else(|| format!("user {}", hand.user.0), |user| user.name.clone());
            let point =
                place.affine().transform_point3(surface_point(state, hand.vertex, shown.current()).as_vec3());
            others.others.push(RecordedHand {
                name: name.replace('/', " ").into(),
                color: user.map(|user| srgb(user.color)),
                force: hand.reaction.into(),
                point: point.as_dvec3().into(),
                target: hand.target.into(),
            });
        }
    }
}

/// Returns the position of a vertex in body axes, m. It stands for the middle of a patch of which
/// only the vertex is known.
fn surface_point(state: &BodyState, vertex: u32, q: &[f64]) -> DVec3 {
    let model = state.model();
    let Some(rest) = model.surface().positions().get(vertex as usize) else { return DVec3::ZERO };
    let along = |row: &dyn Fn(usize, usize) -> f32| -> [f64; 3] {
        std::array::from_fn(|axis| q.iter().enumerate().map(|(mode, q)| q * f64::from(row(axis, mode))).sum())
    };
    let moved = along(&|axis, mode| model.displacement_row(vertex, axis, mode));
    let moved = if state.warps() {
        pliant_modal::warp(along(&|axis, mode| model.rotation_row(vertex, axis, mode)), moved)
    } else {
        moved
    };
    Vec3::from(*rest).as_dvec3() + DVec3::from(moved)
}

fn srgb(color: Color) -> [u8; 3] {
    let color = color.to_srgba();
    [color.red, color.green, color.blue].map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8)
}
