//! Training runs: jobs whose output are model versions, of a camera or of all cameras of a site.

use std::time::Duration;

use futures_util::FutureExt as _;
use jiff::Timestamp;

use super::jobs::Jobs;
use crate::database::Database;
use crate::domain::{
    AuditAction, Error, ErrorKind, Result, RunId, RunProgress, TrainingRun, TrainingSubject,
};
use crate::jobs::{Claim, Heartbeat, JobEnd};
use crate::query::{Query, Session, query};
use crate::refusals::no_run;
use crate::row_decoder::StoredRow;
use crate::rows::audit::Change;
use crate::rows::idempotency::IdempotencyRecord;
use crate::rows::runs::{ReadRun, read_run, select_runs};
use crate::statements::idempotency::{find_answer, insert_answer, lock_key};

/// A subject whose training runs are stored: [`CameraId`](crate::domain::CameraId) or
/// [`SiteId`](crate::domain::SiteId).
pub trait RunSubject: TrainingSubject + ReadRun {
    /// The output of a run that has succeeded.
    type Output<'a>: Clone + Send + Sync;

    /// The actions in the audit log for a start and for a cancellation.
    #[doc(hidden)]
    const ACTIONS: [AuditAction; 2];

    /// The number by which other tables call the subject.
    #[doc(hidden)]
    fn key(&self, session: &mut dyn Session) -> impl Future<Output = Result<i64>> + Send;

    /// As [`RunSubject::key`]; no other transaction queues a run of the subject until this one ends.
    #[doc(hidden)]
    fn lock(&self, session: &mut dyn Session) -> impl Future<Output = Result<i64>> + Send;

    /// The statement that queues a run.
    #[doc(hidden)]
    fn insert(run: RunId, key: i64, options: &Self::Options, priority: i64) -> Query<StoredRow>;

    #[doc(hidden)]
    fn change(&self, action: AuditAction, run: RunId) -> Change<'_>;

    /// Locks the cameras that the end of a run changes, and makes a failure of a success that cannot be stored.
    #[doc(hidden)]
    fn prepare_end<'a>(
        session: &mut dyn Session,
        claimed: (RunId, i64),
        end: JobEnd<Self::Output<'a>>,
    ) -> impl Future<Output = Result<JobEnd<Self::Output<'a>>>> + Send;

    /// Stores the output of a run of the subject with a key.
    #[doc(hidden)]
    fn store_output(
        database: &Database,
        session: &mut dyn Session,
        run: (RunId, i64),
        output: Self::Output<'_>,
        now: Timestamp,
    ) -> impl Future<Output = Result<()>> + Send;
}

