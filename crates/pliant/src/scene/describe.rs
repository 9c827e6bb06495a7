//! What a scene file says, word for word.

use serde::Deserialize;

use crate::modal::StepSettings;

/// A scene: bodies, the hands on them, and what is to be added to the app for it.
///
/// Lengths are in m, times in s, y is up. Everything but `bodies` may be left out.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(rename = "Scene", deny_unknown_fields)]
pub struct SceneDescription {
    /// What the scene is called, for people. Default: empty.
    #[serde(default)]
    pub title: String,
    /// Ticks a second, 1 to 2000: the rate of `Time<Fixed>`. Set by [`SceneFilePlugin::open`](super::SceneFilePlugin::open) only: a game that
    /// loads the scene as an asset keeps its own. Default: `None`, as the app has it.
    #[serde(default)]
    pub step_hz: Option<f64>,
    /// Where to look from. The plugin makes no camera; whoever does may follow it. Default: `None`.
    #[serde(default)]
    pub view: Option<ViewEntry>,
    /// The soft bodies, at most [`MAX_BODIES`](super::MAX_BODIES) with their copies.
    pub bodies: Vec<BodyEntry>,
    /// Hands that play a script, at most [`MAX_GRABS`](super::MAX_GRABS). Default: none.
    #[serde(default)]
    pub grabs: Vec<GrabEntry>,
    /// A session. Default: `None`.
    #[serde(default)]
    pub network: Option<NetworkEntry>,
    /// A haptic device. Default: `None`.
    #[serde(default)]
    pub device: Option<DeviceEntry>,
    /// A recording for the rerun viewer. Default: `None`.
    #[serde(default)]
    pub recording: Option<RecordingEntry>,
}

/// A camera's place: round a point.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "View", deny_unknown_fields)]
pub struct ViewEntry {
    /// What is looked at, m.
    pub middle: [f64; 3],
    /// How far from there, m, above 0.
    pub distance: f64,
    /// Angle about the vertical, degrees; 0 looks along -z. Default: 25.
    #[serde(default = "yaw")]
    pub yaw: f64,
    /// Angle above the horizon, degrees. Default: 13.
    #[serde(default = "pitch")]
    pub pitch: f64,
}

fn yaw() -> f64 {
    25.0
}

fn pitch() -> f64 {
    13.0
}

/// A soft body. It is made of a `model` or of a `bake`; in a scene that joins a session neither is needed, as the host sends it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Body", deny_unknown_fields)]
pub struct BodyEntry {
    /// Its name, 1 to 64 bytes, once in a scene; also its name in a session and in a recording.
    pub name: String,
    /// A baked body: a `.modal` file, by its path under the folder of assets.
    #[serde(default)]
    pub model: Option<String>,
    /// A body that is baked when the scene begins (feature `bake`).
    #[serde(default)]
    pub bake: Option<BakeEntry>,
    /// Where it is, with its anchors. Default: at the origin.
    #[serde(default)]
    pub place: TransformEntry,
    /// Several of it, in rows: each is called `NAME.0`, `NAME.1`, row after row. Default: `None`, one called `NAME`.
    #[serde(default)]
    pub copies: Option<CopiesEntry>,
    /// Red, green, blue, 0 to 1 (sRGB); seen with the feature `render`. Default: a warm clay.
    #[serde(default = "color")]
    pub color: [f64; 3],
    /// How rough its surface looks, 0 to 1. Default: 0.45.
    #[serde(default = "roughness")]
    pub roughness: f64,
    /// How it is stepped: `settings: (stiffness_scale: 4, gravity: (0, -9.81, 0))`. Default: all of
    /// [`StepSettings`] at their defaults.
    #[serde(default)]
    pub settings: StepSettings,
    /// How many modes are kept, at least 1. Default: `None`, all.
    #[serde(default)]
    pub modes: Option<usize>,
    /// Where the processor writes the surface, from a basis in half precision: [`ModalBody::half_basis`](crate::body::ModalBody::half_basis).
    /// Default: false.
    #[serde(default)]
    pub half_basis: bool,
    /// Below this speed it comes to rest, m/s; 0 never. Default: `None`, as [`ModalBody::rest_speed`](crate::body::ModalBody::rest_speed).
    #[serde(default)]
    pub rest_speed: Option<f64>,
    /// Whether the pointer may pull it. Default: true.
    #[serde(default = "yes")]
    pub pointer: bool,
    /// Whether it is in the session. Default: `None`: it is where the scene has a `network`.
    #[serde(default)]
    pub shared: Option<bool>,
}

