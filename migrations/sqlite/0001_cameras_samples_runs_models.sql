-- Times are microseconds since 1970-01-01T00:00:00Z. Lists and maps are JSON text.
-- Keys of cameras are never used twice (AUTOINCREMENT): a row that names a deleted camera's key can
-- only fail, never land under the camera that took over the name.

CREATE TABLE cameras (
    key             INTEGER PRIMARY KEY AUTOINCREMENT,
    id              TEXT    NOT NULL UNIQUE,
    display_name    TEXT    NOT NULL,
    image_width_px  INTEGER,
    image_height_px INTEGER,
    gnss_sigma_m    REAL,
    recipe          TEXT    NOT NULL,
    target_classes  TEXT    NOT NULL,
    labels          TEXT    NOT NULL,
    revision        INTEGER NOT NULL,
    created_at_us   INTEGER NOT NULL,
    updated_at_us   INTEGER NOT NULL,
    active_model    INTEGER,
    CHECK ((image_width_px IS NULL) = (image_height_px IS NULL)),
    FOREIGN KEY (key, active_model) REFERENCES models (camera_key, number)
) STRICT;

-- The primary key is at once the rule "one sample per camera, target and time" and the order in
-- which samples are read, so one b-tree holds all.
CREATE TABLE samples (
    camera_key          INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    time_us             INTEGER NOT NULL,
    target_id           TEXT    NOT NULL,
    left_px             REAL    NOT NULL,
    top_px              REAL    NOT NULL,
    width_px            REAL    NOT NULL,
    height_px           REAL    NOT NULL,
    longitude_deg       REAL    NOT NULL,
    latitude_deg        REAL    NOT NULL,
    sigma_m             REAL,
    class               TEXT,
    score               REAL,
    truth_longitude_deg REAL,
    truth_latitude_deg  REAL,
    PRIMARY KEY (camera_key, time_us, target_id)
) STRICT, WITHOUT ROWID;

-- Ids are UUIDs of version 7 as text: their order is the order of asking.
-- seed holds the 64 bits of an unsigned number. A progress number that is NULL was not a number.
CREATE TABLE training_runs (
    id                   TEXT    NOT NULL PRIMARY KEY,
    camera_key           INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    recipe               TEXT    NOT NULL,
    seed                 INTEGER NOT NULL,
    epochs               INTEGER,
    from_us              INTEGER,
    until_us             INTEGER,
    state                TEXT    NOT NULL
                         CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    attempt              INTEGER NOT NULL DEFAULT 0,
    fence                INTEGER NOT NULL DEFAULT 0,
    lease_until_us       INTEGER,
    cancel_requested     INTEGER NOT NULL DEFAULT 0,
    phase                TEXT    NOT NULL DEFAULT '',
    epoch_done           INTEGER NOT NULL DEFAULT 0,
    epochs_planned       INTEGER NOT NULL DEFAULT 0,
    reconstruction_error REAL             DEFAULT 0,
    regression_error     REAL             DEFAULT 0,
    error_scale          REAL             DEFAULT 0,
    remaining_s          REAL,
    model_version        INTEGER,
    outcome              TEXT,
    created_at_us        INTEGER NOT NULL,
    started_at_us        INTEGER,
    ended_at_us          INTEGER,
    CHECK ((state = 'running') = (lease_until_us IS NOT NULL))
) STRICT, WITHOUT ROWID;

CREATE UNIQUE INDEX one_live_run_per_camera ON training_runs (camera_key)
    WHERE state IN ('queued', 'running');
CREATE INDEX live_training_runs ON training_runs (id) WHERE state IN ('queued', 'running');
CREATE INDEX training_runs_of_camera ON training_runs (camera_key, id);

CREATE TABLE training_epochs (
    run_id               TEXT    NOT NULL REFERENCES training_runs (id) ON DELETE CASCADE,
    epoch                INTEGER NOT NULL,
    loss                 REAL,
    reconstruction_error REAL,
    regression_error     REAL,
    error_scale          REAL,
    PRIMARY KEY (run_id, epoch)
) STRICT, WITHOUT ROWID;

CREATE TABLE training_log (
    run_id      TEXT    NOT NULL REFERENCES training_runs (id) ON DELETE CASCADE,
    line_number INTEGER NOT NULL,
    at_us       INTEGER NOT NULL,
    line        TEXT    NOT NULL,
    PRIMARY KEY (run_id, line_number)
) STRICT, WITHOUT ROWID;

-- The weights stand last, so that reading all else never touches them.
CREATE TABLE models (
    camera_key    INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    number        INTEGER NOT NULL,
    run_id        TEXT    UNIQUE,
    created_at_us INTEGER NOT NULL,
    metadata      TEXT    NOT NULL,
    weights       BLOB    NOT NULL,
    PRIMARY KEY (camera_key, number)
) STRICT;

-- What was active, in order: a roll back marks the last row and returns to the one before.
CREATE TABLE activations (
    camera_key        INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    position          INTEGER NOT NULL,
    model_number      INTEGER NOT NULL,
    activated_at_us   INTEGER NOT NULL,
    rolled_back_at_us INTEGER,
    PRIMARY KEY (camera_key, position),
    FOREIGN KEY (camera_key, model_number) REFERENCES models (camera_key, number)
) STRICT, WITHOUT ROWID;
