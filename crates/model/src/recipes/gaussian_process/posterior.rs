//! Bayesian linear regression of whitened rows on tangent and kernel columns.
//!
//! Rows are gathered into one Gram matrix of the whitened columns [tangent east | tangent north | phi |
//! y east | y north]. Gram matrices of independent groups of rows add up, so leaving a group out is a
//! subtraction. East and north share the tangent's coefficients and have kernel weights of their own with
//! one Gram matrix, so the 14 + 2 m unknowns are solved by one Cholesky factor of size m and one of 14.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, SMatrix, SVector};

use super::noise::ReceiverWhitener;
use super::projective_mean::{COEFFICIENTS, FOOT_COEFFICIENTS};

const PHI: usize = 2 * COEFFICIENTS;

/// The Gram matrix of whitened columns, over some rows.
#[derive(Debug, Clone)]
pub(crate) struct Gram(DMatrix<f64>);

impl Gram {
    /// Whitens the columns and multiplies.
    pub(crate) fn new(mut columns: DMatrix<f64>, whitener: &ReceiverWhitener) -> Self {
        let rows = columns.nrows();
        if rows > 0 {
            for column in columns.as_mut_slice().chunks_exact_mut(rows) {
                whitener.apply(column);
            }
        }
        Self(columns.transpose() * columns)
    }

    pub(crate) fn minus(&self, other: &Self) -> Self {
        Self(&self.0 - &other.0)
    }

    pub(crate) fn plus(&self, other: &Self) -> Self {
        Self(&self.0 + &other.0)
    }

    pub(crate) fn kernel_columns(&self) -> usize {
        self.0.ncols() - PHI - 2
    }

    fn tangent(&self) -> DMatrix<f64> {
        let block = |at: usize| self.0.view((at, at), (COEFFICIENTS, COEFFICIENTS)).into_owned();
        block(0) + block(COEFFICIENTS)
    }

    /// Phi^T Phi.
    pub(crate) fn kernel(&self) -> DMatrix<f64> {
        let count = self.kernel_columns();
        self.0.view((PHI, PHI), (count, count)).into_owned()
    }

    /// Phi^T T of one axis.
    fn cross(&self, axis: usize) -> DMatrix<f64> {
        self.0.view((PHI, axis * COEFFICIENTS), (self.kernel_columns(), COEFFICIENTS)).into_owned()
    }

    fn right(&self, from: usize, count: usize, axis: usize) -> DVector<f64> {
        let column = PHI + self.kernel_columns() + axis;
        DVector::from_fn(count, |row, _| self.0[(from + row, column)])
    }

    /// Whitened squared residuals of the tangent alone, with those coefficients.
    pub(crate) fn misfit_at(&self, coefficients: &DVector<f64>) -> f64 {
        let right = self.right(0, COEFFICIENTS, 0) + self.right(COEFFICIENTS, COEFFICIENTS, 1);
        self.square() - 2.0 * coefficients.dot(&right) + coefficients.dot(&(self.tangent() * coefficients))
    }

    /// y^T y over both axes.
    fn square(&self) -> f64 {
        let from = PHI + self.kernel_columns();
        self.0[(from, from)] + self.0[(from + 1, from + 1)]
    }
}

/// Normal prior of the tangent's coefficients.
#[derive(Debug, Clone)]
pub(crate) struct TangentPrior {
    pub(crate) mean: DVector<f64>,
    pub(crate) precision: DMatrix<f64>,
    /// Logarithm of the determinant of the covariance.
    log_determinant: f64,
}

impl TangentPrior {
    /// Independent coefficients about 0.
    pub(crate) fn independent(variances: &[f64; COEFFICIENTS]) -> Self {
        Self {
            mean: DVector::zeros(COEFFICIENTS),
            precision: DMatrix::from_diagonal(&DVector::from_fn(COEFFICIENTS, |at, _| 1.0 / variances[at])),
            log_determinant: variances.iter().map(|variance| variance.ln()).sum(),
        }
    }

    /// The foot's coefficients about a mean with a precision of their own; the determinant is that of the
    /// independent ones, for no likelihood is compared under this prior.
    pub(crate) fn with_foot(
        mut self,
        mean: &SVector<f64, FOOT_COEFFICIENTS>,
        precision: &SMatrix<f64, FOOT_COEFFICIENTS, FOOT_COEFFICIENTS>,
    ) -> Self {
        self.mean.rows_mut(0, FOOT_COEFFICIENTS).copy_from(mean);
        self.precision.view_mut((0, 0), (FOOT_COEFFICIENTS, FOOT_COEFFICIENTS)).copy_from(precision);
        self
    }
}