fn color() -> [f64; 3] {
    [0.95, 0.50, 0.36]
}

fn roughness() -> f64 {
    0.45
}

fn yes() -> bool {
    true
}

fn one() -> f64 {
    1.0
}

/// A body that is baked when the scene begins, and kept in the user's cache folder.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Bake", deny_unknown_fields)]
pub struct BakeEntry {
    /// A surface (`.obj`, `.stl`, `.ply`, `.gltf`, `.glb`), a body of rounded parts (`.ron`) or tetrahedra (`.msh`, `.vtk`, `.mesh`, `.veg`), by its
    /// path under the folder of assets.
    pub shape: String,
    /// About how many tetrahedra, 10 to 200,000. Default: 4000.
    #[serde(default = "tets")]
    pub tets: usize,
    /// How many modes, 1 to 500. Default: 20.
    #[serde(default = "bake_modes")]
    pub modes: usize,
    /// Young's modulus, Pa, above 0. Default: 1e5, a soft silicone.
    #[serde(default = "young")]
    pub young: f64,
    /// Poisson ratio, above -1 and below 0.5. Default: 0.4.
    #[serde(default = "poisson")]
    pub poisson: f64,
    /// Density, kg/m^3, above 0. Default: 1000.
    #[serde(default = "density")]
    pub density: f64,
    /// Damping of every mode as a part of the critical one, 0 or more. Default: 0.03.
    #[serde(default = "damping_ratio")]
    pub damping_ratio: f64,
    /// What is held fixed, such as `"y<0.02"`. Default: nothing: a free body.
    #[serde(default)]
    pub anchors: Vec<String>,
}

fn tets() -> usize {
    4000
}

fn bake_modes() -> usize {
    20
}

fn young() -> f64 {
    1e5
}

fn poisson() -> f64 {
    0.4
}

fn density() -> f64 {
    1000.0
}

fn damping_ratio() -> f64 {
    0.03
}

/// Where something is.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Place", deny_unknown_fields)]
pub struct TransformEntry {
    /// m. Default: the origin.
    #[serde(default)]
    pub at: [f64; 3],
    /// Degrees about x, then y, then z. Default: none.
    #[serde(default)]
    pub turn: [f64; 3],
    /// Times its baked size, 0.001 to 1000. Default: 1.
    #[serde(default = "one")]
    pub scale: f64,
}

impl Default for TransformEntry {
    fn default() -> Self {
        Self { at: [0.0; 3], turn: [0.0; 3], scale: 1.0 }
    }
}

/// Bodies in rows and columns on the ground, the middle of them at the entry's place.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Copies", deny_unknown_fields)]
pub struct CopiesEntry {
    /// How many along x and along z, each 1 or more.
    pub count: [usize; 2],
    /// How far apart, m, along x and z.
    pub spacing: [f64; 2],
}

/// A hand that holds a patch of a body and moves by a script.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Grab", deny_unknown_fields)]
pub struct GrabEntry {
    /// Its name, 1 to 64 bytes, once in a scene; messages, recordings and the panel use it.
    pub name: String,
    /// The name of the body that it holds (`NAME.0` of one with copies).
    pub body: String,
    /// Which part of the surface.
    pub patch: PatchEntry,
    /// Radius of the patch on the rest shape, m of the model. Default: `None`, 6 % of the body's size.
    #[serde(default)]
    pub radius: Option<f64>,
    /// How far from where it took hold the hand pulls, m, in the scene's axes. Default: not at all.
    #[serde(default)]
    pub pull: [f64; 3],
    /// What it does about there. Default: `Still`.
    #[serde(default)]
    pub motion: Motion,
    /// When it takes hold, s from when all bodies of the scene are there. Default: 0.
    #[serde(default)]
    pub from: f64,
    /// When it lets go, s, later than `from`. Default: `None`, never.
    #[serde(default)]
    pub until: Option<f64>,
    /// How long it takes to get to its script from where it took hold, s. Default: 0.6.
    #[serde(default = "rise")]
    pub rise: f64,
    /// Stiffness of the hand's own spring, N/m, above 0. Default: `None`, as stiff as the patch allows.
    #[serde(default)]
    pub stiffness: Option<f64>,
    /// Relaxation time of the hand's damper, s. Default: 0.
    #[serde(default)]
    pub relaxation: f64,
    /// Whose hand it is. Default: `Here`.
    #[serde(default)]
    pub by: By,
}

