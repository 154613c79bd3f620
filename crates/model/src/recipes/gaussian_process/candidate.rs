//! One form of the map under given hyper-parameters: posterior of all rows and without each group.

use nalgebra::{DMatrix, DVector, SVector};

use super::edge_noise::{by_edge, position_noise_m2};
use super::groups::Grouping;
use super::hyperparameters::{
    Hyperparameters, LikelihoodPoints, LikelihoodRows, Priors, join, kernel_columns,
};
use super::kernel::inducing_points;
use super::known_rows::KnownRows;
use super::map_rows::{Evidence, MapRows};
use super::noise::{Epoch, ReceiverNoise, ReceiverWhitener};
use super::posterior::{Gram, Posterior, TangentPrior};
use super::projective_mean::{Box4, COEFFICIENTS, FOOT_COEFFICIENTS, ProjectiveMean};
use super::upright_camera::{Parameters, UprightCamera};

/// Rows that hyper-parameters are estimated on at most.
const MAX_LIKELIHOOD_ROWS: usize = 2_500;
/// Inducing points of a map at most.
pub(crate) const MAX_INDUCING: usize = 64;
/// The same where hyper-parameters are estimated.
const MAX_LIKELIHOOD_INDUCING: usize = 40;
/// Rows per inducing point, at least.
const ROWS_PER_INDUCING: usize = 5;
/// Scale of the sides' coefficients where only the foot counts.
const NO_SIDES: f64 = 1e-4;

/// The form of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MapForm {
    /// The foot's homography alone.
    Homography,
    /// The same with the geometry that the boxes' heights tell as prior.
    Upright,
    /// Homography, sides and Gaussian-process residual.
    Residual,
}

impl MapForm {
    pub(crate) const fn as_str(self) -> &'static str {
        match self {
            Self::Homography => "homography",
            Self::Upright => "upright_camera",
            Self::Residual => "residual",
        }
    }
}

/// Change of the coefficients when one group is left out: those of the tangent columns, and the kernel
/// weights of each axis.
type Deviation = (DVector<f64>, [DVector<f64>; 2]);

/// The inducing points of the residual.
#[derive(Debug)]
pub(crate) struct Inducing {
    /// Those of the map.
    of_map: Vec<[f64; 4]>,
    /// Fewer, where hyper-parameters are estimated.
    of_likelihood: Vec<[f64; 4]>,
}

impl Inducing {
    pub(crate) fn new(inputs: &[[f64; 4]]) -> Self {
        let at_most = |most| inducing_points(inputs, (inputs.len() / ROWS_PER_INDUCING).clamp(4, most));
        Self { of_map: at_most(MAX_INDUCING), of_likelihood: at_most(MAX_LIKELIHOOD_INDUCING) }
    }
}

/// A map on its way: rows, where it is linearised, and what gross errors have cost each row.
#[derive(Debug, Clone)]
pub(crate) struct Draft<'a> {
    pub(crate) form: MapForm,
    pub(crate) rows: &'a MapRows,
    pub(crate) inputs: &'a [[f64; 4]],
    pub(crate) inducing: &'a Inducing,
    /// Covariance of left, top, right and bottom, px2.
    pub(crate) edge_px2: &'a [f64; 16],
    pub(crate) mean: ProjectiveMean,
    pub(crate) inflation_m2: Vec<f64>,
    /// Points whose place is known, and what gross errors have cost each of them, m2.
    pub(crate) known: &'a KnownRows,
    pub(crate) known_inflation_m2: Vec<f64>,
    /// The camera whose geometry is the foot's prior, and where it is linearised.
    pub(crate) upright: Option<(&'a UprightCamera, Parameters)>,
}

/// Columns of the linearised model over all rows.
pub(crate) struct Columns {
    pub(crate) tangent: DMatrix<f64>,
    /// Fixes less what the tangent does not explain, m.
    pub(crate) labels_m: DMatrix<f64>,
    pub(crate) phi: DMatrix<f64>,
    /// Per row, variance that the inducing points leave out, m2.
    pub(crate) left_out_m2: Vec<f64>,
}