/// Mean and covariance of all coefficients.
#[derive(Debug, Clone)]
pub(crate) struct Posterior {
    /// Coefficients of the tangent.
    pub(crate) tangent: DVector<f64>,
    /// Kernel weights of east and of north.
    pub(crate) kernel: [DVector<f64>; 2],
    /// Factor of Phi^T Phi + I.
    kernel_factor: Cholesky<f64, Dyn>,
    /// (Phi^T Phi + I)^-1 Phi^T T per axis: what the kernel takes over from each tangent column.
    pub(crate) absorbed: [DMatrix<f64>; 2],
    /// Covariance of the tangent's coefficients.
    pub(crate) tangent_covariance: DMatrix<f64>,
    /// Minus twice the logarithm of the marginal likelihood, without the noise's determinant.
    pub(crate) misfit: f64,
}

impl Posterior {
    /// `None` where the matrices are not positive definite, which finite rows do not give.
    pub(crate) fn new(gram: &Gram, prior: &TangentPrior) -> Option<Self> {
        let count = gram.kernel_columns();
        let kernel_factor = (gram.kernel() + DMatrix::identity(count, count)).cholesky()?;
        let mut precision = gram.tangent() + &prior.precision;
        let mut right = &prior.precision * &prior.mean;
        let prior_square = prior.mean.dot(&right);
        let mut log_determinant = prior.log_determinant;
        let mut absorbed = [DMatrix::zeros(0, 0), DMatrix::zeros(0, 0)];
        let mut explained = 0.0;
        let mut kernel_right = [DVector::zeros(0), DVector::zeros(0)];
        for axis in 0..2 {
            let cross = gram.cross(axis);
            let own = gram.right(PHI, count, axis);
            let solved = kernel_factor.solve(&cross);
            precision -= cross.transpose() * &solved;
            right += gram.right(axis * COEFFICIENTS, COEFFICIENTS, axis) - solved.transpose() * &own;
            explained += own.dot(&kernel_factor.solve(&own));
            absorbed[axis] = solved;
            kernel_right[axis] = own;
            log_determinant += 2.0 * kernel_factor.l_dirty().diagonal().map(f64::ln).sum();
        }
        let precision = 0.5 * (&precision + precision.transpose());
        // Numerators and denominators differ by orders of magnitude: scale before factoring.
        let scale = precision.diagonal().map(|value| 1.0 / value.max(1e-300).sqrt());
        let scaled = DMatrix::from_fn(COEFFICIENTS, COEFFICIENTS, |row, column| {
            precision[(row, column)] * scale[row] * scale[column] + if row == column { 1e-10 } else { 0.0 }
        });
        let factor = scaled.cholesky()?;
        log_determinant +=
            2.0 * factor.l_dirty().diagonal().map(f64::ln).sum() - 2.0 * scale.map(f64::ln).sum();
        let inverse = factor.inverse();
        let tangent_covariance = DMatrix::from_fn(COEFFICIENTS, COEFFICIENTS, |row, column| {
            inverse[(row, column)] * scale[row] * scale[column]
        });
        let tangent = &tangent_covariance * &right;
        explained += right.dot(&tangent);
        let kernel =
            std::array::from_fn(|axis| kernel_factor.solve(&kernel_right[axis]) - &absorbed[axis] * &tangent);
        let misfit = gram.square() + prior_square - explained + log_determinant;
        Some(Self { tangent, kernel, kernel_factor, absorbed, tangent_covariance, misfit })
    }

    /// Covariance (east, north) of the function at tangent rows and a kernel row, m2, without what the
    /// inducing points leave out.
    pub(crate) fn covariance_m2(&self, tangent: &[[f64; COEFFICIENTS]; 2], phi: &DVector<f64>) -> [f64; 3] {
        let own_m2 = phi.dot(&self.kernel_factor.solve(phi));
        let rows: [DVector<f64>; 2] = std::array::from_fn(|axis| {
            DVector::from_column_slice(&tangent[axis]) - self.absorbed[axis].transpose() * phi
        });
        let product = |one: usize, other: usize| rows[one].dot(&(&self.tangent_covariance * &rows[other]));
        [own_m2 + product(0, 0), product(0, 1), own_m2 + product(1, 1)]
    }
}
