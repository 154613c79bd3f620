//! Curve and log of training runs.

use jiff::Timestamp;

use super::jobs::Jobs;
use crate::database::Database;
use crate::domain::{EpochReport, Result, RunId};
use crate::jobs::RUNS;
use crate::query::{Session, query, query_scalar};
use crate::refusals::no_run;
use crate::row_decoder::RowDecoder;
use crate::rows::runs::{LINE_BYTES, LOG_LINES};

impl Database {
    pub(crate) async fn append_epochs(&self, run: RunId, fence: i64, epochs: &[EpochReport]) -> Result<()> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        if Jobs(&RUNS).owns_lease(&mut transaction, (run.0, fence)).await?.is_none() {
            return Ok(());
        }
        for report in epochs {
            query(
                "INSERT INTO training_epochs \
                 (run_id, epoch, loss, reconstruction_error, regression_error, error_scale) \
                 VALUES ($1, $2, $3, $4, $5, $6) ON CONFLICT (run_id, epoch) DO UPDATE SET loss = excluded.loss, \
                 reconstruction_error = excluded.reconstruction_error, \
                 regression_error = excluded.regression_error, error_scale = excluded.error_scale",
            )
            .bind(run.to_string())
            .bind(report.epoch)
            .bind(report.loss)
            .bind(report.reconstruction_error)
            .bind(report.regression_error)
            .bind(report.error_scale)
            .execute(&mut transaction).await?;
        }
        transaction.commit().await
    }

    pub(crate) async fn append_log(&self, run: RunId, fence: i64, now: Timestamp, line: &str) -> Result<()> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        if Jobs(&RUNS).owns_lease(&mut transaction, (run.0, fence)).await?.is_none() {
            return Ok(());
        }
        let number: i64 = query_scalar(
            "INSERT INTO training_log (run_id, line_number, at_us, line) \
             SELECT $1, coalesce(max(line_number), 0) + 1, $2, $3 FROM training_log WHERE run_id = $4 \
             RETURNING line_number",
        )
        .bind(run.to_string())
        .bind(now.as_microsecond())
        .bind(line[..line.floor_char_boundary(LINE_BYTES)].replace('\0', "\u{fffd}"))
        .bind(run.to_string())
        .fetch_one(&mut transaction)
        .await?;
        query("DELETE FROM training_log WHERE run_id = $1 AND line_number <= $2")
            .bind(run.to_string())
            .bind(number - LOG_LINES)
            .execute(&mut transaction)
            .await?;
        transaction.commit().await
    }

    pub(crate) async fn epochs(&self, run: RunId) -> Result<Vec<EpochReport>> {
        let mut reader = self.reader().await?;
        check_run(&mut reader, run).await?;
        let rows = query(
            "SELECT run_id, epoch, loss, reconstruction_error, regression_error, error_scale \
             FROM training_epochs WHERE run_id = $1 ORDER BY epoch",
        )
        .bind(run.to_string())
        .fetch_all(&mut reader)
        .await?;
        let read = |row| {
            let mut fields = RowDecoder::new("training_epochs", row).skip(1);
            Ok(EpochReport {
                epoch: fields.count()?,
                loss: fields.nullable_f64()?,
                reconstruction_error: fields.nullable_f64()?,
                regression_error: fields.nullable_f64()?,
                error_scale: fields.nullable_f64()?,
            })
        };
        rows.iter().map(read).collect()
    }

    pub(crate) async fn log(&self, run: RunId) -> Result<Vec<(Timestamp, String)>> {
        let mut reader = self.reader().await?;
        check_run(&mut reader, run).await?;
        let rows = query(
            "SELECT run_id, line_number, at_us, line FROM training_log WHERE run_id = $1 ORDER BY line_number",
        )
        .bind(run.to_string())
        .fetch_all(&mut reader).await?;
        let read = |row| {
            let mut fields = RowDecoder::new("training_log", row).skip(2);
            Ok((fields.timestamp()?, fields.get()?))
        };
        rows.iter().map(read).collect()
    }
}

async fn check_run(session: &mut dyn Session, run: RunId) -> Result<()> {
    let known: Option<i64> = query_scalar("SELECT CAST(1 AS BIGINT) FROM training_runs WHERE id = $1")
        .bind(run.to_string())
        .fetch_optional(session)
        .await?;
    known.map(|_| ()).ok_or_else(|| no_run(run))
}
