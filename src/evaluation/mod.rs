//! Methods side by side: metrics, truth, report.