impl Database {
    pub(crate) async fn insert_run<S: RunSubject>(
        &self,
        run: RunId,
        subject: &S,
        options: &S::Options,
        max_live: u32,
        record: Option<&IdempotencyRecord>,
        now: Timestamp,
    ) -> Result<TrainingRun<S>> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let key = subject.lock(&mut transaction).await?;
        if let Some(record) = record {
            let caller = (&*self.actor, &record.key);
            lock_key(&mut transaction, caller).await?;
            if let Some(answer) = find_answer(&mut transaction, self.limits(), caller, now).await? {
                return run_of(&mut transaction, subject, answer.to_request(&record.digest)?.parse()?).await;
            }
            insert_answer(&mut transaction, self.limits(), (&self.actor, record), &run.to_string(), now)
                .await?;
        }
        let jobs = Jobs(S::JOBS);
        jobs.prune_ended(&mut transaction, key, self.limits().ended_runs_per_camera).await?;
        check_no_live_run::<S>(jobs.live_of(&mut transaction, key).await?)?;
        jobs.check_capacity(&mut transaction, max_live).await?;
        let insert = S::insert(run, key, options, i64::from(self.actor.is_client()));
        insert.bind(now.as_microsecond()).execute(&mut transaction).await?;
        let [started, _] = S::ACTIONS;
        self.record(&mut transaction, subject.change(started, run), now).await?;
        let stored = run_of(&mut transaction, subject, run).await?;
        transaction.commit().await?;
        Ok(stored)
    }

    pub(crate) async fn run<S: RunSubject>(&self, subject: &S, run: RunId) -> Result<TrainingRun<S>> {
        let mut reader = self.reader().await?;
        subject.key(&mut reader).await?;
        run_of(&mut reader, subject, run).await
    }

    pub(crate) async fn runs<S: RunSubject>(
        &self,
        subject: &S,
        before: Option<RunId>,
        limit: u32,
    ) -> Result<Vec<TrainingRun<S>>> {
        let mut reader = self.reader().await?;
        let key = subject.key(&mut reader).await?;
        // "~" sorts after all UUIDs.
        let before = before.map_or_else(|| "~".to_owned(), |run| run.to_string());
        let page =
            format!("WHERE runs.{} = $1 AND runs.id < $2 ORDER BY runs.id DESC LIMIT $3", S::JOBS.owner);
        let select = query(select_runs::<S>(reader.dialect(), &page)).bind(key).bind(before).bind(limit);
        select.fetch_all(&mut reader).await?.iter().map(read_run).collect()
    }

    pub(crate) async fn claim_run<S: RunSubject>(
        &self,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<Claim<TrainingRun<S>>>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let Some(claim) = Jobs(S::JOBS).claim(&mut transaction, lease, now).await? else { return Ok(None) };
        let id = RunId(claim.job);
        query("DELETE FROM training_epochs WHERE run_id = $1")
            .bind(id.to_string())
            .execute(&mut transaction)
            .await?;
        let job = find_run(&mut transaction, id).await?.ok_or_else(|| no_run(id))?;
        transaction.commit().await?;
        Ok(Some(Claim { job, fence: claim.fence, cancel_requested: claim.cancel_requested }))
    }

    pub(crate) async fn heartbeat_run<S: RunSubject>(
        &self,
        run: RunId,
        fence: i64,
        progress: &RunProgress,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        let heartbeat = Jobs(S::JOBS).heartbeat(&mut transaction, (run.0, fence), lease, now).await?;
        if heartbeat == Heartbeat::Lost {
            return Ok(heartbeat);
        }
        Jobs(S::JOBS).record_progress(&mut transaction, run.0, progress).await?;
        transaction.commit().await?;
        Ok(heartbeat)
    }

    pub(crate) async fn cancel_run<S: RunSubject>(
        &self,
        subject: &S,
        run: RunId,
        now: Timestamp,
    ) -> Result<TrainingRun<S>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        subject.lock(&mut transaction).await?;
        Jobs(S::JOBS).lock(&mut transaction, run.0).await?;
        check_not_ended(&run_of(&mut transaction, subject, run).await?)?;
        Jobs(S::JOBS).cancel(&mut transaction, run.0, now).await?;
        let [_, cancelled] = S::ACTIONS;
        self.record(&mut transaction, subject.change(cancelled, run), now).await?;
        let stored = run_of(&mut transaction, subject, run).await?;
        transaction.commit().await?;
        Ok(stored)
    }

    pub(crate) async fn finish_run<S: RunSubject>(
        &self,
        run: RunId,
        fence: i64,
        end: JobEnd<S::Output<'_>>,
        now: Timestamp,
    ) -> Result<Option<TrainingRun<S>>> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        // Boxed, since the compiler cannot show that a future over the lifetime of an output is `Send`.
        let end = S::prepare_end(&mut transaction, (run, fence), end).boxed().await?;
        let finished = Jobs(S::JOBS).finish(&mut transaction, (run.0, fence), end, now).await?;
        let Some(finished) = finished else { return Ok(None) };
        if let Some(output) = finished.output {
            S::store_output(self, &mut transaction, (run, finished.owner_key), output, now).boxed().await?;
        }
        let stored = find_run(&mut transaction, run).await?;
        transaction.commit().await?;
        Ok(stored)
    }
}

pub(super) async fn find_run<S: RunSubject>(
    session: &mut dyn Session,
    run: RunId,
) -> Result<Option<TrainingRun<S>>> {
    let select = select_runs::<S>(session.dialect(), "WHERE runs.id = $1");
    let row = query(select).bind(run.to_string()).fetch_optional(session).await?;
    row.as_ref().map(read_run).transpose()
}

/// The run, if it is one of that subject.
async fn run_of<S: RunSubject>(session: &mut dyn Session, subject: &S, run: RunId) -> Result<TrainingRun<S>> {
    let found = find_run::<S>(session, run).await?;
    found.filter(|found| found.subject == *subject).ok_or_else(|| no_run(run))
}

/// A subject has one live run at most.
fn check_no_live_run<S: RunSubject>(live: Option<String>) -> Result<()> {
    let Some(live) = live else { return Ok(()) };
    let message =
        format!("the {} has training run {live}, which has not ended; wait for it or cancel it", S::KIND);
    Err(Error::conflict(ErrorKind::RunLive, live, message))
}

/// Refuses to cancel a run that has ended.
fn check_not_ended<S: RunSubject>(run: &TrainingRun<S>) -> Result<()> {
    if !run.state.has_ended() {
        return Ok(());
    }
    let ended = format!("the training run has ended already: {}", run.state.as_str());
    Err(Error::refused(ErrorKind::RunEnded, ended))
}
