-- Training runs over all cameras of a site: jobs as training runs of a camera are, with the same rules for lease and
-- fence. The report is JSON and stands last, so that reading all else never touches it.
CREATE TABLE site_training_runs (
    id                   TEXT NOT NULL PRIMARY KEY,
    site_key             INTEGER NOT NULL REFERENCES sites (key) ON DELETE CASCADE,
    seed                 INTEGER NOT NULL,
    from_us              INTEGER,
    until_us             INTEGER,
    state                TEXT NOT NULL
                         CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    attempt              INTEGER NOT NULL DEFAULT 0,
    fence                INTEGER NOT NULL DEFAULT 0,
    lease_until_us       INTEGER,
    lease_us             INTEGER,
    cancel_requested     INTEGER NOT NULL DEFAULT 0,
    phase                TEXT NOT NULL DEFAULT '',
    epoch_done           INTEGER NOT NULL DEFAULT 0,
    epochs_planned       INTEGER NOT NULL DEFAULT 0,
    reconstruction_error REAL DEFAULT 0,
    regression_error     REAL DEFAULT 0,
    error_scale          REAL DEFAULT 0,
    remaining_s          REAL,
    outcome              TEXT,
    created_at_us        INTEGER NOT NULL,
    started_at_us        INTEGER,
    ended_at_us          INTEGER,
    report               TEXT,
    CHECK ((state = 'running') = (lease_until_us IS NOT NULL))
) STRICT;

CREATE UNIQUE INDEX one_live_run_per_site ON site_training_runs (site_key) WHERE state IN ('queued', 'running');
CREATE INDEX live_site_training_runs ON site_training_runs (id) WHERE state IN ('queued', 'running');
CREATE INDEX site_training_runs_of_site ON site_training_runs (site_key, id);
