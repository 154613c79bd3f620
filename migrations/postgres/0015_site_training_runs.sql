-- Training runs over all cameras of a site: jobs as training runs of a camera are, with the same rules for lease and
-- fence. The report is JSON and stands last, so that reading all else never touches it.
CREATE TABLE site_training_runs (
    id                   TEXT COLLATE "C" NOT NULL PRIMARY KEY,
    site_key             BIGINT NOT NULL REFERENCES sites (key) ON DELETE CASCADE,
    seed                 BIGINT NOT NULL,
    from_us              BIGINT,
    until_us             BIGINT,
    state                TEXT NOT NULL
                         CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    attempt              BIGINT NOT NULL DEFAULT 0,
    fence                BIGINT NOT NULL DEFAULT 0,
    lease_until_us       BIGINT,
    lease_us             BIGINT,
    cancel_requested     BIGINT NOT NULL DEFAULT 0,
    phase                TEXT NOT NULL DEFAULT '',
    epoch_done           BIGINT NOT NULL DEFAULT 0,
    epochs_planned       BIGINT NOT NULL DEFAULT 0,
    reconstruction_error DOUBLE PRECISION DEFAULT 0,
    regression_error     DOUBLE PRECISION DEFAULT 0,
    error_scale          DOUBLE PRECISION DEFAULT 0,
    remaining_s          DOUBLE PRECISION,
    outcome              TEXT,
    created_at_us        BIGINT NOT NULL,
    started_at_us        BIGINT,
    ended_at_us          BIGINT,
    report               TEXT,
    CHECK ((state = 'running') = (lease_until_us IS NOT NULL))
);

CREATE UNIQUE INDEX one_live_run_per_site ON site_training_runs (site_key) WHERE state IN ('queued', 'running');
CREATE INDEX live_site_training_runs ON site_training_runs (id) WHERE state IN ('queued', 'running');
CREATE INDEX site_training_runs_of_site ON site_training_runs (site_key, id);
