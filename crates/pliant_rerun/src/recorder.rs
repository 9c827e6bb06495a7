//! Converts frames to rerun's archetypes. Runs on a worker thread, without access to the app's
//! world.

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
    time::Duration,
};

use bevy::platform::time::Instant;
use rerun::{
    Arrows3D, BarChart, Color, EntityPath, EntityPathPart, LineStrips3D, Mesh3D, Points3D, Quaternion,
    RecordingStream, RecordingStreamError, SeriesLines, TextLog, TextLogLevel, Transform3D, ViewCoordinates,
    archetypes::Clear,
};

use crate::{
    RerunColor, RerunStyle, SIM_TIME, TICK, WALL_TIME,
    blueprint::Plots,
    columns::{Columns, HandColumns, Moment},
    frame::{BodyTransform, Drawn, Line, Owed, RecordedContact, RecordedFrame, RecordedHand, ShapeFrame},
    motion::ModalMotion,
    stress::StressSkin,
};

/// Displacement with the last color of the scale, as a fraction of the body's size.
const FULL_COLOR: f32 = 0.3;

/// Stress with the last color of the scale, as a fraction of Young's modulus.
const FULL_STRESS: f32 = 0.2;

/// Length of the arrow of the largest force so far, as a fraction of the largest body's size.
const LONGEST_ARROW: f64 = 0.5;

/// Index in [`COLORS`] of a place where a body touches and holds.
const HOLDS: usize = 2;

/// Index in [`COLORS`] of a place where a body touches and slides.
const SLIDES: usize = 5;

/// Standard acceleration of free fall, m/s^2.
const GRAVITY: f64 = 9.806_65;

/// Time for which a new plot waits for further new plots before the layout is sent again.
const LAYOUT_PAUSE: Duration = Duration::from_millis(700);

/// Colors of hands and series, which are also distinguishable with red-green color blindness (Okabe
/// and Ito).
const COLORS: [[u8; 3]; 7] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [204, 121, 167],
    [213, 94, 0],
    [0, 114, 178],
];

/// Returns the path for text with parts separated by `/`, which may contain any letters.
pub(crate) fn path(text: &str) -> EntityPath {
    text.split('/').filter(|part| !part.is_empty()).map(EntityPathPart::new).collect::<Vec<_>>().into()
}

fn body_path(name: &str) -> EntityPath {
    EntityPath::from(vec![EntityPathPart::new("world"), EntityPathPart::new(name)])
}

pub(crate) struct Recorder {
    stream: RecordingStream,
    plots: Plots,
    layout_due: Option<Instant>,
    bodies: HashMap<Arc<str>, KnownEntity>,
    /// Size of the largest body so far, m, and the largest force so far, N, which scale the arrows.
    size: f64,
    force: f64,
    /// Weight of the heaviest body so far, N, which scales the arrows of contacts.
    weight: f64,
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    sums: Vec<[f32; 3]>,
    stresses: Vec<f32>,
    /// The moment of the data that is logged.
    now: Moment,
    columns: Columns,
    hand_columns: HandColumns,
    /// The size for which arrows, targets and lines were last drawn, m.
    drawn_for: f64,
    /// The color of each line of a plot.
    colors: HashMap<String, Color>,
    /// Names of the hands in the last frame with hand data.
    held: HashSet<String>,
    started: bool,
}

struct KnownEntity {
    body: Arc<Drawn>,
    place: Option<BodyTransform>,
    meshed: bool,
    motion: Option<ModalMotion>,
    skin: Option<StressSkin>,
}

impl Recorder {
    pub fn new(stream: RecordingStream, plots: Plots) -> Self {
        Self {
            stream,
            plots,
            layout_due: None,
            bodies: HashMap::new(),
            size: 0.0,
            force: 0.0,
            weight: 0.0,
            positions: Vec::new(),
            normals: Vec::new(),
            sums: Vec::new(),
            stresses: Vec::new(),
            now: Moment::default(),
            columns: Columns::default(),
            hand_columns: HandColumns::default(),
            drawn_for: 0.0,
            colors: HashMap::new(),
            held: HashSet::new(),
            started: false,
        }
    }

