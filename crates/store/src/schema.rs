//! The steps of `migrations/`, built into the program.

use std::sync::LazyLock;

use sqlx::SqlSafeStr as _;
use sqlx::migrate::{Migration, MigrationType, Migrator};

/// A step for both backends.
struct Step {
    version: i64,
    name: &'static str,
    sqlite: &'static str,
    postgres: &'static str,
}

const STEPS: [Step; 1] = [Step {
    version: 1,
    name: "schema",
    sqlite: include_str!("../../../migrations/sqlite/0001_schema.sql"),
    postgres: include_str!("../../../migrations/postgres/0001_schema.sql"),
}];

/// The schema of a data folder.
pub(crate) static SQLITE: LazyLock<Migrator> = LazyLock::new(|| migrator(|step| step.sqlite));

/// The schema of a PostgreSQL database. The lock of the library lasts for a session, which a pooler does not keep.
pub(crate) static POSTGRES: LazyLock<Migrator> = LazyLock::new(|| {
    let mut migrator = migrator(|step| step.postgres);
    migrator.set_locking(false);
    migrator
});

fn migrator(sql: fn(&Step) -> &'static str) -> Migrator {
    let migration = |step: &Step| {
        Migration::new(step.version, step.name.into(), MigrationType::Simple, sql(step).into_sql_str(), false)
    };
    Migrator::with_migrations(STEPS.iter().map(migration).collect())
}
