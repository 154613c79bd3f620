//! From samples to a model: the candidates are compared on held-out blocks of time, then the best is fitted
//! to all samples; `site` does so for all cameras of a site at once.

mod findings;
mod gnss_noise;
mod held_out;
mod observed_scene;
mod pipeline;
mod report;
mod site;
mod track_noise;
mod walked_line;
mod widening;

pub use self::gnss_noise::{TimedResidual, estimate_gnss_noise};
pub use self::pipeline::{FitInput, FitOptions, FitOverrides, fit, fit_with};
pub use self::site::{SiteCamera, SiteCameraModel, SiteModels, fit_site_models};
