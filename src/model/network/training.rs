//! The training loop: the whole loss of a minibatch as one candle operation over one flat
//! parameter, and Adam over the same flat slice.
//!
//! Biases, small tensors and fresh buffers are what cost in candle on nets this small, so the
//! network is not built of tensors: candle sees one variable and one operation, whose backward
//! pass hands over the gradient that the kernel computed beside the loss. None of candle's own
//! kernels runs, so none of its threads start, and the same seed gives the same bits.
//! What never happens here: scaling, recipes, clocks.

use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp1, Device, Layout, Shape, Tensor, Var};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::forward::NetShape;
use super::kernel::{BatchLoss, Scratch};
pub use super::kernel::{LossSums, LossWeights, TrainingSet};

/// How long and how fast to learn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// Passes over the samples.
    pub epochs: u32,
    /// Samples per step.
    pub batch: usize,
    /// Adam's rate at the start.
    pub learning_rate: f64,
    /// The rate falls by half a cosine to this share of the first; 1 keeps it.
    pub last_rate_share: f64,
}

/// Why a training stopped early.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The observer asked for it.
    #[error("cancelled")]
    Cancelled,
    /// candle refused.
    #[error("the training step failed")]
    Candle(#[from] candle_core::Error),
}

/// Trains a network from given parameters and returns the new ones.
///
/// The observer sees the sums of each epoch (from 1) as they were met on the way.
///
/// # Errors
/// [`TrainError::Cancelled`] once the observer breaks; a fault of candle.
pub fn train(
    shape: &NetShape,
    mut parameters: Vec<f32>,
    set: Arc<TrainingSet>,
    weights: LossWeights,
    schedule: Schedule,
    rng: &mut ChaCha8Rng,
    observer: &mut dyn FnMut(u32, &LossSums) -> ControlFlow<()>,
) -> Result<Vec<f32>, TrainError> {
    let samples = set.len();
    let mut order: Vec<u32> = (0..samples as u32).collect();
    let workspace = Arc::new(Mutex::new(Workspace {
        shape: shape.clone(),
        set,
        weights,
        rows: Vec::with_capacity(schedule.batch),
        scratch: Scratch::new(shape),
        gradient: vec![0.0; parameters.len()],
        sums: LossSums::default(),
    }));
    let operation: Arc<Box<dyn CustomOp1 + Send + Sync>> =
        Arc::new(Box::new(LossOperation(workspace.clone())));
    let variable = Var::from_slice(&parameters, parameters.len(), &Device::Cpu)?;
    let mut adam = Adam::new(parameters.len());
    for epoch in 1..=schedule.epochs {
        shuffle(&mut order, rng);
        let rate = schedule.rate(epoch);
        let mut sums = LossSums::default();
        for rows in order.chunks(schedule.batch.max(1)) {
            lock(&workspace).rows.clone_from(&rows.to_vec());
            let loss = variable.as_tensor().apply_op1_arc(operation.clone())?;
            let gradients = loss.backward()?;
            if let Some(gradient) = gradients.get(variable.as_tensor()) {
                adam.step(&mut parameters, &gradient.to_vec1::<f32>()?, rate);
            }
            variable.set(&Tensor::from_slice(&parameters, parameters.len(), &Device::Cpu)?)?;
            sums.add(&lock(&workspace).sums);
        }
        if observer(epoch, &sums).is_break() {
            return Err(TrainError::Cancelled);
        }
    }
    Ok(parameters)
}

impl Schedule {
    fn rate(&self, epoch: u32) -> f64 {
        let part = f64::from(epoch - 1) / f64::from(self.epochs.max(2) - 1);
        let share = 0.5 * (1.0 + (std::f64::consts::PI * part).cos());
        self.learning_rate * (self.last_rate_share + (1.0 - self.last_rate_share) * share)
    }
}

fn shuffle(order: &mut [u32], rng: &mut ChaCha8Rng) {
    for at in (1..order.len()).rev() {
        order.swap(at, rng.random_range(0..=at));
    }
}

struct Workspace {
    shape: NetShape,
    set: Arc<TrainingSet>,
    weights: LossWeights,
    rows: Vec<u32>,
    scratch: Scratch,
    gradient: Vec<f32>,
    sums: LossSums,
}

fn lock(workspace: &Mutex<Workspace>) -> std::sync::MutexGuard<'_, Workspace> {
    // A panic in the kernel ends the run; what it left behind is overwritten by the next batch.
    workspace.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The mean loss of the workspace's batch as a function of the flat parameters.
struct LossOperation(Arc<Mutex<Workspace>>);

impl CustomOp1 for LossOperation {
    fn name(&self) -> &'static str {
        "hybrid-loss"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let (from, until) = layout
            .contiguous_offsets()
            .ok_or_else(|| candle_core::Error::Msg("the flat parameters must be contiguous".into()))?;
        let parameters = &storage.as_slice::<f32>()?[from..until];
        let Workspace { shape, set, weights, rows, scratch, gradient, sums } = &mut *lock(&self.0);
        *sums = pulp::Arch::new().dispatch(BatchLoss {
            shape,
            parameters,
            set,
            rows,
            weights: *weights,
            scratch,
            gradient,
        });
        let loss = (sums.loss / sums.samples) as f32;
        Ok((CpuStorage::F32(vec![loss]), Shape::from(())))
    }

    fn bwd(&self, argument: &Tensor, _: &Tensor, upstream: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let factor = upstream.to_scalar::<f32>()?;
        let gradient: Vec<f32> = lock(&self.0).gradient.iter().map(|slope| slope * factor).collect();
        Ok(Some(Tensor::from_vec(gradient, argument.shape(), argument.device())?))
    }
}

/// Adam (Kingma and Ba 2015) with the usual constants.
#[derive(Debug)]
struct Adam {
    first: Vec<f32>,
    second: Vec<f32>,
    steps: i32,
}

impl Adam {
    const KEEP_FIRST: f64 = 0.9;
    const KEEP_SECOND: f64 = 0.999;
    /// Moments below it are flushed to zero: they would decay into denormals, which cost a hundred
    /// cycles each and slow every later epoch threefold.
    const FLUSH: f32 = 1e-30;

    fn new(length: usize) -> Self {
        Self { first: vec![0.0; length], second: vec![0.0; length], steps: 0 }
    }

    fn step(&mut self, parameters: &mut [f32], gradient: &[f32], rate: f64) {
        self.steps = self.steps.saturating_add(1);
        let unbias =
            (1.0 - Self::KEEP_SECOND.powi(self.steps)).sqrt() / (1.0 - Self::KEEP_FIRST.powi(self.steps));
        let rate = (rate * unbias) as f32;
        let (keep_first, keep_second) = (Self::KEEP_FIRST as f32, Self::KEEP_SECOND as f32);
        let flush = |moment: f32| if moment.abs() < Self::FLUSH { 0.0 } else { moment };
        pulp::Arch::new().dispatch(|| {
            let moments = self.first.iter_mut().zip(&mut self.second);
            for ((parameter, slope), (first, second)) in parameters.iter_mut().zip(gradient).zip(moments) {
                *first = flush(keep_first * *first + (1.0 - keep_first) * slope);
                *second = flush(keep_second * *second + (1.0 - keep_second) * slope * slope);
                *parameter -= rate * *first / (second.sqrt() + 1e-8);
            }
        });
    }
}
