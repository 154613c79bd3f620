//! A small fully connected network: its shape, plain forward pass, loss and gradient, and training.

pub(crate) mod forward;
pub(crate) mod kernel;
pub(crate) mod training;

pub use self::forward::{Activation, Layer, Net, NetShape};
pub use self::kernel::{LossSums, LossWeights, TrainingSet};
pub use self::training::{Schedule, TrainError, train};
