//! The page for browsers: it is written as it is in the crate, its bundle belongs to its sources,
//! and its test has the bytes that the encoders here write. `page/README.md` says how it is made.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

mod support;

use std::fmt::Write;
use std::path::{Path, PathBuf};

use pliant_modal::{ModalModel, ModelHash};
use pliant_stream::watch::{
    BodyDecoder, BodyEncoder, Catalog, CatalogBody, CatalogCamera, WatchConfig, WatchHand, WatchHands,
    WatchNumbers, WatchSurface, coordinate_steps,
};
use pliant_stream::{BodyId, GrabKey, Placement, RigidState, TickState, UserId};
use serde_json::{Value, json};
use support::{Folder, refused, succeeds};

fn page(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("page").join(name)
}

#[test]
fn the_page_is_written_and_nothing_else_is_touched() {
    let folder = Folder::new("page");
    let into = folder.file("site");
    let told = succeeds(&["watch-page", &into]);
    for name in ["index.html", "watch.js", "licenses.txt"] {
        let written = std::fs::read(Path::new(&into).join(name)).unwrap();
        assert!(written == std::fs::read(page("static").join(name)).unwrap(), "{name}");
        assert!(told.contains(name), "{told}");
    }
    assert_eq!(std::fs::read_dir(&into).unwrap().count(), 3);
    // A second time it is the same, and other files stay.
    std::fs::write(Path::new(&into).join("mine.txt"), "mine").unwrap();
    std::fs::write(Path::new(&into).join("watch.js"), "old").unwrap();
    succeeds(&["watch-page", &into]);
    assert_eq!(std::fs::read_dir(&into).unwrap().count(), 4);
    assert!(std::fs::metadata(Path::new(&into).join("watch.js")).unwrap().len() > 100_000);
    // A file is no folder.
    let message = refused(&["watch-page", &folder.write("file", "")]);
    assert!(message.contains("file"), "{message}");
}

/// Whoever changes a source without `npm run build` ships a page that is not what it says.
#[test]
fn the_bundle_is_made_from_these_sources() {
    let mut names: Vec<String> = std::fs::read_dir(page("src"))
        .unwrap()
        .map(|entry| format!("src/{}", entry.unwrap().file_name().to_string_lossy()))
        .collect();
    names.sort();
    names.insert(0, "package-lock.json".into());
    names.insert(0, "build.mjs".into());
    let mut hash = ring::digest::Context::new(&ring::digest::SHA256);
    for name in &names {
        let contents = std::fs::read(page(name)).unwrap();
        hash.update(format!("{name} {}\n", contents.len()).as_bytes());
        hash.update(&contents);
    }
    let expected = hex(hash.finish().as_ref());
    let bundle = std::fs::read_to_string(page("static/watch.js")).unwrap();
    let told = bundle.split("sources ").nth(1).unwrap_or_default();
    assert!(told.starts_with(&expected), "page/static/watch.js is older than page/src: npm run build");
    // Each package in the bundle is named with its license.
    let licenses = std::fs::read_to_string(page("static/licenses.txt")).unwrap();
    for package in ["@moq/net 0.3.4: (MIT OR Apache-2.0)", "three 0.180.0: MIT", "bowser"] {
        assert!(licenses.contains(package), "{package}");
    }
}

/// The page's test decodes this file and compares every number, bit for bit. Whoever changes the
/// formats writes it again with PLIANT_WRITE_VECTORS=1, and changes the page.
#[test]
fn the_bytes_of_the_pages_test_are_those_of_the_encoders() {
    let mut text = String::new();
    let all = json!({
        "catalog": catalog(),
        "hands": hands(),
        "surface": surface(),
        "courses": [course("bud.modal", 30.0), course("jack.modal", 60.0)],
    });
    // A line for each course and frame, so that a change can be read.
    writeln!(text, "{{").unwrap();
    for name in ["catalog", "hands", "surface"] {
        writeln!(text, "\"{name}\": {},", all[name]).unwrap();
    }
    let courses: Vec<String> = all["courses"].as_array().unwrap().iter().map(lines).collect();
    writeln!(text, "\"courses\": [\n{}\n]}}", courses.join(",\n")).unwrap();
    let file = page("test/vectors.json");
    if std::env::var_os("PLIANT_WRITE_VECTORS").is_some() {
        std::fs::write(&file, &text).unwrap();
    }
    assert!(std::fs::read_to_string(&file).unwrap() == text, "{} is of other encoders", file.display());
}