/// A solved map with everything that leaving groups out needs.
pub(crate) struct MapCandidate {
    pub(crate) form: MapForm,
    pub(crate) mean: ProjectiveMean,
    pub(crate) parameters: Hyperparameters,
    pub(crate) inducing: Vec<[f64; 4]>,
    pub(crate) columns: Columns,
    pub(crate) total: Gram,
    pub(crate) posterior: Posterior,
    /// Without each group.
    pub(crate) without: Vec<Posterior>,
}

impl MapForm {
    /// Gauss-Newton rounds about each set of hyper-parameters.
    const fn relinearizations(self) -> usize {
        match self {
            Self::Homography | Self::Residual => 2,
            Self::Upright => 8,
        }
    }
}

impl<'a> Draft<'a> {
    /// The upright camera that boxes, priors and fixes agree on best, of one start per focal length.
    pub(crate) fn into_upright(
        self,
        camera: &'a UprightCamera,
        parameters: &Hyperparameters,
    ) -> Option<Self> {
        let of_start = |start: &Parameters| {
            let placed = camera.placed(start, &self.mean, &self.rows.boxes, &self.rows.labels_m);
            let mut draft = Draft { form: MapForm::Upright, upright: Some((camera, placed)), ..self.clone() };
            draft.set_coefficients(&camera.coefficients(&placed, &self.mean)?)?;
            draft.relinearize(parameters)?;
            let gram = draft.gram(&draft.columns(draft.evidence(), parameters)?, parameters)?;
            let at = draft.upright.as_ref()?.1;
            let score = gram.misfit_at(&DVector::from_column_slice(&draft.mean.coefficients))
                + 2.0 * camera.evidence(&at)?.misfit;
            score.is_finite().then_some((score, draft))
        };
        camera
            .starts()
            .iter()
            .filter_map(of_start)
            .min_by(|one, other| one.0.total_cmp(&other.0))
            .map(|(_, draft)| draft)
    }

    fn set_coefficients(&mut self, foot: &SVector<f64, FOOT_COEFFICIENTS>) -> Option<()> {
        self.mean.coefficients = [0.0; COEFFICIENTS];
        self.mean.coefficients[..FOOT_COEFFICIENTS].copy_from_slice(foot.as_slice());
        self.mean.coefficients.iter().all(|value| value.is_finite()).then_some(())
    }

    /// Linearises at a solution: at its coefficients, or at the camera that has them to first order.
    fn move_to(&mut self, solution: &DVector<f64>) -> Option<()> {
        let Some((camera, at)) = &mut self.upright else {
            self.mean.coefficients.copy_from_slice(solution.as_slice());
            return self.mean.coefficients.iter().all(|value| value.is_finite()).then_some(());
        };
        let foot = solution.fixed_rows::<FOOT_COEFFICIENTS>(0).into_owned();
        *at = camera.moved_to(at, &self.mean, &foot)?;
        let foot = camera.coefficients(at, &self.mean)?;
        self.set_coefficients(&foot)
    }