fn rise() -> f64 {
    0.6
}

/// Whose hand a grab is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum By {
    /// Of this app.
    #[default]
    Here,
    /// Of the guest that `network: Host(guest: ..)` runs beside the host.
    Guest,
}

/// A part of a body's surface.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Patch", deny_unknown_fields)]
pub enum PatchEntry {
    /// Round the vertex that is farthest in this direction, in the body's axes.
    Toward([f64; 3]),
    /// Round the vertex that is nearest to this point, m in the body's axes.
    Near([f64; 3]),
    /// Round the vertex of this number.
    Vertex(u32),
}

/// What a hand does, as a distance from where it is held, m.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(rename = "Motion", deny_unknown_fields)]
pub enum Motion {
    /// Nothing.
    #[default]
    Still,
    /// To and fro: `size * sin(2 pi hz t)` along each axis.
    Waves {
        /// m.
        size: [f64; 3],
        /// Hz, 0 to 100.
        hz: [f64; 3],
    },
    /// From point to point, at rest at each of them.
    Path {
        /// In the order of their times. The path begins at no distance at time 0.
        points: Vec<PointEntry>,
        /// Whether it begins anew after the last one, from there. Default: false, it stays there.
        #[serde(default)]
        repeat: bool,
    },
}

/// A point of a path.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Point", deny_unknown_fields)]
pub struct PointEntry {
    /// When it is reached, s from when the hand took hold, above 0.
    pub at: f64,
    /// Where it is, m.
    pub to: [f64; 3],
}

/// A session (feature `net`).
///
/// A `link` is an emulated network under the socket: `paper-1` to `paper-4`, `lan`, `wifi`, `transatlantic` or `satellite`; without one the network
/// is as it is.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Network", deny_unknown_fields)]
pub enum NetworkEntry {
    /// This app hosts; its invite is logged and in [`SceneFilePlugin::invite`](super::SceneFilePlugin::invite).
    Host {
        /// What the user here is called. Default: `host`.
        #[serde(default = "host_name")]
        name: String,
        /// Where to listen. One that others reach lets in only who has the invite. Default: `None`, a free port on this machine.
        #[serde(default)]
        listen: Option<String>,
        /// An emulated network under all guests. Default: `None`.
        #[serde(default)]
        link: Option<String>,
        /// A whole guest beside the host, in the same process, on a thread of its own. Default: `None`.
        #[serde(default)]
        guest: Option<GuestEntry>,
    },
    /// This app joins; the bodies of the scene's names arrive at their places.
    Join {
        /// What the host has printed.
        invite: String,
        /// What the user here is called. Default: `guest`.
        #[serde(default = "guest_name")]
        name: String,
        /// An emulated network. Default: `None`.
        #[serde(default)]
        link: Option<String>,
    },
    /// This app is one of several equal ones. All must have the same bodies.
    Peer {
        /// The invite of one that is there already. Default: `None`, this is the first.
        #[serde(default)]
        invite: Option<String>,
        /// What the user here is called. Default: `peer`.
        #[serde(default = "peer_name")]
        name: String,
        /// Where to listen, as for a host. Default: `None`.
        #[serde(default)]
        listen: Option<String>,
        /// An emulated network. Default: `None`.
        #[serde(default)]
        link: Option<String>,
    },
}

fn host_name() -> String {
    "host".into()
}

fn guest_name() -> String {
    "guest".into()
}

fn peer_name() -> String {
    "peer".into()
}

/// A guest in the host's process: an app without a window behind a link, whose hands are the grabs that are `by: Guest`. What it shows is drawn in the
/// host's window beside the truth.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Guest", deny_unknown_fields)]
pub struct GuestEntry {
    /// What it is called. Default: `guest`.
    #[serde(default = "guest_name")]
    pub name: String,
    /// The emulated network between it and the host. Default: `None`.
    #[serde(default)]
    pub link: Option<String>,
    /// Which packets that loses. Default: 0.
    #[serde(default)]
    pub seed: u64,
    /// How far from the host's bodies those of the guest are drawn, m. Default: at the same place.
    #[serde(default)]
    pub beside: [f64; 3],
}