fn lines(course: &Value) -> String {
    let frames: Vec<String> = course["frames"].as_array().unwrap().iter().map(Value::to_string).collect();
    format!(
        "{{\"name\": {}, \"places\": {}, \"frames\": [\n{}\n]}}",
        course["name"],
        course["places"],
        frames.join(",\n")
    )
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn catalog() -> Value {
    let body = CatalogBody {
        id: BodyId(7),
        name: "Tübingen".into(),
        model: ModelHash(std::array::from_fn(|k| 8 * k as u8)),
        file_bytes: 3_000_000,
        surface_bytes: 990_000,
        modes: 30,
        every: 2,
        warps: true,
        free: true,
        placement: Placement { position: [0.5, -2.0, 1e-3], orientation: [0.6, 0.0, 0.0, 0.8], scale: 1.5 },
        color: [255, 128, 7, 200],
    };
    let second = CatalogBody { id: BodyId(65_535), name: String::new(), free: false, ..body.clone() };
    let camera = CatalogCamera { eye: [1.0, 2.0, 3.0], at: [0.0, 0.25, 0.0], field_of_view: 0.75 };
    let catalog = Catalog {
        session: 0xfedc_ba98_7654_3210,
        step: 1.0 / 60.0,
        name: "a lecture".into(),
        bodies: vec![body, second],
        cameras: vec![camera],
    };
    let bytes = catalog.encode();
    assert_eq!(Catalog::decode(&bytes).unwrap(), catalog);
    let bodies: Vec<Value> = catalog
        .bodies
        .iter()
        .map(|body| {
            json!({
                "id": body.id.0, "name": body.name, "model": hex(&body.model.0),
                "surfaceBytes": body.surface_bytes, "modes": body.modes, "every": body.every,
                "warps": body.warps, "free": body.free, "position": doubles(&body.placement.position),
                "orientation": doubles(&body.placement.orientation),
                "scale": f64::from(body.placement.scale), "color": body.color,
            })
        })
        .collect();
    json!({
        "bytes": hex(&bytes),
        "session": catalog.session.to_string(),
        "step": catalog.step,
        "name": catalog.name,
        "bodies": bodies,
        "cameras": [{
            "eye": doubles(&camera.eye), "at": doubles(&camera.at),
            "fieldOfView": f64::from(camera.field_of_view),
        }],
    })
}

fn doubles(of: &[f32]) -> Vec<f64> {
    of.iter().map(|x| f64::from(*x)).collect()
}

fn hands() -> Value {
    let hand = |number: u16| WatchHand {
        body: BodyId(number),
        key: GrabKey { user: UserId(3 * number), grab: 2 },
        target: [0.1 * f64::from(number), -0.7, 1.0 / 3.0],
        reaction: [1.0 / 7.0, -12.5, 0.001 * f64::from(number)],
    };
    let numbers = WatchNumbers { people: 12, loss: Some(0.25), round_trip: 0.123_456, dropped: 70_000 };
    let sent = WatchHands { tick: (1 << 33) + 5, numbers, hands: vec![hand(0), hand(400)] };
    let bytes = sent.encode();
    let got = WatchHands::decode(&bytes).unwrap();
    let hands: Vec<Value> = got
        .hands
        .iter()
        .map(|hand| {
            json!({
                "body": hand.body.0, "user": hand.key.user.0, "grab": hand.key.grab,
                "target": hand.target, "reaction": hand.reaction,
            })
        })
        .collect();
    json!({
        "bytes": hex(&bytes), "tick": got.tick, "people": got.numbers.people, "loss": got.numbers.loss,
        "roundTrip": got.numbers.round_trip, "dropped": got.numbers.dropped, "hands": hands,
    })
}

/// A small surface with large rotations, and its vertices as the reader here draws them.
fn surface() -> Value {
    let entry = |k: usize| ((k * 7919) % 65_535) as i32 - 32_767;
    let surface = WatchSurface {
        model: ModelHash([9; 32]),
        places: vec![0.5, 0.25, 2.0],
        positions: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        scales: vec![[2e-5, 3e-5], [1e-5, 1e-6], [3e-5, 2e-5]],
        displacement: (0..36).map(|k| entry(k) as i16).collect(),
        rotation: (36..72).map(|k| entry(k) as i16).collect(),
    };
    let bytes = surface.encode();
    assert_eq!(WatchSurface::decode(&bytes).unwrap(), surface);
    let q = [0.7, -1.25, 0.4];
    let vertices = |warps| -> Vec<[f64; 3]> {
        (0..4).map(|vertex| surface.vertex_position(vertex, &q, warps).unwrap()).collect()
    };
    json!({
        "bytes": hex(&bytes), "model": hex(&surface.model.0), "places": doubles(&surface.places),
        "q": q, "straight": vertices(false), "warped": vertices(true),
    })
}

/// A body's frames over two seconds: smooth courses, jumps that need the long code, values that
/// need a coarser unit, sleep, and groups that begin anew. All inputs are sums and products of
/// numbers that are the same on every machine.
fn course(model: &str, rate: f64) -> Value {
    let assets = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets");
    let model = ModalModel::read(assets.join(model)).unwrap();
    let places = coordinate_steps(&model, 6);
    let config = WatchConfig { rate, modes: 6, group: 0.7, ..WatchConfig::default() };
    let mut encoder = BodyEncoder::new(&model, config, 1.0 / 60.0).unwrap();
    let mut decoder = BodyDecoder::new(places.clone());
    // A triangle between -1 and 1.
    let wave = |tick: u64, period: u64| {
        let part = (tick % period) as f64 / period as f64;
        if part < 0.5 { 4.0 * part - 1.0 } else { 3.0 - 4.0 * part }
    };
    let (mut frames, mut longest) = (Vec::new(), 0);
    for tick in 5000..5120_u64 {
        let jump = match tick {
            5030..5040 => 300.0,
            5070..5072 => 1e7,
            _ => 1.0,
        };
        let q: Vec<f64> = places
            .iter()
            .enumerate()
            .map(|(k, place)| 0.1 * model.size() * f64::from(*place) * jump * wave(tick, 23 + 11 * k as u64))
            .collect();
        let pose = RigidState {
            position: [wave(tick, 90), 3.0, -wave(tick, 70)],
            rotation: [0.6 * wave(tick, 100), 0.5, 0.5, 0.5],
            ..RigidState::default()
        };
        let norm = pose.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
        let pose = RigidState { rotation: pose.rotation.map(|x| x / norm), ..pose };
        let state = TickState {
            tick,
            q: &q,
            v: &[],
            a: &[],
            z: &[],
            pose: model.is_free().then_some(pose),
            grabs: &[],
            resting: (5100..5110).contains(&tick),
        };
        let Some(frame) = encoder.encode(&state).unwrap() else { continue };
        let (_, got) = decoder.decode(&frame.bytes).unwrap();
        longest = longest.max(if frame.begins_group { 0 } else { frame.bytes.len() });
        let mut one = json!({
            "bytes": hex(&frame.bytes), "begins": frame.begins_group, "tick": got.tick,
            "resting": got.resting, "q": got.q,
        });
        if let Some(pose) = got.pose {
            one["position"] = json!(pose.position);
            one["rotation"] = json!(pose.rotation);
        }
        frames.push(one);
    }
    assert!(longest > 6 * 6, "the long code is among them");
    assert!(frames.iter().filter(|frame| frame["begins"] == true).count() > 3);
    json!({ "name": model.info().name, "places": doubles(&places), "frames": frames })
}
