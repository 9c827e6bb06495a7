//! The fuzz targets on a stable compiler: their corpora, and these damaged, for some seconds each.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[path = "support/fuzzing.rs"]
mod fuzzing;
mod support;
#[path = "../../../fuzz/src/lib.rs"]
mod targets;

use std::path::PathBuf;
use std::time::Duration;

const CORPUS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus");

fn corpus(target: &str) -> Vec<Vec<u8>> {
    let folder = PathBuf::from(CORPUS).join(target);
    let mut files: Vec<PathBuf> = folder.read_dir().unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty(), "{} holds nothing", folder.display());
    files.iter().map(|file| std::fs::read(file).unwrap()).collect()
}

#[test]
fn no_bytes_panic_a_parser_or_a_session() {
    std::thread::scope(|scope| {
        for half in 0..2 {
            scope.spawn(move || {
                for (name, target) in targets::TARGETS.into_iter().skip(half).step_by(2) {
                    fuzzing::run(name, corpus(name), target);
                }
            });
        }
    });
}

/// A seed that its parser refuses at once, since the format has changed, leads nowhere.
#[test]
fn seeds_that_were_written_are_still_read() {
    let replay = |bytes: &[u8]| pliant_haptics::Replay::read(bytes).is_ok_and(|r| !r.records().is_empty());
    let model = |bytes: &[u8]| pliant_modal::ModalModel::from_bytes(bytes).is_ok();
    let restored = |bytes: &[u8]| targets::restored(bytes).is_some();
    for (target, names, is_read) in [
        ("saved", &["lies", "falls", "rests", "held", "torn"][..], &restored as &dyn Fn(&[u8]) -> bool),
        ("device", &["three", "omega", "default"], &replay),
        ("model", &["bar", "free"], &model),
    ] {
        for name in names {
            let path = PathBuf::from(CORPUS).join(target).join(name);
            assert!(is_read(&std::fs::read(&path).unwrap()), "{} is refused", path.display());
        }
    }
}