/// A haptic device (feature `haptics`). Real ones are not opened by a file: that is for a person to do.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Device", deny_unknown_fields)]
pub enum DeviceEntry {
    /// A simulated one in a simulated hand.
    Virtual {
        /// What it is like. Default: `Premium`.
        #[serde(default)]
        like: Like,
        /// How it is held. Default: `Firm`.
        #[serde(default)]
        grip: Grip,
        /// What it begins to touch: the middle of its workspace is there.
        on: TouchEntry,
        /// What the hand does in the device's workspace, m from its middle. Default: `Still`.
        #[serde(default)]
        motion: Motion,
        /// When its button goes down, s from when all bodies are there, at least 0.2: a button counts once it has been seen open. Default: 0.5.
        #[serde(default = "press")]
        from: f64,
        /// When it goes up, s. Default: `None`, never.
        #[serde(default)]
        until: Option<f64>,
        /// Newtons in the hand for a newton in the world, 0 to 100. Default: 1.
        #[serde(default = "one")]
        force_scale: f64,
        /// The loop steps a copy of the body itself. Default: false.
        #[serde(default)]
        modal: bool,
        /// How long the force waits for the simulation's next word before it fades, s, 0.01 to 60: for slow machines, as nobody's hand is on a
        /// simulated device. Default: `None`, as for a real one.
        #[serde(default)]
        patience: Option<f64>,
    },
    /// The pointer, as a device: its force is shown and nobody feels it.
    Pointer {
        /// What it begins to touch.
        on: TouchEntry,
        /// Newtons in the hand for a newton in the world, 0 to 100. Default: 1.
        #[serde(default = "one")]
        force_scale: f64,
    },
}

fn press() -> f64 {
    0.5
}

/// Where a device's workspace is: on a body.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Touch", deny_unknown_fields)]
pub struct TouchEntry {
    /// The body's name.
    pub body: String,
    /// Which part of its surface.
    pub patch: PatchEntry,
}

/// The devices that are simulated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum Like {
    /// 3D Systems Touch: 3.3 N.
    Touch,
    /// PHANTOM Omni: 3.3 N.
    Omni,
    /// PHANTOM Premium 1.5: 8.5 N.
    #[default]
    Premium,
    /// Force Dimension omega.3: 12 N.
    Omega3,
}

/// How a simulated hand holds a simulated device.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum Grip {
    /// As one holds a pen to write.
    #[default]
    Firm,
    /// As one points with it.
    Light,
    /// Barely.
    Loose,
}

/// A recording (feature `rerun`).
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Recording", deny_unknown_fields)]
pub struct RecordingEntry {
    /// A file that ends with `.rrd`, below the working directory. Default: `None`.
    #[serde(default)]
    pub file: Option<String>,
    /// Whether to stream to the viewer on this machine, which is started if it is installed. Default: false.
    #[serde(default)]
    pub viewer: bool,
    /// How often shapes are drawn, Hz, 0 to 1000. Default: 20.
    #[serde(default = "shapes_hz")]
    pub shapes_hz: f64,
    /// How often figures are recorded, Hz, 0 to 1e6. Default: `None`, every tick.
    #[serde(default)]
    pub metrics_hz: Option<f64>,
    /// How often hands are drawn, with their reactions, Hz, 0 to 1e6. Default: `None`, every tick.
    #[serde(default)]
    pub hands_hz: Option<f64>,
    /// How often the energies of the modes and the spectrum are drawn, Hz, 0 to 1000. Default: 4.
    #[serde(default = "modes_hz")]
    pub modes_hz: f64,
    /// What the color of a surface says. Default: `Displacement`.
    #[serde(default)]
    pub color: ColorEntry,
    /// Whether every period of a device's loop is recorded (`RerunRecording::device_loops`). Default: false.
    #[serde(default)]
    pub device_loops: bool,
}

fn shapes_hz() -> f64 {
    20.0
}

fn modes_hz() -> f64 {
    4.0
}

/// What the color of a recorded surface says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename = "Color")]
pub enum ColorEntry {
    /// How far each point is from where it rests: the last color at 0.3 of the body's size.
    #[default]
    Displacement,
    /// Von Mises stress in the skin: the last color at 0.2 of Young's modulus.
    Stress,
}
