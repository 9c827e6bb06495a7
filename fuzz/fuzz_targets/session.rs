//! Fuzzes a host and a guest that receive arbitrary bytes between valid data. Neither may panic,
//! and the visual state must stay finite.
#![no_main]

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use libfuzzer_sys::fuzz_target;
use pliant_modal::{BakeInfo, Damping, Element, ModalModel, ModelParts, SurfaceMesh};
use pliant_stream::{
    BodyId, Channel, GuestSessionConfig, GuestSession, HostSessionConfig, HostSession, PeerId, RecoveryConfig,
    StepSettings, TickState,
};

const BODY: BodyId = BodyId(1);

/// A tetrahedron with two invented modes.
fn model() -> Arc<ModalModel> {
    static MODEL: OnceLock<Arc<ModalModel>> = OnceLock::new();
    let made = || {
        let positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0_f32]];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3_u32]];
        let surface =
            SurfaceMesh::new(positions, triangles, None, vec![true, false, false, false]).expect("sound");
        let omega = vec![10.0, 30.0];
        let damping = Damping::Ratio(0.05);
        let parts = ModelParts {
            info: BakeInfo {
                name: "fuzz".into(),
                tets: 1,
                nodes: 4,
                element: Element::Tet4,
                young: 1e5,
                poisson: 0.3,
                density: 1000.0,
                damping,
                anchors: vec!["x<0.01".into()],
                residual_max: 0.0,
                orthonormality_max: 0.0,
            },
            surface,
            damping: omega.iter().map(|w| damping.coefficient(*w)).collect(),
            participation: vec![[0.0; 3]; 2],
            omega,
            displacement: (0..24).map(|k| 0.1 * k as f32).collect(),
            rotation: (0..24).map(|k| 0.05 * k as f32).collect(),
            free: false,
            mass: 1.0,
            center_of_mass: [0.25; 3],
            inertia: [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]],
            sites: Vec::new(),
            reduced: None,
        };
        Arc::new(ModalModel::from_parts(parts).expect("sound"))
    };
    MODEL.get_or_init(made).clone()
}

fuzz_target!(|bytes: &[u8]| {
    let mut host = HostSession::new(HostSessionConfig::default()).expect("sound");
    host.add_body(BODY, "fuzz", model(), StepSettings::default()).expect("sound");
    let recovery = match bytes.first().copied().unwrap_or(0) % 3 {
        0 => RecoveryConfig::default(),
        1 => RecoveryConfig::paper(),
        _ => RecoveryConfig::none(),
    };
    let mut guest = GuestSession::new(GuestSessionConfig { recovery, ..Default::default() }, 1200).expect("sound");
    guest.add_cached_model(model());
    let mut now = Duration::ZERO;
    host.connect(now, PeerId(1), 1200).expect("sound");
    guest.connect(now).expect("sound");
    let mut chunks = bytes.chunks(97);
    for tick in 1..40 {
        now += Duration::from_millis(25);
        let (q, v) = ([0.01 * tick as f64, 0.002], [0.4, 0.0]);
        let state = TickState { tick, q: &q, v: &v, a: &v, z: &[], pose: None, grabs: &[], resting: false };
        host.publish(now, BODY, &state).expect("sound");
        for _ in 0..2 {
            host.update(now);
            guest.update(now);
            while let Some(o) = guest.poll_output() {
                match o.channel {
                    Channel::Datagram => host.on_datagram(now, PeerId(1), &o.bytes),
                    Channel::Message => host.on_message(now, PeerId(1), &o.bytes),
                }
            }
            while let Some(o) = host.poll_output() {
                match o.channel {
                    Channel::Datagram => guest.on_datagram(now, &o.bytes),
                    Channel::Message => guest.on_message(now, &o.bytes),
                }
            }
        }
        if let Some(chunk) = chunks.next() {
            guest.on_datagram(now, chunk);
            host.on_datagram(now, PeerId(1), chunk);
        }
        if let Some(shown) = guest.body(BODY).and_then(|b| b.visual()) {
            assert!(shown.is_finite());
        }
    }
});