/// Writes the corpora anew: what real sessions send, and small files of every format.
#[test]
#[ignore = "writes into the repository"]
fn corpora_are_written() {
    use pliant_haptics::{Record, Recorder, Sample, VirtualConfig, Wrench};
    use pliant_modal::{ContactMemory, ContactState, FixedObstacle, FixedShape, GrabConfig, HeldPlace};
    use pliant_stream::wire::{PROTOCOL_VERSION, PeerBodyState, PeerMessage, PeerShapes};
    use pliant_stream::{
        Channel, DisconnectReason, GuestSession, GuestSessionConfig, HostSession, HostSessionConfig, PeerId,
        RigidId, RigidState, StepSettings, Surroundings, TickState,
    };
    use support::protocol::direct;

    let root = PathBuf::from(CORPUS);
    let write = |target: &str, name: &str, bytes: &[u8]| {
        std::fs::create_dir_all(root.join(target)).unwrap();
        std::fs::write(root.join(target).join(name), bytes).unwrap();
    };
    let kind = |bytes: &[u8]| bytes.first().copied().unwrap_or(0);
    for policy in ["default", "paper"] {
        let (mut host, mut guest, mut now) = direct::session(policy);
        for tick in 60..140 {
            now += Duration::from_millis(25);
            direct::publish(&mut host, now, tick);
            host.update(now);
            guest.update(now);
            let sent: Vec<_> = std::iter::from_fn(|| host.poll_output()).collect();
            let asked: Vec<_> = std::iter::from_fn(|| guest.poll_output()).collect();
            for (side, out) in sent.iter().map(|o| ("host", o)).chain(asked.iter().map(|o| ("guest", o))) {
                let target = if out.channel == Channel::Datagram { "datagrams" } else { "messages" };
                write(target, &format!("{policy}-{side}-{}", kind(&out.bytes)), &out.bytes);
                write("session", &format!("{policy}-{side}-{}", kind(&out.bytes)), &out.bytes);
            }
        }
    }
    // A guest that joins without the model, takes hold and lets go.
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    host.add_body(direct::BODY, "bar", support::bar(2, 0.05), StepSettings::default()).unwrap();
    let shapes = [
        FixedShape::Plane,
        FixedShape::Ball { radius: 0.5 },
        FixedShape::Box { half: [1.0, 2.0, 3.0], round: 0.25 },
        FixedShape::Capsule { radius: 0.5, half_length: 1.0 },
    ];
    let obstacles = shapes.map(|shape| FixedObstacle { shape, ..FixedObstacle::GROUND }).to_vec();
    let around = Surroundings { obstacles, ..Surroundings::default() };
    host.set_surroundings(direct::BODY, around).unwrap();
    for rigid in [1, 2] {
        host.add_rigid(RigidId(rigid), "crate", RigidState::default()).unwrap();
    }
    let mut guest = GuestSession::new(GuestSessionConfig::default(), 1200).unwrap();
    host.connect(Duration::ZERO, PeerId(1), 1200).unwrap();
    guest.connect(Duration::ZERO).unwrap();
    for look in 1..60_u32 {
        let now = Duration::from_millis(25) * look;
        let (q, tick) = ([0.01, 0.02], u64::from(look));
        let state =
            TickState { tick, q: &q, v: &q, a: &q, z: &[], pose: None, grabs: &[], resting: look > 50 };
        host.publish(now, direct::BODY, &state).unwrap();
        // One moves, one rests, and leaves.
        let moves = RigidState { position: [0.01 * f64::from(look), 0.0, 0.0], ..RigidState::default() };
        let rigids = [(RigidId(1), moves), (RigidId(2), RigidState::default())];
        host.publish_rigids(now, tick, &rigids[..if look < 50 { 2 } else { 1 }]).unwrap();
        match look {
            50 => host.remove_rigid(RigidId(2)),
            20 => drop(guest.begin_grab(now, direct::BODY, 5, 0.1, [1.0; 3], GrabConfig::default())),
            30 => drop(guest.set_interest(direct::BODY, Some(1))),
            40 => guest.end_grab(0),
            _ => {}
        }
        host.update(now);
        guest.update(now);
        while let Some(out) = guest.poll_output() {
            if out.channel == Channel::Datagram {
                host.on_datagram(now, PeerId(1), &out.bytes);
            } else {
                write("messages", &format!("guest-{}", kind(&out.bytes)), &out.bytes);
                host.on_message(now, PeerId(1), &out.bytes);
            }
        }
        while let Some(out) = host.poll_output() {
            if out.channel == Channel::Datagram {
                if kind(&out.bytes) == 8 {
                    write("datagrams", "host-8", &out.bytes);
                }
                guest.on_datagram(now, &out.bytes);
            } else {
                write("messages", &format!("host-{}", kind(&out.bytes)), &out.bytes);
                guest.on_message(now, &out.bytes);
            }
        }
    }
    let mut all = direct::peers(Duration::ZERO);
    for look in 1..40 {
        direct::pass(&mut all, Duration::from_millis(25 * look), |_, _, bytes| {
            write("datagrams", &format!("peer-{}", kind(bytes)), bytes);
        });
    }
    let place = HeldPlace { vertex: 3, radius: 0.0625, displacement: [0.02, 0.0, -0.04] };
    let state = PeerBodyState {
        body: 1,
        q: vec![0.5; 2],
        v: vec![0.5; 2],
        a: vec![0.5; 2],
        z: Vec::new(),
        force: vec![0.0; 2],
        frame: None,
        pulls: Vec::new(),
        contacts: ContactState {
            memory: vec![ContactMemory {
                obstacle: 1,
                site: 2,
                force: [0.0, 3.0, 0.0],
                anchor: [0.5; 3],
                toward: [0.0, -1.0, 0.0],
                leads: Some(1e-3),
            }],
            ..ContactState::default()
        },
        s: vec![0.5; 2],
        shapes: vec![PeerShapes { from: 5, places: vec![place] }],
    };
    for (name, message) in [
        (
            "hello",
            PeerMessage::Hello {
                version: PROTOCOL_VERSION,
                user: 2,
                name: "a peer".into(),
                address: "somewhere".into(),
                joining: true,
                scene: 7,
            },
        ),
        ("welcome", PeerMessage::Welcome { user: 2, others: vec![(3, "elsewhere".into())] }),
        ("request", PeerMessage::StateRequest),
        ("state", PeerMessage::State { tick: 7, now: 9, more: false, bodies: vec![state] }),
        ("shapes", PeerMessage::Shapes { body: 1, from: 12, places: vec![place] }),
        ("goodbye", PeerMessage::Goodbye { reason: DisconnectReason::Left }),
    ] {
        write("peers", name, &message.encode());
    }
    // What watchers get.
    use pliant_stream::watch::{
        BodyEncoder, Catalog, CatalogBody, WatchConfig, WatchHand, WatchHands, WatchSurface,
    };
    let model = support::loose_bar(4, 0.05);
    let body = CatalogBody {
        id: direct::BODY,
        name: "bar".into(),
        model: model.hash(),
        file_bytes: 9,
        surface_bytes: 9,
        modes: 4,
        every: 1,
        warps: true,
        free: true,
        placement: pliant_stream::Placement::default(),
        color: [9; 4],
    };
    let name = "a session".to_owned();
    let catalog = Catalog { session: 1, step: 0.025, name, bodies: vec![body], cameras: Vec::new() };
    write("watch", "catalog", &catalog.encode());
    write(
        "watch",
        "hands",
        &WatchHands { hands: vec![WatchHand::default(); 2], ..WatchHands::default() }.encode(),
    );
    write("watch", "surface", &WatchSurface::new(&support::bar(2, 0.05), 2).encode());
    let config = WatchConfig { rate: 40.0, ..WatchConfig::default() };
    let mut encoder = BodyEncoder::new(&model, config, 0.025).unwrap();
    let mut frames = Vec::new();
    for tick in 0..12 {
        let q = [0.01 * tick as f64, -0.02, 0.0, 0.3];
        let pose = Some(pliant_stream::RigidState::default());
        let (v, a, z, grabs) = (&[][..], &[][..], &[][..], &[][..]);
        let state = pliant_stream::TickState { tick, q: &q, v, a, z, pose, grabs, resting: false };
        let frame = encoder.encode(&state).unwrap().unwrap().bytes;
        frames.push(u8::try_from(frame.len()).unwrap());
        frames.extend(frame);
    }
    write("watch", "frames", &frames);
    write("traces", "trace", b"12.5\nlost # a comment\n13\n");
    write("traces", "loss", b"gilbert:9%:4");
    write("model", "bar", &support::bar(2, 0.05).to_bytes());
    write("model", "free", &support::loose_bar(2, 0.05).to_bytes());
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nf 1/1 3/1 2/1\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    let stl = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n\
               endfacet\nendsolid a\n";
    let ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
               element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    let gltf = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}],
        "bufferViews":[{"buffer":0,"byteLength":36}],"buffers":[{"byteLength":36,
        "uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"}]}"#;
    let msh = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n$EndNodes\n\
               $Elements\n1\n1 4 0 1 2 3 4\n$EndElements\n";
    let vtk = "# vtk DataFile Version 3.0\na\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n0 0 0\n1 0 0\n\
               0 1 0\n0 0 1\nCELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n";
    let medit = "MeshVersionFormatted 2\nDimension 3\nVertices\n4\n0 0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n\
                 Tetrahedra\n1\n1 2 3 4 0\nEnd\n";
    let veg = "*VERTICES\n4 3 0 0\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n*ELEMENTS\nTET\n1 4 0\n1 1 2 3 4\n";
    let ron = "(name: \"a\", parts: [(name: \"b\", shape: Sphere(center: (0, 0, 0), radius: 1.0))])";
    let glb = {
        let mut json = gltf.as_bytes().to_vec();
        json.resize(json.len().next_multiple_of(4), b' ');
        let mut glb = b"glTF\x02\0\0\0".to_vec();
        glb.extend((json.len() as u32 + 20).to_le_bytes());
        glb.extend((json.len() as u32).to_le_bytes());
        glb.extend(b"JSON");
        glb.extend(json);
        glb
    };
    // The binary forms: a triangle of a file of the CAD world, one of a scanner, and a mesh with
    // indices and its numbers in a chunk behind the text.
    let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0_f32]];
    let numbers: Vec<u8> = corners.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
    let stl_bytes = [&[b' '; 80][..], &[1, 0, 0, 0], &[0; 12], &numbers, &[0; 2]].concat();
    let header =
        ply.split_inclusive('\n').take(9).collect::<String>().replace("ascii", "binary_little_endian");
    let face = [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0];
    let ply_bytes = [header.as_bytes(), &numbers, &face].concat();
    let glb_bytes = {
        let mut json = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],
            "nodes":[{"mesh":0,"translation":[0,1,0],"scale":[2,2,2]}],
            "meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1}]}],
            "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],
            "max":[1,1,0]},{"bufferView":1,"componentType":5123,"count":3,"type":"SCALAR"}],
            "bufferViews":[{"buffer":0,"byteLength":36},{"buffer":0,"byteOffset":36,"byteLength":6}],
            "buffers":[{"byteLength":44}]}"#
            .as_bytes()
            .to_vec();
        json.resize(json.len().next_multiple_of(4), b' ');
        let chunk = [&numbers[..], &[0, 0, 1, 0, 2, 0, 0, 0]].concat();
        let mut glb = b"glTF\x02\0\0\0".to_vec();
        glb.extend((12 + 8 + json.len() as u32 + 8 + chunk.len() as u32).to_le_bytes());
        for (kind, part) in [(b"JSON", &json), (b"BIN\0", &chunk)] {
            glb.extend((part.len() as u32).to_le_bytes());
            glb.extend(kind);
            glb.extend(part);
        }
        glb
    };
    for (ending, name, content) in [
        ("stl", "stl-bytes", &stl_bytes[..]),
        ("ply", "ply-bytes", &ply_bytes),
        ("glb", "glb-chunk", &glb_bytes),
        ("obj", "obj", obj.as_bytes()),
        ("stl", "stl", stl.as_bytes()),
        ("ply", "ply", ply.as_bytes()),
        ("gltf", "gltf", gltf.as_bytes()),
        ("glb", "glb", &glb),
        ("msh", "msh", msh.as_bytes()),
        ("vtk", "vtk", vtk.as_bytes()),
        ("mesh", "mesh", medit.as_bytes()),
        ("veg", "veg", veg.as_bytes()),
        ("ron", "ron", ron.as_bytes()),
    ] {
        let number = targets::FORMATS.iter().position(|format| *format == ending).unwrap() as u8;
        let bytes = [&[number], content].concat();
        let path = std::env::temp_dir().join(format!("pliant-corpus-{}.{ending}", std::process::id()));
        std::fs::write(&path, content).unwrap();
        let read = pliant_mesh::io::read(&path);
        std::fs::remove_file(&path).unwrap();
        assert!(read.is_ok(), "{name}: {:?}", read.err());
        write("meshes", name, &bytes);
    }
    // Grabs, targets, ticks with losses, a pause, and bytes of another session.
    let mut script = vec![0];
    for k in [0, 128] {
        script.extend([6 | k, 1, 140, 120, 128, 0, 0, 8 | k, 0, 150, 130, 110, 0x11, 0x52, 0, 15, 30, 0, 0]);
    }
    for (what, target) in [(11, "datagrams"), (12, "messages"), (13, "datagrams"), (14, "messages")] {
        for piece in corpus(target).iter().filter(|piece| piece.len() < 256).take(6) {
            script.extend([what, piece.len() as u8]);
            script.extend(piece);
            script.push(0);
        }
    }
    script.extend([10, 0, 0, 0]);
    write("guests", "script", &script);
    // Both guests hold with one hand of each kind, move for a while, let go and take hold again;
    // with what the network loses, and with pauses.
    let held = |who: [u8; 2], tick: &[u8], again: u8| {
        let mut script = vec![again];
        for round in 0..again {
            for k in who {
                script.extend([6 | k, round, 128, 128, 128, 7 | k, round + 2, 128, 128, 128]);
            }
            for step in 0..12 {
                for (k, grab) in [(who[0], 2 * round), (who[1], 2 * round + 1)] {
                    script.extend([8 | k, grab, 128 + 4 * step, 128, 128 - 2 * step]);
                }
                script.push(tick[usize::from(step) % tick.len()]);
            }
            script.extend([10 | who[0], 2 * round, 0, 10 | who[1], 2 * round + 1, 0, 0]);
        }
        script
    };
    for (name, tick) in [("held", &[0, 0][..]), ("lost", &[0x11, 0x21, 0, 0x34]), ("paused", &[0, 15, 0])] {
        write("guests", name, &held([0, 128], tick, 2));
        // Peers 0 and 2.
        write("mesh", name, &held([0, 128], tick, 2));
    }
    // What peers have sent, from and to each of them between ticks of a held body.
    let mut script = held([0, 64], &[0], 1);
    for (what, target) in [(11, "datagrams"), (13, "peers")] {
        for piece in corpus(target).iter().filter(|piece| piece.len() < 256) {
            for k in 0..3 {
                script.extend([what | k << 6 | ((k + 1) % 3) << 4, piece.len() as u8]);
                script.extend(piece);
                script.push(0);
            }
        }
    }
    script.extend([0x1e, 0, 0]);
    write("mesh", "script", &script);
    for (name, config, count) in [
        ("three", VirtualConfig::touch(), 3),
        ("omega", VirtualConfig::omega3(), 12),
        ("default", VirtualConfig::default(), 1),
    ] {
        let mut recorder = Recorder::new(Vec::new(), &config.info()).unwrap();
        for k in 1..=count {
            let now = 1e-3 * f64::from(k);
            let sample = Sample {
                velocity: (k % 3 > 0).then_some([0.1, -0.2, now]),
                buttons: k,
                sequence: (k % 4 > 0).then_some(u64::from(k)),
                ..Sample::at([0.01 * now, -0.02, 0.03])
            };
            let wrench = Wrench { force: [1.0, 0.0, -now], ..Wrench::default() };
            recorder.write(&Record { now, dt: 1e-3, sample, wrench }).unwrap();
        }
        write("device", name, &recorder.finish().unwrap());
    }
    for (name, hands, stiffness, steps) in [
        ("lies", 1, None, 30),
        ("falls", 0, None, 2),
        ("rests", 0, None, 300),
        ("held", 2, Some(50.0), 60),
        ("torn", 3, None, 12),
    ] {
        let hold = GrabConfig { stiffness, relaxation: if hands == 2 { 0.5 } else { 0.0 } };
        write("saved", name, &postcard::to_allocvec(&targets::saved_body(hands, hold, steps)).unwrap());
    }
}
