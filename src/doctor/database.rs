//! The database and the models in it.

use std::path::Path;

use super::{Check, in_units};
use crate::app::{App, ClockDoubt, retention_doubt, store_limits, store_location};
use crate::clock::{Clock, Randomness};
use crate::config::Config;
use crate::domain::Result;
use crate::store::{self, BackupReport, DatabaseReport, Sharing, Store, StoreOptions};
use crate::telemetry::Metrics;

const DATABASE: &str = "database";
const MODELS: &str = "models";

pub(super) async fn check(config: &Config, clock: &Clock) -> (Vec<Check>, Option<DatabaseReport>) {
    if config.database.is_some() {
        return (vec![server(config, clock).await, retention(config, clock).await], None);
    }
    if !store::has_database(&config.data) {
        let check = Check::warning(DATABASE, "there is none yet", "`sightfix serve` makes it; check --data");
        return (vec![check], None);
    }
    let report = match store::inspect(&config.data).await {
        Ok(report) => report,
        Err(error) => {
            let remedy = "docs/howto/run.md, Exit codes, says what to do";
            return (vec![Check::failed(DATABASE, error.to_string(), remedy)], None);
        }
    };
    let of_file = file(&report);
    let mut checks = vec![of_file];
    if report.problems.is_empty() {
        checks.push(models(config, clock, &report).await);
        if report.schema_step == report.newest_step {
            checks.push(retention(config, clock).await);
        }
    }
    (checks, Some(report))
}

/// A backup: complete, sound, and as it was written.
pub(super) async fn backup(file: &Path) -> Check {
    const NAME: &str = "backup";
    match store::inspect_backup(file).await {
        Err(error) => Check::failed(NAME, error.to_string(), "make another: sightfix backup FILE"),
        Ok(BackupReport { report, has_digest: true }) => Check::ok(
            NAME,
            format!("matches its digest, {} cameras, {} samples", report.cameras, report.samples),
        ),
        Ok(_) => Check::warning(
            NAME,
            "sound, without a digest: a changed value in it would not be seen",
            "make another: sightfix backup FILE",
        ),
    }
}

/// The database of a server: reachable, its schema up to date, every active model usable.
async fn server(config: &Config, clock: &Clock) -> Check {
    match faults(config, clock).await {
        Err(error) => {
            let remedy = "check the URL (SIGHTFIX_DATABASE), the network and the database's log";
            Check::failed(DATABASE, error.to_string(), remedy)
        }
        Ok(faults) => match faults.first() {
            None => Check::ok(DATABASE, "reachable, schema up to date; active models answer"),
            Some(fault) => {
                let finding = format!("{} models cannot be used, the first: {fault}", faults.len());
                Check::failed(DATABASE, finding, "activate another version, import the file again, or train")
            }
        },
    }
}

fn file(report: &DatabaseReport) -> Check {
    let DatabaseReport { schema_step, newest_step, bytes, cameras, samples, .. } = report;
    if let Some(problem) = report.problems.first() {
        let finding = format!("{} problems, the first: {problem}", report.problems.len());
        return Check::failed(
            DATABASE,
            finding,
            "stop the server and restore a backup: sightfix restore FILE",
        );
    }
    if schema_step < newest_step {
        return Check::warning(
            DATABASE,
            format!("sound, of an earlier version (schema step {schema_step} of {newest_step})"),
            "make a backup; the next start brings the schema up to date",
        );
    }
    Check::ok(
        DATABASE,
        format!(
            "sound, schema step {schema_step}, {}, {cameras} cameras, {samples} samples",
            in_units(*bytes)
        ),
    )
}

async fn models(config: &Config, clock: &Clock, report: &DatabaseReport) -> Check {
    let remedy = "activate another version, import the file again, or train";
    if let Some(model) = report.damaged_models.first() {
        let finding = format!("{} damaged, the first: {model}", report.damaged_models.len());
        return Check::failed(MODELS, finding, remedy);
    }
    if report.schema_step < report.newest_step {
        return Check::ok(MODELS, format!("{} with sound checksums; not loaded", report.models));
    }
    match faults(config, clock).await {
        Ok(faults) => match faults.first() {
            None => Check::ok(MODELS, format!("{} with sound checksums; active ones answer", report.models)),
            Some(fault) => {
                let finding = format!("{} cannot be used, the first: {fault}", faults.len());
                Check::failed(MODELS, finding, remedy)
            }
        },
        Err(error) => Check::failed(MODELS, format!("cannot be loaded: {error}"), remedy),
    }
}

/// Checks that old samples are deleted as the settings say.
async fn retention(config: &Config, clock: &Clock) -> Check {
    const NAME: &str = "retention";
    let days = config.limits.sample_days;
    let remedy = "synchronise the clock (timedatectl set-ntp true); samples of a camera that has ended are deleted with \
                  `DELETE /v1/cameras/{camera}/samples?until=...`";
    match doubt(config, clock).await {
        Err(error) => Check::warning(NAME, format!("the newest sample cannot be read: {error}"), remedy),
        Ok(Some(doubt)) => Check::warning(NAME, format!("no sample is deleted for its age: {doubt}"), remedy),
        Ok(None) if days == 0 => Check::ok(NAME, "samples are kept without end (limits.sample_days)"),
        Ok(None) => Check::ok(NAME, format!("samples are deleted after {days} days (limits.sample_days)")),
    }
}

async fn doubt(config: &Config, clock: &Clock) -> Result<Option<ClockDoubt>> {
    let store = opened(config).await?;
    let doubt = retention_doubt(&store, clock, config.limits.sample_days).await;
    store.close().await;
    doubt
}

async fn opened(config: &Config) -> Result<Store> {
    let options = StoreOptions {
        limits: store_limits(&config.limits),
        role: "sightfix doctor".to_owned(),
        sharing: Sharing::Command,
    };
    Store::open_at(&store_location(config)?, options).await
}

/// Loads every active model, with its checks, as a server does at its start.
async fn faults(config: &Config, clock: &Clock) -> Result<Vec<String>> {
    let store = opened(config).await?;
    let app =
        App::new(store, clock.clone(), Randomness::system(), config.limits.clone(), Metrics::new()).await?;
    app.registry.refresh(&app.store).await?;
    let faults = app.registry.model_faults();
    app.close().await;
    Ok(faults.into_iter().map(|(camera, fault)| format!("camera {camera}: {}", fault.reason)).collect())
}
