//! Checks of a scene beyond its types: ranges, unique names, and names that refer to something.

use std::collections::HashMap;
use std::ops::RangeInclusive;

use pliant_path::is_below;

use super::error::nearest;
use super::locate::Step::{self, Field, Item};
use super::{
    BodyEntry, By, DeviceEntry, GrabEntry, MAX_BODIES, MAX_GRABS, Motion, NetworkEntry, PatchEntry,
    SceneDescription, SceneErrorKind, TouchEntry,
};
use crate::modal::StepError;

/// An error, and the path of the value that it is about.
#[derive(Debug)]
pub(super) struct SceneFault {
    pub(super) path: Vec<Step>,
    pub(super) kind: SceneErrorKind,
    pub(super) message: String,
    /// Another value that the message refers to; `{line}` in the message becomes its line.
    pub(super) other: Option<Vec<Step>>,
}

type Checked = Result<(), SceneFault>;

fn fault(path: &[Step], kind: SceneErrorKind, message: impl Into<String>) -> SceneFault {
    SceneFault { path: path.to_vec(), kind, message: message.into(), other: None }
}

/// Largest length, time or force of a scene.
const LARGEST: f64 = 1e6;
/// Longest time, s: one day.
const LONGEST: f64 = 86_400.0;

fn within(path: &[Step], what: &str, value: f64, range: RangeInclusive<f64>) -> Checked {
    // A range never contains NaN.
    if range.contains(&value) {
        return Ok(());
    }
    let message = format!("expected {what} from {} to {}, got {value}", range.start(), range.end());
    Err(fault(path, SceneErrorKind::Value, message))
}

fn above_zero(path: &[Step], what: &str, value: f64, most: f64) -> Checked {
    if value > 0.0 && value <= most {
        return Ok(());
    }
    Err(fault(
        path,
        SceneErrorKind::Value,
        format!("expected {what} above 0 and at most {most}, got {value}"),
    ))
}

fn each<const N: usize>(
    path: &[Step],
    what: &str,
    values: &[f64; N],
    range: &RangeInclusive<f64>,
) -> Checked {
    values
        .iter()
        .enumerate()
        .try_for_each(|(i, &value)| within(&[path, &[Item(i)]].concat(), what, value, range.clone()))
}

fn point(path: &[Step], what: &str, values: &[f64; 3]) -> Checked {
    each(path, what, values, &(-LARGEST..=LARGEST))
}

fn name(path: &[Step], name: &str) -> Checked {
    if !name.is_empty() && name.len() <= 64 && !name.chars().any(char::is_control) {
        return Ok(());
    }
    let message = format!("expected a name of 1 to 64 bytes in one line, got {} bytes", name.len());
    Err(fault(path, SceneErrorKind::Value, message))
}

/// Checks that a path stays under the folder of assets.
fn asset(path: &[Step], file: &str, what: &str) -> Checked {
    if is_below(file) {
        return Ok(());
    }
    let excerpt: String = file.chars().take(80).collect();
    Err(fault(
        path,
        SceneErrorKind::Value,
        format!("expected {what}, a path under the folder of assets, got {excerpt:?}"),
    ))
}

/// Checks the whole scene.
pub(super) fn check(scene: &SceneDescription) -> Checked {
    if let Some(hz) = scene.step_hz {
        within(&[Field("step_hz")], "ticks a second", hz, 1.0..=2000.0)?;
    }
    if let Some(view) = scene.view {
        let at = |field| [Field("view"), Field(field)];
        point(&at("middle"), "meters", &view.middle)?;
        above_zero(&at("distance"), "meters", view.distance, LARGEST)?;
        within(&at("yaw"), "degrees", view.yaw, -3600.0..=3600.0)?;
        within(&at("pitch"), "degrees", view.pitch, -89.0..=89.0)?;
    }
    let names = bodies(scene)?;
    grabs(scene, &names)?;
    network(scene)?;
    device(scene, &names)?;
    recording(scene)
}