    /// Logs one tick at its times.
    pub fn log(&mut self, frame: &RecordedFrame) -> Result<(), RecordingStreamError> {
        self.at(frame)?;
        for name in &frame.left {
            self.leave(name)?;
        }
        for body in &frame.arrived {
            self.arrive(body)?;
        }
        for shape in &frame.shapes {
            self.shape(shape, frame)?;
        }
        if let Some(hands) = &frame.hands {
            self.hands(hands)?;
        }
        if frame.contacts_changed {
            self.contacts(&frame.contacts)?;
        }
        for (metric, value) in &frame.measured {
            self.scalar(&metric.path, &metric.unit, *value)?;
        }
        for scalar in &frame.scalars {
            self.scalar(&scalar.path, &scalar.unit, scalar.value)?;
        }
        for samples in &frame.samples {
            self.introduce(&samples.path, samples.unit, None)?;
            for &(before, value) in &samples.values {
                self.columns.push(&samples.path, self.now.before(before), value);
            }
        }
        self.lines(&frame.lines)?;
        if self.columns.is_full() {
            self.send()?;
        }
        self.lay_out(false)
    }

    /// Sets the moment of all data that is logged next.
    fn at(&mut self, frame: &RecordedFrame) -> Result<(), RecordingStreamError> {
        if !self.started {
            self.started = true;
            // The app's own times are used, not those of the worker.
            self.stream.set_log_time_enabled(false);
            self.stream.set_log_tick_enabled(false);
            self.stream.log_static("world", &ViewCoordinates::RIGHT_HAND_Y_UP())?;
        }
        self.now = Moment::of(frame);
        self.stream.set_time_sequence(TICK, i64::try_from(frame.tick).unwrap_or(i64::MAX));
        self.stream.set_duration_secs(SIM_TIME, frame.time);
        self.stream.set_timestamp_secs_since_epoch(WALL_TIME, frame.wall);
        Ok(())
    }

    /// Logs what was missed between the last frame and `next`, which is logged afterward.
    pub fn catch_up(&mut self, next: &RecordedFrame, owed: &Owed) -> Result<(), RecordingStreamError> {
        self.at(next)?;
        let gone = self.bodies.keys().filter(|path| !owed.bodies.iter().any(|body| body.path == **path));
        for path in gone.cloned().collect::<Vec<_>>() {
            self.leave(&path)?;
        }
        for body in &owed.bodies {
            self.arrive(body)?;
        }
        if owed.no_hands && next.hands.is_none() {
            self.hands(&[])?;
        }
        if let Some(contacts) = owed.contacts.as_ref().filter(|_| !next.contacts_changed) {
            self.contacts(contacts)?;
        }
        self.lines(&owed.lines)
    }

    /// Sends the waiting metrics and hands.
    pub fn send(&mut self) -> Result<(), RecordingStreamError> {
        self.columns.send(&self.stream).and(self.hand_columns.send(&self.stream))
    }

    fn lines(&mut self, lines: &[Line]) -> Result<(), RecordingStreamError> {
        for line in lines {
            self.plots.note_log();
            let level = if line.warning { TextLogLevel::WARN } else { TextLogLevel::INFO };
            self.stream.log("log", &TextLog::new(line.text.as_str()).with_level(level))?;
        }
        Ok(())
    }

    fn leave(&mut self, path: &Arc<str>) -> Result<(), RecordingStreamError> {
        if self.bodies.remove(path).is_some() {
            self.stream.log(body_path(path), &Clear::recursive())?;
        }
        Ok(())
    }

    fn arrive(&mut self, body: &Arc<Drawn>) -> Result<(), RecordingStreamError> {
        if self.bodies.get(&body.path).is_some_and(|known| Arc::ptr_eq(&known.body, body)) {
            return Ok(());
        }
        self.leave(&body.path)?;
        self.size = self.size.max(body.model.size());
        self.weight = self.weight.max(body.model.mass() * GRAVITY);
        let known = KnownEntity { body: body.clone(), place: None, meshed: false, motion: None, skin: None };
        self.bodies.insert(body.path.clone(), known);
        Ok(())
    }

