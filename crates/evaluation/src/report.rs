//! The report of an evaluation, as a table and as a JSON document.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::Serialize;
use utoipa::ToSchema;

use super::metrics::ErrorMetrics;

/// One method's figures, the means over seeds.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct MethodReport {
    /// Figures of the errors.
    #[serde(flatten)]
    pub metrics: ErrorMetrics,
    /// The mean error with each seed.
    pub seed_means_m: Vec<f64>,
    /// CPU seconds spent on fitting what the method needs, per seed.
    pub train_cpu_s: f64,
    /// Microseconds per prediction.
    pub fuse_us: f64,
}

impl MethodReport {
    /// Standard deviation of the seeds' means, m; 0 for a single seed.
    #[must_use]
    pub fn seed_spread_m(&self) -> f64 {
        let count = self.seed_means_m.len() as f64;
        let mean_m = self.seed_means_m.iter().sum::<f64>() / count;
        let square_m2 = self.seed_means_m.iter().map(|seed_m| (seed_m - mean_m).powi(2)).sum::<f64>();
        if count > 1.0 { (square_m2 / (count - 1.0)).sqrt() } else { 0.0 }
    }
}

/// Figures of all methods.
#[derive(Debug, Clone, PartialEq, Serialize, Default, ToSchema)]
#[schema(as = EvaluationReport)]
pub struct Report {
    /// Figures by the method's name.
    pub methods: BTreeMap<String, MethodReport>,
    /// Methods that could not run, with the reason.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub failed: BTreeMap<String, String>,
    /// Names of the methods in the order of the request.
    #[serde(skip)]
    pub order: Vec<String>,
}

impl Report {
    /// The document of `--json`.
    ///
    /// # Errors
    /// Never for finite figures.
    pub fn to_json(&self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(self)
    }

    /// The methods in the order of the request.
    pub fn rows(&self) -> impl Iterator<Item = (&str, &MethodReport)> {
        self.order.iter().filter_map(|name| Some((name.as_str(), self.methods.get(name)?)))
    }

    /// The table for a terminal.
    #[must_use]
    pub fn table(&self) -> String {
        let mut text = format!(
            "{:<22} {:>8} {:>8} {:>8} {:>8} {:>9} {:>8} {:>8} {:>6} {:>6} {:>8} {:>7} {:>8} {:>8} {:>6}\n",
            "method",
            "mean_m",
            "spread_m",
            "median_m",
            "p95_m",
            "max_m",
            "rmse_m",
            "in 5 m",
            "cov50",
            "cov95",
            "r95_m",
            "nll",
            "train_s",
            "fuse_us",
            "n"
        );
        for (name, one) in self.rows() {
            let ErrorMetrics { mean_m, median_m, p95_m, max_m, rmse_m, n, .. } = one.metrics;
            let within = one.metrics.share_within.get("5").copied().unwrap_or_default();
            // Writing to a string cannot fail.
            let _ = writeln!(
                text,
                "{name:<22} {mean_m:>8.3} {:>8.3} {median_m:>8.3} {p95_m:>8.3} {max_m:>9.3} {rmse_m:>8.3} \
                 {:>7.1}% {:>6} {:>6} {:>8} {:>7} {:>8.2} {:>8.2} {n:>6}",
                one.seed_spread_m(),
                100.0 * within,
                percent(one.metrics.coverage50),
                percent(one.metrics.coverage95),
                or_dash(one.metrics.mean_r95_m, 3),
                or_dash(one.metrics.negative_log_likelihood, 2),
                one.train_cpu_s,
                one.fuse_us,
            );
        }
        for (name, reason) in &self.failed {
            let _ = writeln!(text, "{name:<22} not run: {reason}");
        }
        text
    }
}

pub(crate) fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "-".to_owned(), |share| format!("{:.1}%", 100.0 * share))
}

pub(crate) fn or_dash(figure: Option<f64>, digits: usize) -> String {
    figure.map_or_else(|| "-".to_owned(), |figure| format!("{figure:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::super::metrics::ScoredPrediction;
    use super::*;

    #[test]
    fn the_document_has_the_promised_keys() {
        let metrics = ErrorMetrics::of(&[ScoredPrediction { error_m: 1.5, r95_m: None }]).expect("one");
        let method = MethodReport { metrics, seed_means_m: vec![1.0, 2.0], train_cpu_s: 0.5, fuse_us: 1.0 };
        assert!((method.seed_spread_m() - 0.5f64.sqrt()).abs() < 1e-12);
        let report = Report {
            methods: BTreeMap::from([("gnss".to_owned(), method)]),
            order: vec!["gnss".to_owned()],
            ..Report::default()
        };
        let document: serde_json::Value =
            serde_json::from_str(&report.to_json().expect("finite")).expect("JSON");
        let gnss = document["methods"]["gnss"].as_object().expect("an object");
        for key in [
            "mean_m",
            "median_m",
            "p95_m",
            "max_m",
            "variance_m2",
            "rmse_m",
            "share_within",
            "seed_means_m",
            "coverage50",
            "coverage95",
            "mean_r95_m",
            "negative_log_likelihood",
            "train_cpu_s",
            "fuse_us",
            "n",
        ] {
            assert!(gnss.contains_key(key), "{key}");
        }
        assert_eq!(gnss["share_within"]["5"], 1.0);
        assert!(document.get("failed").is_none());
        assert!(report.table().contains("gnss "));
    }
}