/// Checks the bodies and returns the names of all of them, copies included.
fn bodies(scene: &SceneDescription) -> Result<HashMap<String, usize>, SceneFault> {
    let mut names = HashMap::new();
    let mut count = 0_usize;
    for (i, body) in scene.bodies.iter().enumerate() {
        let here = [Field("bodies"), Item(i)];
        let at = |field| [here[0], here[1], Field(field)];
        name(&at("name"), &body.name)?;
        if let Some(copies) = body.copies {
            let inner = |field| [at("copies").as_slice(), &[Field(field)]].concat();
            each(
                &inner("count"),
                "a number of rows",
                &copies.count.map(|n| n as f64),
                &(1.0..=MAX_BODIES as f64),
            )?;
            each(&inner("spacing"), "meters between rows", &copies.spacing, &(0.0..=LARGEST))?;
        }
        count = count.saturating_add(body.count());
        if count > MAX_BODIES {
            let message =
                format!("expected at most {MAX_BODIES} bodies with their copies, got {count} up to here");
            return Err(fault(&here, SceneErrorKind::Value, message));
        }
        for copy in 0..body.count() {
            if let Some(first) = names.insert(body.name_of(copy), i) {
                let message = format!(
                    "the body `{}` is there already, in {{line}}; every body needs a name of its own",
                    body.name_of(copy)
                );
                let other = Some(vec![Field("bodies"), Item(first), Field("name")]);
                return Err(SceneFault { other, ..fault(&at("name"), SceneErrorKind::Name, message) });
            }
        }
        made_of(scene, body, &at)?;
        settings(body, &at)?;
    }
    Ok(names)
}

