//! Invariants of a database after its server was killed.

use std::collections::HashMap;
use std::path::Path;

use rusqlite::{Connection, OptionalExtension as _};

use super::load::{Load, ROWS, Streamer, Trainer, Work, Writer, active_model};

/// The violations that a check has found.
#[derive(Debug, Default)]
pub(super) struct Findings {
    /// Acknowledged, and not there.
    pub(super) lost: Vec<String>,
    /// There in part, or against the rules of the schema.
    pub(super) inconsistent: Vec<String>,
}

impl Findings {
    pub(super) fn add(&mut self, other: Self) {
        self.lost.extend(other.lost);
        self.inconsistent.extend(other.inconsistent);
    }

    fn expect(&mut self, holds: bool, what: impl FnOnce() -> String) {
        if !holds {
            self.inconsistent.push(what());
        }
    }
}

/// Rules that every database of this schema obeys, each as a query that must count nothing.
const RULES: [(&str, &str); 5] = [
    ("rows without their parents", "SELECT count(*) FROM pragma_foreign_key_check"),
    (
        "counts of samples that differ from the samples",
        "SELECT count(*) FROM cameras LEFT JOIN sample_counts ON camera_key = key WHERE \
         coalesce(samples, 0) != (SELECT count(*) FROM samples WHERE camera_key = key) \
         OR coalesce(without_fix, 0) != (SELECT count(*) FROM samples_without_fix WHERE camera_key = key)",
    ),
    (
        "succeeded runs without a model version",
        "SELECT count(*) FROM training_runs JOIN cameras ON key = camera_key \
         WHERE state = 'succeeded' AND (model_version IS NULL OR model_version > last_model_number)",
    ),
    (
        "model versions of runs that did not succeed",
        "SELECT count(*) FROM models m JOIN training_runs r ON r.id = m.run_id WHERE r.state != 'succeeded'",
    ),
    (
        "cameras whose active version was never activated",
        "SELECT count(*) FROM cameras c WHERE active_model IS NOT NULL AND NOT EXISTS \
         (SELECT 1 FROM activations a WHERE a.camera_key = c.key AND a.model_number = c.active_model)",
    ),
];

/// Compares a database with what was acknowledged; steps whose outcome was unknown are known afterwards.
pub(super) fn check(folder: &Path, load: &mut Load) -> Findings {
    let database = open(folder);
    let mut findings = check_rules(&database);
    for writer in &mut load.writers {
        check_writer(&database, writer, &mut findings);
    }
    check_trainer(&database, &load.trainer, &mut findings);
    check_streamer(&database, &load.streamer, &mut findings);
    findings
}

fn open(folder: &Path) -> Connection {
    let database = Connection::open(folder.join("sightfix.db")).expect("the database opens");
    database.busy_timeout(std::time::Duration::from_secs(10)).expect("a timeout");
    database
}

/// The integrity check of SQLite and the rules of the schema.
pub(super) fn check_database(folder: &Path) -> Findings {
    check_rules(&open(folder))
}

fn check_rules(database: &Connection) -> Findings {
    let mut findings = Findings::default();
    let integrity: String =
        database.query_row("PRAGMA integrity_check", [], |row| row.get(0)).expect("it can be checked");
    findings.expect(integrity == "ok", || integrity.clone());
    for (what, sql) in RULES {
        let count = count(database, sql, "");
        findings.expect(count == 0, || format!("{count} {what}"));
    }
    findings
}

/// A number that a query gives; `?1` is the name.
fn count(database: &Connection, sql: &str, name: &str) -> u64 {
    let mut statement = database.prepare(sql).expect("SQL");
    let parameters = &[&name as &dyn rusqlite::ToSql][..statement.parameter_count()];
    let count: i64 = statement.query_row(parameters, |row| row.get(0)).expect("one row");
    count.try_into().expect("a count")
}

/// Samples of a camera by their target.
fn samples(database: &Connection, camera: &str) -> HashMap<String, i64> {
    let sql = "SELECT target_id, count(*) FROM samples JOIN cameras ON key = camera_key WHERE id = ?1 \
               GROUP BY target_id";
    let mut statement = database.prepare(sql).expect("SQL");
    let rows = statement.query_map([camera], |row| Ok((row.get(0)?, row.get(1)?))).expect("rows");
    rows.collect::<Result<_, _>>().expect("rows")
}

fn entries(database: &Connection, action: &str, name: &str) -> u64 {
    let sql = format!(
        "SELECT count(*) FROM audit_log WHERE action = '{action}' \
         AND (camera_id = ?1 OR camera_id IS NULL AND subject LIKE '%' || ?1 || '%')"
    );
    count(database, &sql, name)
}

