//! The command line that every example has.

use std::path::PathBuf;

use clap::Parser;

/// How an example is run.
#[derive(Parser, Debug, Clone, Default)]
#[group(skip)]
pub struct Options {
    /// Run without a window: the scene plays by itself and prints its metrics at the end.
    #[arg(long)]
    pub headless: bool,

    /// Stop after this many frames, counted from when the bodies exist.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub frames: Option<u64>,

    /// Stop after this many seconds. Default: 5 without a window; with a window, until it is
    /// closed.
    #[arg(long, value_parser = seconds, conflicts_with = "frames")]
    pub seconds: Option<f64>,

    /// Let the scene play by itself, save a picture of the window and stop.
    #[arg(long, value_name = "FILE.png")]
    pub screenshot: Option<PathBuf>,

    /// Open the live panel, as F1 does. `--panel=SECTION` unfolds only that section.
    #[arg(long, value_name = "SECTION", num_args = 0..=1, require_equals = true)]
    pub panel: Option<Option<Section>>,

    /// Size of the window in pixels.
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "1280x720", value_parser = size)]
    pub size: Size,

    /// Scale of text and panel, for dense screens. Default: the scale of the screen.
    #[arg(long, value_parser = clap::value_parser!(f32))]
    pub scale: Option<f32>,
}

/// A section of the panel.
#[derive(clap::ValueEnum, Debug, Clone, Copy)]
pub enum Section {
    Time,
    Bodies,
    Session,
    Devices,
    Recording,
}

/// Width and height, pixels.
#[derive(Debug, Clone, Copy)]
pub struct Size(pub u32, pub u32);

impl Default for Size {
    fn default() -> Self {
        Self(1280, 720)
    }
}

fn size(text: &str) -> Result<Size, String> {
    let side = |side: &str| side.parse().ok().filter(|side| (64..=16_384).contains(side));
    let both = text.split_once('x').and_then(|(width, height)| Some(Size(side(width)?, side(height)?)));
    both.ok_or_else(|| "expected WIDTHxHEIGHT, each 64 to 16384".into())
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s.is_finite() && s > 0.0 && s <= 86_400.0 => Ok(s),
        _ => Err("expected seconds above 0 and at most 86400".into()),
    }
}

impl Options {
    /// Returns the panel, which is closed unless `--panel` is given.
    #[cfg(feature = "panel")]
    pub fn panel(&self) -> pliant::panel::PanelPlugin {
        use pliant::panel::PanelSection;
        let section = |section| match section {
            Section::Time => PanelSection::Time,
            Section::Bodies => PanelSection::Bodies,
            Section::Session => PanelSection::Session,
            Section::Devices => PanelSection::Devices,
            Section::Recording => PanelSection::Recording,
        };
        pliant::panel::PanelPlugin {
            open: self.panel.is_some(),
            only: self.panel.flatten().map(section),
            ..Default::default()
        }
    }

    /// Falls back to no window if none can be opened and drawn in.
    pub fn check_window(&mut self) -> Result<(), String> {
        if !self.headless
            && let Some(fault) = fault()
        {
            if self.screenshot.is_some() {
                return Err(format!("a screenshot needs a window, and there is none: {fault}"));
            }
            println!("No window: {fault}. Running --headless, and the scene plays by itself.");
            self.headless = true;
        }
        match &self.screenshot {
            Some(_) if self.headless => Err("a screenshot needs a window: leave out --headless".into()),
            // A file that cannot be written is reported before the scene is played.
            Some(file) => std::fs::write(file, []).map_err(|error| format!("{}: {error}", file.display())),
            None => Ok(()),
        }
    }
}

/// Returns why no window can be opened and drawn in; `None` if one can.
fn fault() -> Option<String> {
    #[cfg(feature = "window")]
    return super::window::fault();
    #[cfg(not(feature = "window"))]
    Some("the feature `window` is off".into())
}