    fn inducing(&self) -> &'a [[f64; 4]] {
        match self.form {
            MapForm::Homography | MapForm::Upright => &[],
            MapForm::Residual => &self.inducing.of_map,
        }
    }

    /// Noise and kernel together, then the kernel alone under noise with a sufficient white part; also the
    /// noise before.
    pub(crate) fn estimate(&mut self, priors: &Priors) -> Option<(Hyperparameters, ReceiverNoise)> {
        let first = self.maximize(&priors.start(), priors, false);
        self.relinearize(&first)?;
        let second = self.maximize(&first.with_min_white(), priors, true);
        self.relinearize(&second)?;
        Some((second, first.noise))
    }

    fn maximize(&self, start: &Hyperparameters, priors: &Priors, noise_frozen: bool) -> Hyperparameters {
        let stride = self.inputs.len().div_ceil(MAX_LIKELIHOOD_ROWS).max(1);
        // Pairs of neighbours: what is white and what lasts until the next fix shows between these.
        let picked: Vec<usize> =
            (0..self.inputs.len()).filter(|row| (row / 2).is_multiple_of(stride)).collect();
        let rows = self.rows.picked(&picked);
        let (tangent, labels_m) = linearize(&rows, &self.mean);
        let inputs: Vec<[f64; 4]> = picked.iter().map(|row| self.inputs[*row]).collect();
        let white_m2 = self.white_m2();
        let white_m2: Vec<f64> = picked.iter().map(|row| white_m2[*row]).collect();
        LikelihoodRows {
            epochs: &rows.epochs,
            inputs: &inputs,
            inducing: &self.inducing.of_likelihood,
            tangent: &tangent,
            labels_m: &labels_m,
            white_m2: &white_m2,
            mean: &self.mean,
            known: self.likelihood_points(),
        }
        .maximize(start, priors, noise_frozen)
    }

    fn likelihood_points(&self) -> LikelihoodPoints<'a> {
        let (tangent, labels_m) = linearize(&self.known.rows, &self.mean);
        LikelihoodPoints { points: self.known, tangent, labels_m, variances_m2: self.known_m2() }
    }

    /// The variance of each known point, m2.
    fn known_m2(&self) -> Vec<f64> {
        let own_m2 = self.known.noise_m2(&self.mean);
        own_m2.iter().zip(&self.known_inflation_m2).map(|(own, inflation)| own + inflation).collect()
    }

    /// Variance per axis of each row's position by the noise of its box: the box is an input with errors (the effective
    /// variance of Orear 1982), m2.
    fn box_noise_m2(&self) -> Vec<f64> {
        let of_box = |sides: &Box4| {
            let slopes = self.mean.jacobian(&self.mean.evaluate(sides)).map(by_edge);
            let [east_m2, _, north_m2] = position_noise_m2(&slopes, self.edge_px2);
            0.5 * (east_m2 + north_m2)
        };
        self.rows.boxes.iter().map(of_box).collect()
    }

    /// White variance per row beside the receiver's: that of its box, and what a gross error has cost it, m2.
    fn white_m2(&self) -> Vec<f64> {
        self.box_noise_m2().iter().zip(&self.inflation_m2).map(|(own, inflation)| own + inflation).collect()
    }

    fn prior(&self, parameters: &Hyperparameters) -> Option<TangentPrior> {
        let side_scale = if self.form == MapForm::Residual { parameters.side_scale } else { NO_SIDES };
        let prior = TangentPrior::independent(&self.mean.prior_variances(side_scale));
        let Some((camera, at)) = &self.upright else { return Some(prior) };
        let (mean, precision) = camera.prior_on_coefficients(at, &self.mean)?;
        Some(prior.with_foot(&mean, &precision))
    }

    fn evidence(&self) -> Evidence<'a> {
        Evidence { rows: self.rows, inputs: self.inputs }
    }

    fn columns(
        &self,
        Evidence { rows, inputs }: Evidence<'_>,
        parameters: &Hyperparameters,
    ) -> Option<Columns> {
        let inducing = self.inducing();
        let (tangent, labels_m) = linearize(rows, &self.mean);
        let (phi, left_out_m2) = match self.form {
            MapForm::Residual if !inputs.is_empty() => kernel_columns(inputs, inducing, parameters)?,
            _ => (DMatrix::zeros(inputs.len(), inducing.len()), vec![0.0; inputs.len()]),
        };
        Some(Columns { tangent, labels_m, phi, left_out_m2 })
    }

    /// Gram matrix of all rows and of the known points.
    fn gram(&self, columns: &Columns, parameters: &Hyperparameters) -> Option<Gram> {
        let variances_m2 = columns.variances_m2(&self.white_m2());
        let whitener = ReceiverWhitener::new(&self.rows.epochs, &parameters.noise, &variances_m2);
        self.with_known(Gram::new(columns.joined(), &whitener), parameters)
    }

    /// Gram matrices of groups of rows.
    fn gram_of_groups(
        &self,
        columns: &Columns,
        grouping: &Grouping,
        parameters: &Hyperparameters,
    ) -> Vec<Gram> {
        let (joined, variances_m2) = (columns.joined(), columns.variances_m2(&self.white_m2()));
        let of_group = |rows: &Vec<usize>| {
            let epochs: Vec<Epoch> = rows.iter().map(|row| self.rows.epochs[*row]).collect();
            let variances_m2: Vec<f64> = rows.iter().map(|row| variances_m2[*row]).collect();
            let whitener = ReceiverWhitener::new(&epochs, &parameters.noise, &variances_m2);
            Gram::new(joined.select_rows(rows), &whitener)
        };
        grouping.members().iter().map(of_group).collect()
    }

    /// The Gram matrix of rows with that of the known points added.
    fn with_known(&self, of_rows: Gram, parameters: &Hyperparameters) -> Option<Gram> {
        if self.known.is_empty() {
            return Some(of_rows);
        }
        let columns = self.columns(self.known.evidence(), parameters)?;
        let whitener = self.known.whitener(&columns.variances_m2(&self.known_m2()));
        Some(of_rows.plus(&Gram::new(columns.joined(), &whitener)))
    }

    /// Gauss-Newton steps of the mean, with the weights of rows in gross error found again.
    pub(crate) fn relinearize(&mut self, parameters: &Hyperparameters) -> Option<()> {
        for _ in 0..self.form.relinearizations() {
            let columns = self.columns(self.evidence(), parameters)?;
            let gram = self.gram(&columns, parameters)?;
            let posterior = Posterior::new(&gram, &self.prior(parameters)?)?;
            let kernel_m =
                |columns: &Columns| posterior.kernel.each_ref().map(|weights| &columns.phi * weights);
            let of_rows = kernel_m(&columns);
            let of_known = kernel_m(&self.columns(self.known.evidence(), parameters)?);
            self.move_to(&posterior.tangent)?;
            let residuals_m = less_kernel(&self.rows.misses_m(&self.mean), &of_rows);
            let of_box = self.box_noise_m2();
            let whitener = ReceiverWhitener::new(&self.rows.epochs, &parameters.noise, &self.white_m2());
            let inflation_m2 = whitener.inflation_m2(&residuals_m);
            self.inflation_m2 =
                inflation_m2.iter().zip(&of_box).map(|(all, of_box)| (all - of_box).max(0.0)).collect();
            self.known_inflation_m2 = self.known_inflation_m2(&of_known);
        }
        Some(())
    }

    /// Extra variance of known points that the map contradicts, m2: a wrong one must not bend it.
    fn known_inflation_m2(&self, kernel_m: &[DVector<f64>; 2]) -> Vec<f64> {
        let residuals_m = less_kernel(&self.known.rows.misses_m(&self.mean), kernel_m);
        self.known.inflation_m2(&self.mean, &residuals_m, &self.known.noise_m2(&self.mean))
    }

    /// The posterior of all rows and without each group.
    ///
    /// Groups' Gram matrices add up, so leaving one out is a subtraction; where a target's segments are
    /// groups of their own, each is whitened on its own.
    pub(crate) fn solve(self, parameters: &Hyperparameters, grouping: &Grouping) -> Option<MapCandidate> {
        let columns = self.columns(self.evidence(), parameters)?;
        let prior = self.prior(parameters)?;
        let total = self.gram(&columns, parameters)?;
        let posterior = Posterior::new(&total, &prior)?;
        let groups = self.gram_of_groups(&columns, grouping, parameters);
        let sum = groups.iter().cloned().reduce(|sum, own| sum.plus(&own))?;
        let sum = self.with_known(sum, parameters)?;
        let without =
            groups.iter().map(|own| Posterior::new(&sum.minus(own), &prior)).collect::<Option<_>>()?;
        let inducing = self.inducing().to_vec();
        let Self { form, mean, .. } = self;
        Some(MapCandidate {
            form,
            mean,
            parameters: *parameters,
            inducing,
            columns,
            total,
            posterior,
            without,
        })
    }
}

