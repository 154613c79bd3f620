//! A copy of everything from one store into another, empty one, and the proof that both hold the same.
//!
//! Tables are copied with the columns that they have, so a new column needs nothing here; a new table needs a line in
//! [`TABLES`]. The source is read in one transaction, and the target is written in one, so that a copy is complete or
//! leaves nothing.

use futures_util::future::BoxFuture;
use sha2::{Digest as _, Sha256};
use tokio::sync::mpsc;

use super::{Store, on_backend};
use crate::domain::{Error, Result};

/// A table, with the columns of its primary key.
pub(super) struct Table {
    pub(super) name: &'static str,
    pub(super) key: &'static str,
}

const PICTURES: &str = "camera_pictures";

/// All tables, each after those that it refers to. A camera and its active model refer to each other, which both
/// backends check at the end of the transaction.
pub(super) const TABLES: &[Table] = &[
    Table { name: "sites", key: "key" },
    Table { name: "cameras", key: "key" },
    Table { name: PICTURES, key: "camera_key" },
    Table { name: "models", key: "camera_key, number" },
    Table { name: "activations", key: "camera_key, position" },
    Table { name: "held_out_errors", key: "camera_key, model_number, time_us, target_id" },
    Table { name: "camera_moves", key: "camera_key, model_number" },
    Table { name: "recording_parts", key: "number" },
    Table { name: "samples", key: "camera_key, time_us, target_id" },
    Table { name: "samples_without_fix", key: "camera_key, time_us, target_id" },
    Table { name: "sample_counts", key: "camera_key" },
    Table { name: "training_runs", key: "id" },
    Table { name: "training_epochs", key: "run_id, epoch" },
    Table { name: "training_log", key: "run_id, line_number" },
    Table { name: "site_training_runs", key: "id" },
    Table { name: "evaluations", key: "id" },
    Table { name: "api_keys", key: "id" },
    Table { name: "audit_log", key: "number" },
    Table { name: "idempotency_keys", key: "number" },
    Table { name: "connections", key: "key" },
    Table { name: "outbox", key: "number" },
    Table { name: "places", key: "key" },
    Table { name: "place_events", key: "number" },
    Table { name: "place_counts", key: "place_key, step_s, from_s, class, figure" },
    Table { name: "source_offsets", key: "connection_key, topic, partition_number" },
];

/// Tables whose keys are numbered and never used twice, with the column.
const NUMBERED: &[(&str, &str)] = &[
    ("sites", "key"),
    ("cameras", "key"),
    ("audit_log", "number"),
    ("idempotency_keys", "number"),
    ("connections", "key"),
    ("recording_parts", "number"),
    ("outbox", "number"),
    ("places", "key"),
    ("place_events", "number"),
];

impl Table {
    /// Rows that are read or written at a time: a picture may have megabytes.
    pub(super) fn rows_at_a_time(&self) -> usize {
        if self.name == PICTURES { 8 } else { 500 }
    }
}

/// A table that was copied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CopiedTable {
    /// The name of the table.
    pub name: &'static str,
    /// Its rows, in either store.
    pub rows: u64,
    /// SHA-256 (hexadecimal) over its rows in the order of the primary key, the same in either store.
    pub sha256: String,
}

/// The type of a column's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Integer,
    Real,
    Text,
    Bytes,
}

/// A column of a table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Column {
    pub(super) name: String,
    pub(super) kind: Kind,
    /// An integer that this backend declares as a truth value.
    pub(super) is_flag: bool,
}

/// The columns as statements list them.
pub(super) fn names_of(columns: &[Column]) -> String {
    columns.iter().map(|column| &*column.name).collect::<Vec<_>>().join(", ")
}

/// A value of a row.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value {
    Null,
    Integer(i64),
    Real(f64),
    Text(String),
    Bytes(Vec<u8>),
}

pub(super) type Rows = Vec<Vec<Value>>;

/// A transaction over all tables of a store.
pub(super) trait CopyTransaction: Send {
    /// Names of all tables that belong to the program, but for the list of migrations.
    fn tables(&mut self) -> BoxFuture<'_, Result<Vec<String>>>;
    /// Columns of a table, by name.
    fn columns<'a>(&'a mut self, table: &'a Table) -> BoxFuture<'a, Result<Vec<Column>>>;
    /// Sends all rows of a table in the order of its key.
    fn read<'a>(
        &'a mut self,
        table: &'a Table,
        columns: &'a [Column],
        rows: mpsc::Sender<Rows>,
    ) -> BoxFuture<'a, Result<()>>;
    fn write<'a>(
        &'a mut self,
        table: &'a Table,
        columns: &'a [Column],
        rows: Rows,
    ) -> BoxFuture<'a, Result<()>>;
    /// The greatest number that a numbered table has ever had.
    fn last_number<'a>(&'a mut self, table: &'a str, column: &'a str) -> BoxFuture<'a, Result<i64>>;
    fn set_last_number<'a>(
        &'a mut self,
        table: &'a str,
        column: &'a str,
        number: i64,
    ) -> BoxFuture<'a, Result<()>>;
    fn commit(self: Box<Self>) -> BoxFuture<'static, Result<()>>;
}