fn check_writer(database: &Connection, writer: &mut Writer, findings: &mut Findings) {
    if writer.work == Work::Import {
        return check_importer(database, writer, findings);
    }
    let name = &writer.name;
    // The state expected after a step, and the state that is found.
    let (state_after, found): (fn(u64) -> u64, u64) = match writer.work {
        Work::Erase => {
            let stored: i64 = samples(database, name).values().sum();
            findings.expect(stored % ROWS == 0, || format!("{name}: {stored} samples"));
            (|step| step % 2 * ROWS as u64, stored as u64)
        }
        Work::Recreate => {
            (|step| step % 2, count(database, "SELECT count(*) FROM cameras WHERE id = ?1", name))
        }
        Work::Activate => (
            active_model,
            count(database, "SELECT coalesce(active_model, 0) FROM cameras WHERE id = ?1", name),
        ),
        Work::Key => {
            let working = "SELECT count(*) FROM api_keys WHERE name = ?1 AND revoked_at_us IS NULL";
            (|step| step % 2, count(database, working, name))
        }
        Work::Import => unreachable!("checked above"),
    };
    let (acknowledged, attempted) = (writer.acknowledged, writer.attempted);
    let steps = [acknowledged, attempted];
    match steps.into_iter().find(|&step| state_after(step) == found) {
        Some(step) => (writer.acknowledged, writer.attempted) = (step, step),
        None => findings.lost.push(format!("{name}: step {acknowledged} or {attempted}, found {found}")),
    }
    if writer.work == Work::Key {
        writer.key = find_key(database, &writer.name, writer.key.take());
    }
    check_audit(database, writer, findings);
}

/// The key that works, which may have been created without an acknowledgement; then nobody knows its secret.
fn find_key(database: &Connection, name: &str, known: Option<(String, String)>) -> Option<(String, String)> {
    let sql = "SELECT id FROM api_keys WHERE name = ?1 AND revoked_at_us IS NULL";
    let id: String = database.query_row(sql, [name], |row| row.get(0)).optional().expect("a query")?;
    Some(known.filter(|(known, _)| *known == id).unwrap_or((id, String::new())))
}

/// One entry of the audit log for each change, in its transaction.
fn check_audit(database: &Connection, writer: &Writer, findings: &mut Findings) {
    let steps = writer.acknowledged;
    let expected: &[(&str, u64)] = match writer.work {
        Work::Erase => &[("samples-deleted", steps / 2)],
        Work::Recreate => &[("camera-created", steps.div_ceil(2)), ("camera-deleted", steps / 2)],
        // The first version was activated before the first step.
        Work::Activate => &[("model-activated", steps + 1)],
        Work::Key => &[("key-created", steps.div_ceil(2)), ("key-revoked", steps / 2)],
        Work::Import => &[],
    };
    for (action, expected) in expected {
        let found = entries(database, action, &writer.name);
        findings.expect(found == *expected, || {
            format!("{}: {found} entries {action} for {expected} changes", writer.name)
        });
    }
}

fn check_importer(database: &Connection, writer: &mut Writer, findings: &mut Findings) {
    let stored = samples(database, &writer.name);
    for (batch, rows) in &stored {
        findings.expect(*rows == ROWS, || format!("{}: {batch} has {rows} rows", writer.name));
    }
    let is_stored = |batch: u64| stored.contains_key(&format!("batch-{batch}"));
    if writer.is_deleting {
        writer.is_deleting = false;
        if stored.is_empty() {
            writer.first_batch = writer.acknowledged + 1;
        }
    }
    let lost = (writer.first_batch..=writer.acknowledged).filter(|batch| !is_stored(*batch));
    findings.lost.extend(lost.map(|batch| format!("{}: batch {batch}", writer.name)));
    if is_stored(writer.attempted) {
        writer.acknowledged = writer.attempted;
    }
    writer.attempted = writer.acknowledged;
    let expected = writer.acknowledged + 1 - writer.first_batch;
    findings.expect(stored.len() as u64 <= expected, || {
        format!("{}: {} batches are stored, {expected} were sent", writer.name, stored.len())
    });
}

fn check_trainer(database: &Connection, trainer: &Trainer, findings: &mut Findings) {
    let sql = "SELECT state FROM training_runs WHERE id = ?1";
    for (run, ended) in &trainer.runs {
        let state: Option<String> =
            database.query_row(sql, [run], |row| row.get(0)).optional().expect("a query");
        match (state, ended) {
            (None, _) => findings.lost.push(format!("run {run}")),
            (Some(state), Some(ended)) if state != *ended => {
                findings.lost.push(format!("run {run} was {ended} and is {state}"));
            }
            _ => {}
        }
    }
}

fn check_streamer(database: &Connection, streamer: &Streamer, findings: &mut Findings) {
    let (target, acknowledged) = &streamer.acknowledged;
    let stored = samples(database, "streamed").get(target).copied().unwrap_or_default() as u64;
    if stored < *acknowledged {
        findings.lost.push(format!("{target}: {stored} samples of {acknowledged}"));
    }
}
