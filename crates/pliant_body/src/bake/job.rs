//! One bake on its own threads.

use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

use bevy::{
    platform::time::Instant,
    prelude::*,
    tasks::{AsyncComputeTaskPool, Task, block_on, poll_once},
};
use pliant_bake::{BakeCache, BakeConfig, Paint, Stage, bake, bake_cached};
use pliant_mesh::{
    Repair, StuffOptions, Surface, TetMesh,
    io::{self, Input},
    stuff,
};
use pliant_modal::ModalModel;

use super::{BakeBodyError, BakeProgress, BakeRequest, BakeShape, BakeSkin, BakeStage};

pub(super) enum Outcome {
    Baked { model: Box<ModalModel>, seconds: f64, cached: bool, repair: Option<Repair> },
    Failed(BakeBodyError),
    Cancelled,
}

pub(super) struct BakeJob {
    /// Entity of the request. `None` after the request was dropped.
    pub entity: Option<Entity>,
    task: Task<Outcome>,
    shared: Arc<BakeShared>,
}

/// State shared between the bake and the main thread.
#[derive(Default)]
struct BakeShared {
    /// The number of the stage in the upper half, the stage's progress in millionths in the lower
    /// half.
    progress: AtomicU64,
    canceled: AtomicBool,
}

const STAGES: [BakeStage; 6] = [
    BakeStage::Mesh,
    BakeStage::Assemble,
    BakeStage::Factor,
    BakeStage::Modes,
    BakeStage::Material,
    BakeStage::Surface,
];

impl BakeShared {
    fn report(&self, stage: u64, share: f64) {
        let millionths = (share.clamp(0.0, 1.0) * 1e6) as u64;
        self.progress.store(stage << 32 | millionths, Ordering::Relaxed);
    }

    fn is_canceled(&self) -> bool {
        self.canceled.load(Ordering::Relaxed)
    }
}

impl BakeJob {
    pub fn start(entity: Entity, request: BakeRequest, cache: Option<BakeCache>) -> Self {
        let shared = Arc::<BakeShared>::default();
        let task = AsyncComputeTaskPool::get().spawn({
            let shared = shared.clone();
            async move { run(&request, cache.as_ref(), &shared).unwrap_or_else(Outcome::Failed) }
        });
        Self { entity: Some(entity), task, shared }
    }

    pub fn cancel(&mut self) {
        self.entity = None;
        self.shared.canceled.store(true, Ordering::Relaxed);
    }

    pub fn poll(&mut self) -> Option<Outcome> {
        block_on(poll_once(&mut self.task))
    }

    pub fn progress(&self) -> BakeProgress {
        let packed = self.shared.progress.load(Ordering::Relaxed);
        let stage = STAGES.get((packed >> 32) as usize).copied().unwrap_or(BakeStage::Surface);
        BakeProgress::Running { stage, share: (packed & u64::from(u32::MAX)) as f32 * 1e-6 }
    }
}

fn run(
    request: &BakeRequest,
    cache: Option<&BakeCache>,
    shared: &BakeShared,
) -> Result<Outcome, BakeBodyError> {
    let start = Instant::now();
    // Invalid requests are refused before the long work starts.
    request.config.check()?;
    // The bake uses half of the cores, because a bake on all cores would slow down the game's
    // frames.
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = rayon::ThreadPoolBuilder::new()
        .num_threads((cores / 2).max(1))
        .thread_name(|number| format!("bake {number}"))
        .build()
        .map_err(|error| BakeBodyError::Threads(error.to_string()))?;
    threads.install(|| {
        let (mesh, skin, repair, paint) = mesh(request, shared)?;
        if shared.is_canceled() {
            return Ok(Outcome::Cancelled);
        }
        let config = match paint {
            Some(paint) => &BakeConfig { paint: Some(paint), ..request.config.clone() },
            None => &request.config,
        };
        let mut progress = |stage, share| {
            let stage = match stage {
                Stage::Assemble => 1,
                Stage::Factor => 2,
                Stage::Modes => 3,
                Stage::Material => 4,
                Stage::Surface => 5,
            };
            shared.report(stage, share);
        };
        let (model, cached) = match cache {
            Some(cache) => {
                let made = bake_cached(cache, &mesh, skin.as_ref(), config, &mut progress)?;
                if let Some(error) = made.not_kept {
                    warn!("a bake is not kept in {}: {error}", cache.folder().display());
                }
                (made.bake.model, made.cached)
            }
            None => (bake(&mesh, skin.as_ref(), config, &mut progress)?.model, false),
        };
        Ok(Outcome::Baked { model: Box::new(model), seconds: start.elapsed().as_secs_f64(), cached, repair })
    })
}

/// Returns the tetrahedra, the visible surface if it is not their boundary, the repair of the input
/// and what is painted in the file, unless the request has a painting.
fn mesh(
    request: &BakeRequest,
    shared: &BakeShared,
) -> Result<(TetMesh, Option<Surface>, Option<Repair>, Option<Paint>), BakeBodyError> {
    let options = StuffOptions::with_target(request.tets);
    let mut progress = |share: f32| shared.report(0, f64::from(share));
    let mut paint = None;
    let ((tets, repair), own) = match &request.shape {
        BakeShape::Distance(distance) => {
            ((stuff(&**distance, &options, &mut progress)?, None), Own("a distance", None))
        }
        // A request begins when its mesh has become a surface.
        BakeShape::Meshes(_) => {
            return Err(BakeBodyError::UnusableMesh { expected: "a mesh that is loaded" });
        }
        BakeShape::Input(input) => fill(Input::clone(input), &options, &mut progress)?,
        BakeShape::File(path) => {
            let (input, painted) = Paint::read(path)?;
            // What the request has wins. The check comes before the long work.
            paint = painted.filter(|_| request.config.paint.is_none());
            paint.as_ref().map_or(Ok(()), Paint::check)?;
            fill(input, &options, &mut progress)?
        }
    };
    let skin = match &request.skin {
        BakeSkin::Tetrahedra => None,
        BakeSkin::Shape => Some(own.1.ok_or(BakeBodyError::NoSurface { got: own.0 })?),
        BakeSkin::File(path) => Some(io::read_surface(path)?),
        BakeSkin::Surface(surface) => Some(Surface::clone(surface)),
    };
    Ok((tets, skin, repair, paint))
}

/// The name of a shape's kind, and its surface if the shape is a surface.
struct Own(&'static str, Option<Surface>);

fn fill(
    input: Input,
    options: &StuffOptions,
    progress: &mut dyn FnMut(f32),
) -> Result<((TetMesh, Option<Repair>), Own), BakeBodyError> {
    let own = match &input {
        Input::Surface(surface) => Own("a surface", Some(surface.clone())),
        Input::Tets(_) => Own("tetrahedra", None),
        _ => Own("a scene of rounded parts", None),
    };
    Ok((input.into_tets(options, progress)?, own))
}