    /// Sends the final layout and all buffered data.
    pub fn end(mut self) {
        let laid_out = self.send().and(self.lay_out(true));
        let flushed = self.stream.flush_blocking();
        if let Err(error) = laid_out {
            bevy::log::warn!("the last metrics or the layout were not recorded: {error}");
        }
        if let Err(error) = flushed {
            bevy::log::warn!("the end of the recording may be missing: {error}");
        }
    }

    fn lay_out(&mut self, now: bool) -> Result<(), RecordingStreamError> {
        if self.plots.take_changed() {
            self.layout_due.get_or_insert_with(|| Instant::now() + LAYOUT_PAUSE);
        }
        if self.layout_due.is_some_and(|due| now || due <= Instant::now()) {
            self.layout_due = None;
            self.plots.send(&self.stream)?;
        }
        Ok(())
    }

    fn shape(&mut self, shape: &ShapeFrame, frame: &RecordedFrame) -> Result<(), RecordingStreamError> {
        self.modes(shape, frame)?;
        if !(shape.draw || shape.metrics) {
            return Ok(());
        }
        let Some(known) = self.bodies.get_mut(&shape.body.path) else { return Ok(()) };
        let model = &shape.body.model;
        let surface = model.surface();
        let entity = body_path(&shape.body.path);
        if known.place != Some(shape.place) && (shape.draw || known.place.is_none()) {
            known.place = Some(shape.place);
            let BodyTransform { translation, rotation, scale } = shape.place;
            let place = Transform3D::new()
                .with_translation(translation)
                .with_quaternion(Quaternion::from_xyzw(rotation))
                .with_scale(scale);
            self.stream.log(entity.clone(), &place)?;
        }

        self.positions.resize(surface.positions().len(), [0.0; 3]);
        model.basis().reconstruct(frame.coordinates(shape), shape.warped, &mut self.positions);
        let full = FULL_COLOR * model.size() as f32;
        let mut largest = 0.0f32;
        let by_displacement = shape.draw && frame.color == RerunColor::Displacement;
        let mut colors = Vec::with_capacity(if shape.draw { self.positions.len() } else { 0 });
        let mut most_stress = None;
        if frame.color == RerunColor::Stress {
            let skin = known.skin.get_or_insert_with(|| StressSkin::new(surface));
            // A scaled body keeps its stiffness in N/m while its lengths grow. `E L` is constant,
            // so Young's modulus is divided by the scale.
            let young = model.info().young as f32 * shape.stiffness / shape.place.scale.abs();
            let young = if young.is_finite() { young } else { 0.0 };
            let poisson = model.info().poisson as f32;
            most_stress = Some(skin.stress(surface, &self.positions, young, poisson, &mut self.stresses));
            if shape.draw {
                colors.extend(self.stresses.iter().map(|stress| color(stress / (FULL_STRESS * young))));
            }
        }
        for (p, rest) in self.positions.iter().zip(surface.positions()) {
            let moved = [p[0] - rest[0], p[1] - rest[1], p[2] - rest[2]];
            let distance = moved.iter().map(|x| x * x).sum::<f32>().sqrt();
            largest = largest.max(distance);
            if by_displacement {
                colors.push(color(distance / full));
            }
        }
        let largest = f64::from(largest * shape.place.scale);
        if shape.draw {
            match shape.body.style {
                RerunStyle::Surface => {
                    self.normals.resize(self.positions.len(), [0.0; 3]);
                    surface.normals(&self.positions, &mut self.normals, &mut self.sums);
                    let mesh = Mesh3D::update_fields()
                        .with_vertex_positions(self.positions.iter().copied())
                        .with_vertex_normals(self.normals.iter().copied())
                        .with_vertex_colors(colors);
                    // The triangles are sent only with the first mesh.
                    let known = self.bodies.get_mut(&shape.body.path);
                    let first = known.is_some_and(|known| !std::mem::replace(&mut known.meshed, true));
                    let mesh = if first {
                        mesh.with_triangle_indices(surface.triangles().iter().copied())
                    } else {
                        mesh
                    };
                    self.stream.log(entity, &mesh)?;
                }
                RerunStyle::Points => {
                    let radius = 0.004 * model.size() as f32;
                    let points = Points3D::new(self.positions.iter().copied())
                        .with_radii([radius])
                        .with_colors([Color::from_rgb(150, 190, 220)]);
                    self.stream.log(entity, &points)?;
                }
                RerunStyle::Hidden => {}
            }
        }
        if shape.metrics {
            if let Some(stress) = most_stress {
                self.scalar(&format!("stress/{}", shape.body.path), "Pa", f64::from(stress))?;
            }
            self.scalar(&format!("displacement/{}", shape.body.path), "m", largest)?;
            if let Some(energies) = frame.energies(shape) {
                self.scalar(&format!("energy/{}", shape.body.path), "J", energies.iter().sum())?;
            }
        }
        Ok(())
    }