impl Columns {
    /// All columns side by side, as a Gram matrix takes them.
    fn joined(&self) -> DMatrix<f64> {
        join(&[&self.tangent, &self.phi, &self.labels_m])
    }

    /// White variance per row with what the inducing points leave out, m2.
    fn variances_m2(&self, white_m2: &[f64]) -> Vec<f64> {
        self.left_out_m2.iter().zip(white_m2).map(|(left_out, white)| left_out + white).collect()
    }

    fn slopes(&self, row: usize) -> [[f64; COEFFICIENTS]; 2] {
        std::array::from_fn(|axis| std::array::from_fn(|at| self.tangent[(row, axis * COEFFICIENTS + at)]))
    }
}

impl MapCandidate {
    /// A row's fix less its position by a posterior, m, and that position's covariance, m2.
    pub(crate) fn residual(&self, posterior: &Posterior, row: usize) -> ([f64; 2], [f64; 3]) {
        let slopes = self.columns.slopes(row);
        let phi = self.columns.phi.row(row).transpose();
        let residual_m = [0, 1].map(|axis| {
            let by_tangent = DVector::from_column_slice(&slopes[axis]).dot(&posterior.tangent);
            self.columns.labels_m[(row, axis)] - by_tangent - phi.dot(&posterior.kernel[axis])
        });
        let [east_m2, cross_m2, north_m2] = posterior.covariance_m2(&slopes, &phi);
        let left_out_m2 = self.columns.left_out_m2[row];
        (residual_m, [east_m2 + left_out_m2, cross_m2, north_m2 + left_out_m2])
    }

