//! The Adam optimiser over flat parameters, and the schedule of its learning rate.

/// Length and learning rates of a training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// Number of epochs.
    pub epochs: u32,
    /// Samples per step.
    pub batch: usize,
    /// Learning rate of the first epoch.
    pub learning_rate: f64,
    /// The rate decreases along half a cosine to this share of the first; 1 keeps it constant.
    pub last_rate_share: f64,
}

impl Schedule {
    /// Learning rate of an epoch, from 1.
    pub(super) fn rate(&self, epoch: u32) -> f64 {
        let part = f64::from(epoch - 1) / f64::from(self.epochs.max(2) - 1);
        let share = 0.5 * (1.0 + (std::f64::consts::PI * part).cos());
        self.learning_rate * (self.last_rate_share + (1.0 - self.last_rate_share) * share)
    }
}

/// Adam (Kingma and Ba 2015) with its default decay rates.
#[derive(Debug)]
pub(super) struct Adam {
    first: Vec<f32>,
    second: Vec<f32>,
    steps: i32,
}

impl Adam {
    const BETA_1: f64 = 0.9;
    const BETA_2: f64 = 0.999;
    /// Moments below this are set to zero: they would decay into subnormal numbers, which cost a hundred
    /// cycles each and make every later epoch three times slower.
    const FLUSH: f32 = 1e-30;

    pub(super) fn new(length: usize) -> Self {
        Self { first: vec![0.0; length], second: vec![0.0; length], steps: 0 }
    }

    /// Updates the parameters by one step along the gradient.
    pub(super) fn step(&mut self, parameters: &mut [f32], gradient: &[f32], rate: f64) {
        self.steps = self.steps.saturating_add(1);
        let bias_correction =
            (1.0 - Self::BETA_2.powi(self.steps)).sqrt() / (1.0 - Self::BETA_1.powi(self.steps));
        let rate = (rate * bias_correction) as f32;
        let (beta_1, beta_2) = (Self::BETA_1 as f32, Self::BETA_2 as f32);
        let flush = |moment: f32| if moment.abs() < Self::FLUSH { 0.0 } else { moment };
        pulp::Arch::new().dispatch(|| {
            let moments = self.first.iter_mut().zip(&mut self.second);
            for ((parameter, derivative), (first, second)) in parameters.iter_mut().zip(gradient).zip(moments)
            {
                *first = flush(beta_1 * *first + (1.0 - beta_1) * derivative);
                *second = flush(beta_2 * *second + (1.0 - beta_2) * derivative * derivative);
                *parameter -= rate * *first / (second.sqrt() + 1e-8);
            }
        });
    }
}