    /// Logs the energies of the modes and the spectrum as bars.
    fn modes(&mut self, shape: &ShapeFrame, frame: &RecordedFrame) -> Result<(), RecordingStreamError> {
        let Some(known) = self.bodies.get_mut(&shape.body.path) else { return Ok(()) };
        let model = &shape.body.model;
        if shape.sample {
            let motion = known.motion.get_or_insert_with(|| ModalMotion::new(model));
            motion.push(model, frame.coordinates(shape), frame.tick, frame.time);
        }
        let Some(energies) = frame.energies(shape).filter(|_| shape.bars) else { return Ok(()) };
        let spectrum = known.motion.as_ref().and_then(ModalMotion::spectrum);
        let name = &shape.body.path;
        let numbers: Vec<f64> = (1..=energies.len()).map(|mode| mode as f64).collect();
        let bars = BarChart::new(energies)
            .with_abscissa(numbers.as_slice())
            .with_color(Color::from_rgb(230, 159, 0));
        let path_of =
            |area: &str| EntityPath::from(vec![EntityPathPart::new(area), EntityPathPart::new(&**name)]);
        self.plots.note_bars("modes", name);
        self.stream.log(path_of("modes"), &bars)?;
        if let Some((frequencies, amplitudes)) = spectrum {
            let scale = f64::from(shape.place.scale);
            let amplitudes: Vec<f64> = amplitudes.iter().map(|a| a * scale).collect();
            let step = frequencies.get(1).copied().unwrap_or(1.0) as f32;
            let widths = vec![step; frequencies.len()];
            let bars = BarChart::new(amplitudes.as_slice())
                .with_abscissa(frequencies.as_slice())
                .with_widths(widths)
                .with_color(Color::from_rgb(86, 180, 233));
            self.plots.note_bars("spectrum", name);
            self.stream.log(path_of("spectrum"), &bars)?;
        }
        Ok(())
    }

    fn hands(&mut self, hands: &[RecordedHand]) -> Result<(), RecordingStreamError> {
        let magnitude = |f: &[f64; 3]| f.iter().map(|x| x * x).sum::<f64>().sqrt();
        self.force = hands.iter().map(|hand| magnitude(&hand.force)).fold(self.force, f64::max);
        let meters_per_newton = if self.force > 0.0 { LONGEST_ARROW * self.size / self.force } else { 0.0 };
        let single = |p: [f64; 3]| p.map(|x| x as f32);
        let color_at = |index: usize, hand: &RecordedHand| {
            hand.color.map_or_else(|| color_of(index), |[r, g, b]| Color::from_rgb(r, g, b))
        };
        if self.drawn_for != self.size {
            self.drawn_for = self.size;
            let size = self.size as f32;
            let arrows = Arrows3D::update_fields().with_radii([0.008 * size]);
            self.stream.log_static("world/hands/reactions", &arrows)?;
            let targets = Points3D::update_fields().with_radii([0.012 * size]);
            self.stream.log_static("world/hands/targets", &targets)?;
            let lines = LineStrips3D::update_fields().with_radii([0.002 * size]);
            self.stream.log_static("world/hands/lines", &lines)?;
        }
        self.hand_columns.begin(self.now);
        for (index, hand) in hands.iter().enumerate() {
            self.hand_columns.push(
                single(hand.force.map(|f| f * meters_per_newton)),
                single(hand.point),
                single(hand.target),
                format!("{} {:.3} N", hand.name, magnitude(&hand.force)),
                color_at(index, hand),
            );
        }

        let mut used = HashSet::new();
        for hand in hands {
            // Two hands of the same name get two lines in the plot.
            let name = (1..)
                .map(|n| if n == 1 { hand.name.to_string() } else { format!("{} {n}", hand.name) })
                .find(|name| !used.contains(name))
                .unwrap_or_default();
            // The line in the plot has the color of the arrow.
            let color = color_at(used.len(), hand);
            self.colored_scalar(&format!("reaction/{name}"), "N", magnitude(&hand.force), Some(color))?;
            used.insert(name);
        }
        // A `Clear` ends the line of a released hand, so that it is not connected to a later grab.
        for name in std::mem::replace(&mut self.held, used).difference(&self.held) {
            self.stream.log(path(&format!("reaction/{name}")), &Clear::flat())?;
        }
        Ok(())
    }

