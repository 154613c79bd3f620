//! Registration of metrics with their descriptions and buckets.

use metrics::{Counter, Gauge, Histogram, Key, KeyName, Label, Level, Metadata, Recorder, SharedString};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle, PrometheusRecorder};

const METADATA: Metadata<'static> = Metadata::new("sightfix", Level::INFO, None);

/// Seconds of a request: a fusion takes a tenth of a millisecond, an import seconds.
const REQUEST_BUCKETS_S: [f64; 14] =
    [0.000_1, 0.000_25, 0.000_5, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.5, 1.0, 5.0, 30.0];
/// Seconds of a background job.
const JOB_BUCKETS_S: [f64; 9] = [0.5, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1_000.0, 3_600.0];
/// Quantiles of chi-square with 2 degrees of freedom: 10, 25, 50, 75, 90, 95, 99 and 99.9 %.
const NIS_BUCKETS: [f64; 8] = [0.21, 0.58, 1.39, 2.77, 4.61, 5.99, 9.21, 13.8];

/// Name of a label and its value.
pub(super) type LabelPair = (&'static str, &'static str);

/// The metrics of one server.
pub(super) struct Registry {
    recorder: PrometheusRecorder,
}

impl Registry {
    pub(super) fn new() -> Self {
        let suffix = |text: &str| Matcher::Suffix(text.to_owned());
        let recorder = PrometheusBuilder::new()
            .set_buckets_for_metric(suffix("request_duration_seconds"), &REQUEST_BUCKETS_S)
            .and_then(|builder| {
                builder.set_buckets_for_metric(suffix("run_duration_seconds"), &JOB_BUCKETS_S)
            })
            .and_then(|builder| {
                builder.set_buckets_for_metric(suffix("evaluation_duration_seconds"), &JOB_BUCKETS_S)
            })
            .and_then(|builder| builder.set_buckets_for_metric(suffix("_nis"), &NIS_BUCKETS))
            .unwrap_or_else(|_| PrometheusBuilder::new())
            .build_recorder();
        Self { recorder }
    }

    pub(super) fn handle(&self) -> PrometheusHandle {
        self.recorder.handle()
    }

    pub(super) fn counter(&self, name: &'static str, help: &'static str, labels: &[LabelPair]) -> Counter {
        self.recorder.describe_counter(KeyName::from(name), None, SharedString::from(help));
        self.recorder.register_counter(&key(name, labels), &METADATA)
    }

    pub(super) fn gauge(&self, name: &'static str, help: &'static str, labels: &[LabelPair]) -> Gauge {
        self.recorder.describe_gauge(KeyName::from(name), None, SharedString::from(help));
        self.recorder.register_gauge(&key(name, labels), &METADATA)
    }

    pub(super) fn histogram(
        &self,
        name: &'static str,
        help: &'static str,
        labels: &[LabelPair],
    ) -> Histogram {
        self.recorder.describe_histogram(KeyName::from(name), None, SharedString::from(help));
        self.recorder.register_histogram(&key(name, labels), &METADATA)
    }
}

fn key(name: &'static str, labels: &[LabelPair]) -> Key {
    let labels = labels.iter().map(|(label, value)| Label::new(*label, *value));
    Key::from_parts(name, labels.collect::<Vec<_>>())
}