impl Store {
    /// Copies everything into another store, which must be empty, and reads it back to compare. Nobody else may be
    /// changing either of them.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`](crate::domain::ErrorKind) for a target that is not empty; a fault if the copy is
    /// not the same, and then the target is left empty.
    pub async fn copy_to(&self, target: &Self) -> Result<Vec<CopiedTable>> {
        let mut source = self.begin_copy().await?;
        let mut written = target.begin_copy().await?;
        check_tables(&mut *source).await?;
        let mut copied = Vec::new();
        for table in TABLES {
            copied.push(copy_table(table, &mut *source, &mut *written).await?);
        }
        for (table, column) in NUMBERED {
            let last = source.last_number(table, column).await?;
            written.set_last_number(table, column, last).await?;
        }
        written.commit().await?;
        Ok(copied)
    }

    async fn begin_copy(&self) -> Result<Box<dyn CopyTransaction>> {
        on_backend!(self, store => store.begin_copy().await)
    }
}

/// A table that is not in the list would be lost.
async fn check_tables(source: &mut dyn CopyTransaction) -> Result<()> {
    let tables = source.tables().await?;
    match tables.iter().find(|name| TABLES.iter().all(|table| table.name != **name)) {
        Some(unknown) => {
            Err(Error::fault(format!("the table {unknown} is not in the list of tables to copy")))
        }
        None => Ok(()),
    }
}

async fn copy_table(
    table: &'static Table,
    source: &mut dyn CopyTransaction,
    target: &mut dyn CopyTransaction,
) -> Result<CopiedTable> {
    let Table { name, .. } = *table;
    let (columns, target_columns) = (source.columns(table).await?, target.columns(table).await?);
    let shape = |columns: &[Column]| columns.iter().map(|it| (it.name.clone(), it.kind)).collect::<Vec<_>>();
    if shape(&columns) != shape(&target_columns) {
        return Err(Error::fault(format!("the table {name} has other columns in the two stores")));
    }
    if fingerprint(table, target, &target_columns).await?.rows > 0 {
        return Err(Error::invalid("to", format!("must be an empty store; its table {name} has rows")));
    }
    let (sender, mut batches) = mpsc::channel(2);
    let mut read = Fingerprint::default();
    let reading = source.read(table, &columns, sender);
    let writing = async {
        while let Some(rows) = batches.recv().await {
            read.add(&rows);
            target.write(table, &target_columns, rows).await?;
        }
        Ok::<_, Error>(())
    };
    tokio::try_join!(reading, writing)?;
    let (read, stored) = (read.finish(name), fingerprint(table, target, &target_columns).await?);
    if read != stored {
        return Err(Error::fault(format!(
            "the copy of {name} differs: {} rows ({}) became {} ({})",
            read.rows, read.sha256, stored.rows, stored.sha256
        )));
    }
    Ok(stored)
}

async fn fingerprint(
    table: &'static Table,
    store: &mut dyn CopyTransaction,
    columns: &[Column],
) -> Result<CopiedTable> {
    let (sender, mut batches) = mpsc::channel(2);
    let mut fingerprint = Fingerprint::default();
    let adding = async {
        while let Some(rows) = batches.recv().await {
            fingerprint.add(&rows);
        }
        Ok::<_, Error>(())
    };
    tokio::try_join!(store.read(table, columns, sender), adding)?;
    Ok(fingerprint.finish(table.name))
}

#[derive(Default)]
struct Fingerprint {
    rows: u64,
    hash: Sha256,
}

impl Fingerprint {
    fn add(&mut self, rows: &Rows) {
        self.rows += rows.len() as u64;
        for value in rows.iter().flatten() {
            match value {
                Value::Null => self.hash.update([0]),
                Value::Integer(number) => self.tagged(1, &number.to_be_bytes()),
                // SQLite stores -0 as 0.
                Value::Real(number) => self.tagged(2, &(number + 0.0).to_bits().to_be_bytes()),
                Value::Text(text) => self.sized(3, text.as_bytes()),
                Value::Bytes(bytes) => self.sized(4, bytes),
            }
        }
    }

    fn tagged(&mut self, tag: u8, bytes: &[u8]) {
        self.hash.update([tag]);
        self.hash.update(bytes);
    }

    fn sized(&mut self, tag: u8, bytes: &[u8]) {
        self.tagged(tag, &(bytes.len() as u64).to_be_bytes());
        self.hash.update(bytes);
    }

    fn finish(self, name: &'static str) -> CopiedTable {
        let sha256 = self.hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        CopiedTable { name, rows: self.rows, sha256 }
    }
}