fn made_of(scene: &SceneDescription, body: &BodyEntry, at: &dyn Fn(&'static str) -> [Step; 3]) -> Checked {
    let sent = matches!(scene.network, Some(NetworkEntry::Join { .. }));
    match (&body.model, &body.bake) {
        (Some(_), Some(_)) => {
            let message =
                format!("the body `{}` has a `model` and a `bake`; expected one of them", body.name);
            Err(fault(&at("bake"), SceneErrorKind::Field, message))
        }
        (None, None) if !sent => {
            let message = format!(
                "the body `{}` is made of nothing; expected `model: \"FILE.modal\"` or `bake: (..)`",
                body.name
            );
            Err(fault(&at("name"), SceneErrorKind::Field, message))
        }
        (None, None) => Ok(()),
        (Some(model), None) => {
            if !model.to_ascii_lowercase().ends_with(".modal") {
                let excerpt: String = model.chars().take(80).collect();
                let message = format!(
                    "expected a baked body, a file that ends with .modal, got {excerpt:?}; `bake: (shape: ..)` bakes others"
                );
                return Err(fault(&at("model"), SceneErrorKind::Value, message));
            }
            asset(&at("model"), model, "a baked body")
        }
        (None, Some(bake)) => {
            let inner = |field| [at("bake").as_slice(), &[Field(field)]].concat();
            asset(&inner("shape"), &bake.shape, "a shape")?;
            within(&inner("tets"), "tetrahedra", bake.tets as f64, 10.0..=200_000.0)?;
            let linear = match bake.material.as_str() {
                "linear" => true,
                "neo-hookean" | "st-venant-kirchhoff" => false,
                other => {
                    let other: String = other.chars().take(80).collect();
                    let message = format!(
                        "expected a material, `neo-hookean`, `st-venant-kirchhoff` or `linear`, got {other:?}"
                    );
                    return Err(fault(&inner("material"), SceneErrorKind::Value, message));
                }
            };
            let (most, poisson) = if linear { (500.0, 0.49999) } else { (120.0, 0.45) };
            within(&inner("modes"), "modes", bake.modes as f64, 1.0..=most)?;
            within(&inner("young"), "Young's modulus in Pa", bake.young, 1e-3..=1e15)?;
            within(&inner("poisson"), "a Poisson ratio", bake.poisson, -0.99..=poisson)?;
            within(&inner("density"), "a density in kg/m^3", bake.density, 1e-6..=1e7)?;
            within(&inner("damping_ratio"), "a damping ratio", bake.damping_ratio, 0.0..=1000.0)?;
            if bake.anchors.len() > 100 {
                return Err(fault(&inner("anchors"), SceneErrorKind::Value, "expected at most 100 anchors"));
            }
            if bake.regions.len() > 64 {
                return Err(fault(&inner("regions"), SceneErrorKind::Value, "expected at most 64 regions"));
            }
            #[cfg(feature = "bake")]
            for (i, region) in bake.regions.iter().enumerate() {
                if let Err(error) = region.parse::<crate::bake::Region>() {
                    let path = [inner("regions"), vec![Item(i)]].concat();
                    return Err(fault(&path, SceneErrorKind::Value, error.to_string()));
                }
            }
            #[cfg(feature = "bake")]
            for (i, anchor) in bake.anchors.iter().enumerate() {
                if let Err(error) = anchor.parse::<crate::bake::Anchor>() {
                    let path = [inner("anchors"), vec![Item(i)]].concat();
                    return Err(fault(&path, SceneErrorKind::Value, error.to_string()));
                }
            }
            Ok(())
        }
    }
}

fn settings(body: &BodyEntry, at: &dyn Fn(&'static str) -> [Step; 3]) -> Checked {
    let inner = |field, part| [at(field).as_slice(), &[Field(part)]].concat();
    point(&inner("place", "at"), "meters", &body.place.at)?;
    each(&inner("place", "turn"), "degrees", &body.place.turn, &(-3600.0..=3600.0))?;
    within(&inner("place", "scale"), "a scale", body.place.scale, 1e-3..=1e3)?;
    each(&at("color"), "a part of red, green and blue", &body.color, &(0.0..=1.0))?;
    within(&at("roughness"), "a roughness", body.roughness, 0.0..=1.0)?;
    if let Some(modes) = body.modes {
        within(&at("modes"), "a number of modes", modes as f64, 1.0..=100_000.0)?;
    }
    body.settings.check().map_err(|error| {
        let mut path = at("settings").to_vec();
        match error {
            StepError::Input { what: "rho_inf", .. } => path.extend([Field("integrator"), Field("rho_inf")]),
            StepError::Input { what: "relaxation ratio", .. } => {
                path.extend([Field("relaxation"), Field("ratio")]);
            }
            StepError::Input { what: "relaxation time", .. } => {
                path.extend([Field("relaxation"), Field("time")]);
            }
            StepError::Input { what, .. } => path.push(Field(what)),
            _ => {}
        }
        fault(&path, SceneErrorKind::Value, error.to_string())
    })?;
    body.rest_speed.map_or(Ok(()), |speed| within(&at("rest_speed"), "m/s", speed, 0.0..=LARGEST))
}

fn grabs(scene: &SceneDescription, bodies: &HashMap<String, usize>) -> Checked {
    if scene.grabs.len() > MAX_GRABS {
        let message = format!("expected at most {MAX_GRABS} grabs, got {}", scene.grabs.len());
        return Err(fault(&[Field("grabs")], SceneErrorKind::Value, message));
    }
    let guest = matches!(scene.network, Some(NetworkEntry::Host { guest: Some(_), .. }));
    let mut names: HashMap<&str, usize> = HashMap::new();
    for (i, grab) in scene.grabs.iter().enumerate() {
        let at = |field| [Field("grabs"), Item(i), Field(field)];
        name(&at("name"), &grab.name)?;
        if let Some(first) = names.insert(&grab.name, i) {
            let message = format!(
                "the grab `{}` is there already, in {{line}}, where it holds `{}`; every grab needs a name of its own",
                grab.name, scene.grabs[first].body
            );
            let other = Some(vec![Field("grabs"), Item(first), Field("name")]);
            return Err(SceneFault { other, ..fault(&at("name"), SceneErrorKind::Name, message) });
        }
        body_there(&at("body"), &format!("the grab `{}` holds", grab.name), &grab.body, bodies)?;
        patch(&at("patch"), &grab.patch)?;
        if grab.by == By::Guest && !guest {
            let message = format!(
                "the grab `{}` is the guest's, and the scene has none; expected `network: Host(guest: (..))`",
                grab.name
            );
            return Err(fault(&at("by"), SceneErrorKind::Name, message));
        }
        hold(grab, &at)?;
    }
    Ok(())
}

fn hold(grab: &GrabEntry, at: &dyn Fn(&'static str) -> [Step; 3]) -> Checked {
    if let Some(radius) = grab.radius {
        within(&at("radius"), "meters", radius, 0.0..=LARGEST)?;
    }
    point(&at("pull"), "meters", &grab.pull)?;
    motion(&at("motion"), &grab.motion)?;
    times(&at("from"), &at("until"), grab.from, grab.until, 0.0)?;
    within(&at("rise"), "seconds", grab.rise, 0.0..=LONGEST)?;
    if let Some(stiffness) = grab.stiffness {
        above_zero(&at("stiffness"), "N/m", stiffness, 1e9)?;
    }
    within(&at("relaxation"), "seconds", grab.relaxation, 0.0..=LONGEST)
}

fn times(from_path: &[Step], until_path: &[Step], from: f64, until: Option<f64>, least: f64) -> Checked {
    within(from_path, "seconds", from, least..=LONGEST)?;
    let Some(until) = until else { return Ok(()) };
    within(until_path, "seconds", until, 0.0..=LONGEST)?;
    if until > from {
        return Ok(());
    }
    let message = format!("expected a time after `from`, which is {from} s, got {until}");
    Err(fault(until_path, SceneErrorKind::Value, message))
}

fn body_there(path: &[Step], who: &str, wanted: &str, bodies: &HashMap<String, usize>) -> Checked {
    if bodies.contains_key(wanted) {
        return Ok(());
    }
    let excerpt: String = wanted.chars().take(80).collect();
    let mut message = format!("{who} a body `{excerpt}` that is not in the scene");
    let mut all: Vec<&str> = bodies.keys().map(String::as_str).collect();
    all.sort_unstable();
    if let Some(near) = nearest(wanted, all.iter().copied()) {
        message.push_str(&format!("; did you mean `{near}`?"));
    } else if all.is_empty() {
        message.push_str("; it has no bodies");
    } else {
        let some: Vec<String> = all.iter().take(6).map(|name| format!("`{name}`")).collect();
        let more = if all.len() > some.len() { ", …" } else { "" };
        message.push_str(&format!("; its bodies are {}{more}", some.join(", ")));
    }
    Err(fault(path, SceneErrorKind::Name, message))
}

fn patch(path: &[Step], patch: &PatchEntry) -> Checked {
    let inside = [path, &[Item(0)]].concat();
    match patch {
        PatchEntry::Near(at) => point(&inside, "meters", at),
        PatchEntry::Toward(way) => {
            point(&inside, "a direction", way)?;
            if way.iter().any(|x| *x != 0.0) {
                return Ok(());
            }
            Err(fault(&inside, SceneErrorKind::Value, "expected a direction, got one without a length"))
        }
        PatchEntry::Vertex(_) => Ok(()),
    }
}

fn motion(path: &[Step], motion: &Motion) -> Checked {
    let inside = |field| [path, &[Field(field)]].concat();
    match motion {
        Motion::Still => Ok(()),
        Motion::Waves { size, hz } => {
            point(&inside("size"), "meters", size)?;
            each(&inside("hz"), "Hz", hz, &(0.0..=100.0))
        }
        Motion::Path { points, .. } => {
            let mut before = 0.0;
            for (i, entry) in points.iter().enumerate() {
                let at = |field| [inside("points"), vec![Item(i), Field(field)]].concat();
                within(&at("at"), "seconds", entry.at, 0.0..=LONGEST)?;
                if entry.at <= before {
                    let message = format!(
                        "expected a time after {before} s, that of the point before, got {}",
                        entry.at
                    );
                    return Err(fault(&at("at"), SceneErrorKind::Value, message));
                }
                point(&at("to"), "meters", &entry.to)?;
                before = entry.at;
            }
            Ok(())
        }
    }
}

fn network(scene: &SceneDescription) -> Checked {
    let at = |field| [Field("network"), Field(field)];
    let address = |value: &Option<String>| -> Checked {
        let Some(value) = value else { return Ok(()) };
        match value.parse::<std::net::SocketAddr>() {
            Ok(_) => Ok(()),
            Err(_) => {
                let excerpt: String = value.chars().take(80).collect();
                let message =
                    format!("expected an address and a port, such as \"0.0.0.0:7400\", got {excerpt:?}");
                Err(fault(&at("listen"), SceneErrorKind::Value, message))
            }
        }
    };
    match &scene.network {
        None => Ok(()),
        Some(NetworkEntry::Host { name: own, listen, link, guest }) => {
            name(&at("name"), own)?;
            address(listen)?;
            network_link(&at("link"), link)?;
            let Some(guest) = guest else { return Ok(()) };
            let inner = |field| [Field("network"), Field("guest"), Field(field)];
            name(&inner("name"), &guest.name)?;
            network_link(&inner("link"), &guest.link)?;
            point(&inner("beside"), "meters", &guest.beside)
        }
        Some(NetworkEntry::Join { invite: given, name: own, link }) => {
            name(&at("name"), own)?;
            network_link(&at("link"), link)?;
            invite(&at("invite"), given)
        }
        Some(NetworkEntry::Peer { invite: given, name: own, listen, link }) => {
            name(&at("name"), own)?;
            address(listen)?;
            network_link(&at("link"), link)?;
            given.as_ref().map_or(Ok(()), |given| invite(&at("invite"), given))
        }
    }
}

#[cfg(feature = "net")]
fn network_link(path: &[Step], link: &Option<String>) -> Checked {
    use crate::stream::emulator::Preset;
    let Some(link) = link.as_ref().filter(|link| Preset::by_name(link).is_none()) else { return Ok(()) };
    let names = Preset::ALL.map(Preset::name);
    let excerpt: String = link.chars().take(80).collect();
    let meant = nearest(link, names).map_or(String::new(), |near| format!("did you mean `{near}`? "));
    let message = format!("no network is called {excerpt:?}; {meant}The networks are {}", names.join(", "));
    Err(fault(path, SceneErrorKind::Name, message))
}

#[cfg(feature = "net")]
fn invite(path: &[Step], invite: &str) -> Checked {
    let parsed = invite.parse::<crate::net::Invite>();
    parsed.map(drop).map_err(|error| fault(path, SceneErrorKind::Value, error.to_string()))
}

/// Without the feature, the whole scene is refused later.
#[cfg(not(feature = "net"))]
fn network_link(_: &[Step], _: &Option<String>) -> Checked {
    Ok(())
}

#[cfg(not(feature = "net"))]
fn invite(_: &[Step], _: &str) -> Checked {
    Ok(())
}

fn device(scene: &SceneDescription, bodies: &HashMap<String, usize>) -> Checked {
    let Some(entry) = &scene.device else { return Ok(()) };
    let at = |field| [Field("device"), Field(field)];
    let touched = |on: &TouchEntry| {
        let inner = |field| [Field("device"), Field("on"), Field(field)];
        body_there(&inner("body"), "the device begins at", &on.body, bodies)?;
        patch(&inner("patch"), &on.patch)
    };
    match entry {
        DeviceEntry::Virtual { on, motion: script, from, until, force_scale, patience, .. } => {
            touched(on)?;
            patience.map_or(Ok(()), |patience| within(&at("patience"), "seconds", patience, 0.01..=60.0))?;
            motion(&at("motion"), script)?;
            times(&at("from"), &at("until"), *from, *until, 0.2)?;
            within(&at("force_scale"), "a scale of forces", *force_scale, 0.0..=100.0)
        }
        DeviceEntry::Pointer { on, force_scale } => {
            touched(on)?;
            within(&at("force_scale"), "a scale of forces", *force_scale, 0.0..=100.0)
        }
    }
}

fn recording(scene: &SceneDescription) -> Checked {
    let Some(recording) = &scene.recording else { return Ok(()) };
    let at = |field| [Field("recording"), Field(field)];
    within(&at("shapes_hz"), "Hz", recording.shapes_hz, 0.0..=1000.0)?;
    within(&at("modes_hz"), "Hz", recording.modes_hz, 0.0..=1000.0)?;
    for (field, hz) in [("metrics_hz", recording.metrics_hz), ("hands_hz", recording.hands_hz)] {
        hz.map_or(Ok(()), |hz| within(&at(field), "Hz", hz, 0.0..=1e6))?;
    }
    let Some(file) = &recording.file else {
        if recording.viewer {
            return Ok(());
        }
        let message = "the recording goes nowhere; expected `file: \"NAME.rrd\"` or `viewer: true`";
        return Err(fault(&[Field("recording")], SceneErrorKind::Field, message));
    };
    let extension = std::path::Path::new(file).extension();
    if is_below(file) && extension.is_some_and(|extension| extension == "rrd") {
        return Ok(());
    }
    let excerpt: String = file.chars().take(80).collect();
    let message =
        format!("expected a file that ends with .rrd, below the working directory, got {excerpt:?}");
    Err(fault(&at("file"), SceneErrorKind::Value, message))
}

impl BodyEntry {
    /// Returns the number of bodies that the entry makes.
    pub fn count(&self) -> usize {
        self.copies.map_or(1, |copies| copies.count[0].saturating_mul(copies.count[1]))
    }

    /// Returns the name of one copy, or the name of the entry if it has no copies.
    pub fn name_of(&self, copy: usize) -> String {
        if self.copies.is_some() { format!("{}.{copy}", self.name) } else { self.name.clone() }
    }
}
