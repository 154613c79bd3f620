//! Quantiles of Fisher's F distribution, for radii from few receivers.
//!
//! The regularised incomplete beta function by its continued fraction (Abramowitz and Stegun 26.5.8),
//! inverted by bisection.

/// Denominator degrees of freedom from which the chi-square quantile is meant.
const MAX_DENOMINATOR: f64 = 1e6;

/// The value that an F variable with those degrees of freedom stays below with that probability.
pub(crate) fn f_quantile(probability: f64, numerator: f64, denominator: f64) -> f64 {
    let denominator = denominator.min(MAX_DENOMINATOR);
    // P(F <= f) = I_x(numerator / 2, denominator / 2) with x = n f / (n f + d).
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        if regularized_beta(middle, 0.5 * numerator, 0.5 * denominator) < probability {
            low = middle;
        } else {
            high = middle;
        }
    }
    let x = 0.5 * (low + high);
    denominator * x / (numerator * (1.0 - x))
}

fn regularized_beta(x: f64, a: f64, b: f64) -> f64 {
    if x <= 0.0 || x >= 1.0 {
        return x.clamp(0.0, 1.0);
    }
    // The fraction converges quickly only on this side.
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - regularized_beta(1.0 - x, b, a);
    }
    let front = (a * x.ln() + b * (-x).ln_1p() + ln_gamma(a + b) - ln_gamma(a) - ln_gamma(b)).exp() / a;
    let away = |value: f64| if value.abs() < 1e-300 { 1e-300 } else { value };
    let (mut c, mut d) = (1.0, 1.0 / away(1.0 - (a + b) * x / (a + 1.0)));
    let mut fraction = d;
    for term in 1..10_000 {
        let m = f64::from(term);
        for coefficient in [
            m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0)),
        ] {
            d = 1.0 / away(1.0 + coefficient * d);
            c = away(1.0 + coefficient / c);
            fraction *= c * d;
        }
        if (c * d - 1.0).abs() < 1e-14 {
            break;
        }
    }
    front * fraction
}

/// Stirling's series, shifted to where it is exact to double precision.
fn ln_gamma(x: f64) -> f64 {
    let (mut x, mut shift) = (x, 0.0);
    while x < 15.0 {
        shift -= x.ln();
        x += 1.0;
    }
    let inverse = 1.0 / (x * x);
    let series = (1.0 / 12.0 - inverse * (1.0 / 360.0 - inverse * (1.0 / 1260.0 - inverse / 1680.0))) / x;
    shift + (x - 0.5) * x.ln() - x + 0.5 * (2.0 * std::f64::consts::PI).ln() + series
}

#[cfg(test)]
mod tests {
    use super::f_quantile;

    #[test]
    fn quantiles_are_those_of_the_tables() {
        for (numerator, denominator, tabulated) in [
            (2.0, 4.0, 6.944),
            (1.0, 10.0, 4.965),
            (2.0, 38.0, 3.245),
            (2.0, 1e6, 2.9957),
            (1.0, 1e6, 3.8415),
        ] {
            let found = f_quantile(0.95, numerator, denominator);
            assert!(
                (found - tabulated).abs() < 1e-3,
                "F({numerator}, {denominator}) = {found}, not {tabulated}"
            );
        }
    }
}
