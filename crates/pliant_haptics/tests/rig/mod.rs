//! A loop and a virtual device in virtual time.
#![allow(dead_code, reason = "every test uses its own part of it")]

pub mod baked;
pub mod block;
pub mod machine;
pub mod rod;
pub mod scene;
pub mod valley;
pub mod world;

use pliant_haptics::{
    CouplingConfig, Cycle, HandModel, LocalModel, LoopConfig, LoopEvent, SafetyConfig, ToolContact,
    VirtualConfig, VirtualDevice, VirtualScheduler,
};

pub struct Rig {
    pub cycle: Cycle<VirtualDevice>,
    pub scheduler: VirtualScheduler,
    pub model: LocalModel,
    pub events: Vec<LoopEvent>,
}

impl Rig {
    pub fn new(device: VirtualConfig, hand: HandModel, config: LoopConfig) -> Self {
        let device = VirtualDevice::new(device, hand).unwrap();
        let rate = config.rate;
        Self {
            cycle: Cycle::new(device, config).unwrap(),
            scheduler: VirtualScheduler::new(rate),
            model: LocalModel::default(),
            events: Vec::new(),
        }
    }

    /// Creates a rig without any optional stage of the safety pipeline.
    pub fn bare(device: VirtualConfig, hand: HandModel) -> Self {
        let config = LoopConfig { safety: Some(SafetyConfig::bare()), ..LoopConfig::default() };
        Self::new(device, hand, config)
    }

    /// Creates a rig whose safety settings are those for the device, modified by `change`. A test
    /// can leave out stages that it does not measure, such as the ramp.
    pub fn with(device: VirtualConfig, hand: HandModel, change: impl FnOnce(&mut SafetyConfig)) -> Self {
        let mut safety = SafetyConfig::for_device(&device.info(), 1000.0);
        change(&mut safety);
        let config =
            LoopConfig { safety: Some(safety), coupling: CouplingConfig::default(), ..LoopConfig::default() };
        Self::new(device, hand, config)
    }

    pub fn device(&self) -> &VirtualDevice {
        self.cycle.device()
    }

    /// Runs one period with a new local model update: a spring of `stiffness` to the center, with
    /// `damping`.
    pub fn spring(&mut self, stiffness: f64, damping: f64) {
        self.model.tick += 1;
        self.model.stamp = self.scheduler.now();
        self.model.period = 1e-3;
        self.model.count = 1;
        let k = stiffness;
        self.model.contacts[0] = ToolContact {
            stiffness: [[k, 0.0, 0.0], [0.0, k, 0.0], [0.0, 0.0, k]],
            damping,
            ..ToolContact::default()
        };
        self.step();
    }

    /// Runs one period without a new local model update.
    pub fn step(&mut self) {
        self.cycle.step(&mut self.scheduler, &self.model, &mut self.events);
    }
}
