//! The training loop: the loss of a minibatch as one candle operation over one flat parameter vector,
//! and Adam over the same vector.
//!
//! For networks this small, candle's time goes into biases, small tensors and fresh buffers. Therefore
//! the network is not built of tensors: candle sees one variable and one operation, whose backward pass
//! returns the gradient that the kernel computed together with the loss. None of candle's own kernels
//! runs, so it starts no threads, and the same seed gives the same bits.

use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp1, Device, Layout, Shape, Tensor, Var};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::kernel::{BatchLoss, LossSums, LossWeights, Scratch, TrainingSet};
use super::optimizer::{Adam, Schedule};
use super::shape::NetShape;

/// Why a training ended early.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The observer requested it.
    #[error("cancelled")]
    Cancelled,
    /// A candle operation failed.
    #[error("the training step failed")]
    Candle(#[from] candle_core::Error),
}

/// Trains a network from initial parameters and returns the trained ones.
///
/// The observer receives the sums of each epoch (from 1), accumulated while the parameters change.
///
/// # Errors
/// [`TrainError::Cancelled`] when the observer breaks; [`TrainError::Candle`] when candle fails.
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
    // A panic in the kernel ends the run; a partial batch is overwritten by the next one.
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
        let gradient: Vec<f32> =
            lock(&self.0).gradient.iter().map(|derivative| derivative * factor).collect();
        Ok(Some(Tensor::from_vec(gradient, argument.shape(), argument.device())?))
    }
}
