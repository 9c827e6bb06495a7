//! Data of the session: users who join or leave, the session's state, the users of the hands, and
//! the hands of other users.
//!
//! Most network metrics (round trip, loss, rates, NACKs) are diagnostics, which are recorded like
//! all others without code here.

use bevy::{math::DVec3, prelude::*};
use pliant_body::{BodyState, Grab, VisualState};
use pliant_net::{
    GrabRefused, GuestState, HandOf, NetGuest, NetHost, NetPeer, NetStats, PeerState, RemoteHands,
    SessionClosed, SessionFailed, User, UserJoined, UserLeft, Yourself,
};

use crate::{
    RerunScalars,
    collect::{Hands, Whose},
    frame::RecordedHand,
};

pub(crate) fn log_users(
    mut joined: MessageReader<UserJoined>,
    mut left: MessageReader<UserLeft>,
    mut refused: MessageReader<GrabRefused>,
    mut closed: MessageReader<SessionClosed>,
    mut failed: MessageReader<SessionFailed>,
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
    for session in failed.read() {
        own.warn(format!("there is no session: {}", session.reason));
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
        (Some(host), ..) => (format!("hosting, {} guests", host.guests().count()), true),
        (None, Some(guest), _) => match guest.state() {
            GuestState::Joining => ("joining".into(), false),
            GuestState::In { user } => (format!("in the session as user {}", user.0), true),
            GuestState::Lost { reason } => (format!("lost the connection to the host: {reason}"), false),
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
pub(crate) fn log_connection(
    host: Option<Res<NetHost>>,
    guest: Option<Res<NetGuest>>,
    peer: Option<Res<NetPeer>>,
    mut own: ResMut<RerunScalars>,
    mut logged: Local<String>,
) {
    let Some((standing, stands)) = standing(host.as_deref(), guest.as_deref(), peer.as_deref()) else {
        // The next session is logged anew, whatever it is.
        return logged.clear();
    };
    if *logged == standing {
        return;
    }
    if stands {
        own.log(standing.clone());
    } else {
        own.warn(standing.clone());
    }
    *logged = standing;
}

/// Records the state of the connection, its jitter and whether it is queueing, once per second. The
/// rate of dropped datagrams, `net/dropped`, comes from the diagnostics.
pub(crate) fn log_metrics(
    host: Option<Res<NetHost>>,
    guest: Option<Res<NetGuest>>,
    peer: Option<Res<NetPeer>>,
    stats: Option<Res<NetStats>>,
    time: Res<Time>,
    mut own: ResMut<RerunScalars>,
    mut last: Local<Option<f64>>,
) {
    let now = time.elapsed_secs_f64();
    if last.is_some_and(|last| (0.0..1.0).contains(&(now - last))) {
        return;
    }
    let Some((_, stands)) = standing(host.as_deref(), guest.as_deref(), peer.as_deref()) else { return };
    *last = Some(now);
    own.set("net/connected", "", f64::from(u8::from(stands)));
    let Some(stats) = stats else { return };
    own.set("net/jitter", "ms", stats.jitter.as_secs_f64() * 1e3);
    own.set("net/queueing", "", f64::from(u8::from(stats.queueing)));
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
    for (hands, state, visual, place) in &bodies {
        for hand in &hands.0 {
            let user = users.iter().find(|user| user.id == hand.user);
            let name = user.map_or_else(|| format!("user {}", hand.user.0), |user| user.name.clone());
            let point = place
                .affine()
                .transform_point3(surface_point(state, hand.vertex, visual.current()).as_vec3());
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