    /// Draws the forces where bodies touch.
    fn contacts(&mut self, places: &[RecordedContact]) -> Result<(), RecordingStreamError> {
        let longest = LONGEST_ARROW * self.size;
        let per_newton = if self.weight > 0.0 { longest / self.weight } else { 0.0 };
        let arrow = |place: &RecordedContact| {
            let force = place.force.map(f64::from);
            let longest = 2.0 * longest / force.iter().map(|f| f * f).sum::<f64>().sqrt();
            force.map(|f| (f * per_newton.min(longest)) as f32)
        };
        let arrows: Vec<[f32; 3]> = places.iter().map(arrow).collect();
        // An arrow ends where it presses: beyond that it would be hidden in the body.
        let start = |(place, arrow): (&RecordedContact, &[f32; 3])| {
            std::array::from_fn::<f32, 3, _>(|k| place.point[k] - arrow[k])
        };
        let color = |place: &RecordedContact| color_of(if place.sliding { SLIDES } else { HOLDS });
        let arrows = Arrows3D::from_vectors(&arrows)
            .with_origins(places.iter().zip(&arrows).map(start))
            .with_colors(places.iter().map(color))
            .with_radii([0.008 * self.size as f32]);
        self.stream.log("world/contacts", &arrows)
    }

    fn scalar(&mut self, name: &str, unit: &str, value: f64) -> Result<(), RecordingStreamError> {
        self.colored_scalar(name, unit, value, None)
    }

    fn colored_scalar(
        &mut self,
        name: &str,
        unit: &str,
        value: f64,
        color: Option<Color>,
    ) -> Result<(), RecordingStreamError> {
        self.introduce(name, unit, color)?;
        self.columns.push(name, self.now, value);
        Ok(())
    }

    /// Adds a new line to the layout and logs its name and color if they are new.
    fn introduce(
        &mut self,
        name: &str,
        unit: &str,
        color: Option<Color>,
    ) -> Result<(), RecordingStreamError> {
        let recolored = color.is_some_and(|color| self.colors.get(name) != Some(&color));
        if let (true, Some(color)) = (recolored, color) {
            self.colors.insert(name.to_owned(), color);
        }
        if self.plots.note(name, unit) || recolored {
            let label = name.split_once('/').map_or(name, |(_, rest)| rest);
            let series = SeriesLines::new().with_names([label]).with_widths([1.5]);
            let series = color.map_or(series.clone(), |color| series.with_colors([color]));
            self.stream.log_static(path(name), &series)?;
        }
        Ok(())
    }
}

fn color_of(index: usize) -> Color {
    let [r, g, b] = COLORS[index % COLORS.len()];
    Color::from_rgb(r, g, b)
}

/// Returns a color from teal at zero over sand to red at one.
fn color(t: f32) -> Color {
    const STOPS: [[f32; 3]; 3] = [[58.0, 140.0, 150.0], [235.0, 200.0, 120.0], [215.0, 60.0, 50.0]];
    let t = if t.is_finite() { t.clamp(0.0, 1.0) * 2.0 } else { 0.0 };
    let (from, to) = if t < 1.0 { (STOPS[0], STOPS[1]) } else { (STOPS[1], STOPS[2]) };
    let t = t.fract() + if t >= 2.0 { 1.0 } else { 0.0 };
    let [r, g, b] = std::array::from_fn(|k| (from[k] + (to[k] - from[k]) * t) as u8);
    Color::from_rgb(r, g, b)
}