    /// Coefficients without each group less their mean, scaled so that the squares of what they move add
    /// up to the variance to state: the delete-group jackknife, by the share of it that the posterior
    /// does not state already.
    pub(crate) fn jackknife(&self) -> (f64, Vec<Deviation>) {
        let count = self.without.len() as f64;
        let mean = |of: &dyn Fn(&Posterior) -> DVector<f64>| {
            self.without.iter().map(of).fold(of(&self.posterior) * 0.0, |sum, own| sum + own) / count
        };
        let tangent = mean(&|own| own.tangent.clone());
        let kernel = [mean(&|own| own.kernel[0].clone()), mean(&|own| own.kernel[1].clone())];
        let scale = ((count - 1.0) / count).max(0.0).sqrt();
        let mut deviations: Vec<_> = self
            .without
            .iter()
            .map(|own| {
                let kernel = std::array::from_fn(|axis| (&own.kernel[axis] - &kernel[axis]) * scale);
                ((&own.tangent - &tangent) * scale, kernel)
            })
            .collect();
        let share = self.jackknife_share(&deviations);
        for (tangent, kernel) in &mut deviations {
            *tangent *= share.sqrt();
            kernel.iter_mut().for_each(|weights| *weights *= share.sqrt());
        }
        deviations.retain(|_| share > 0.0);
        (share, deviations)
    }

    fn jackknife_share(&self, deviations: &[Deviation]) -> f64 {
        let rows = self.columns.tangent.nrows();
        let (mut jackknife_m2, mut posterior_m2) = (0.0, 0.0);
        for row in (0..rows).step_by(rows.div_ceil(200)) {
            let slopes = self.columns.slopes(row);
            let phi = self.columns.phi.row(row).transpose();
            let [east_m2, _, north_m2] = self.posterior.covariance_m2(&slopes, &phi);
            posterior_m2 += east_m2 + north_m2;
            for (of_tangent, of_kernel) in deviations {
                for axis in 0..2 {
                    let by_tangent = DVector::from_column_slice(&slopes[axis]).dot(of_tangent);
                    jackknife_m2 += (by_tangent + phi.dot(&of_kernel[axis])).powi(2);
                }
            }
        }
        (1.0 - posterior_m2 / f64::max(jackknife_m2, 1e-12)).max(0.0)
    }
}

/// What a mean misses less what the kernel says of it, m.
fn less_kernel(misses_m: &[[f64; 2]], kernel_m: &[DVector<f64>; 2]) -> Vec<[f64; 2]> {
    let own = |(row, miss_m): (usize, &[f64; 2])| [0, 1].map(|axis| miss_m[axis] - kernel_m[axis][row]);
    misses_m.iter().enumerate().map(own).collect()
}

/// Tangent columns of both axes, and fixes less what the tangent does not explain, m.
fn linearize(rows: &MapRows, mean: &ProjectiveMean) -> (DMatrix<f64>, DMatrix<f64>) {
    let count = rows.boxes.len();
    let mut tangent = DMatrix::zeros(count, 2 * COEFFICIENTS);
    let mut labels_m = DMatrix::zeros(count, 2);
    for row in 0..count {
        let sides: &Box4 = &rows.boxes[row];
        let evaluation = mean.evaluate(sides);
        let slopes = evaluation.tangent();
        for axis in 0..2 {
            let mut linear_m = 0.0;
            for at in 0..COEFFICIENTS {
                tangent[(row, axis * COEFFICIENTS + at)] = slopes[axis][at];
                linear_m += slopes[axis][at] * mean.coefficients[at];
            }
            labels_m[(row, axis)] =
                rows.labels_m[row][axis] - mean.centre_m[axis] - evaluation.offset_m[axis] + linear_m;
        }
    }
    (tangent, labels_m)
}
