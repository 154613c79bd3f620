//! A small fully connected network: its shape, forward pass, loss and gradient, and training.

mod forward;
pub(crate) mod kernel;
mod optimizer;
mod shape;
mod training_loop;

pub use self::forward::Net;
pub use self::kernel::{LossSums, LossWeights, TrainingSet};
pub use self::optimizer::Schedule;
pub use self::shape::{Activation, Layer, NetShape};
pub use self::training_loop::{TrainError, train};
