-- Times are microseconds since 1970-01-01T00:00:00Z. Lists and maps are JSON text.
-- Keys of cameras are never used twice (AUTOINCREMENT): a row that names a deleted camera's key can
-- only fail, never land under the camera that took over the name.

-- Cameras whose targets are tracked together. Keys are never used twice, as those of cameras.
CREATE TABLE sites (
    key                  INTEGER PRIMARY KEY AUTOINCREMENT,
    id                   TEXT    NOT NULL UNIQUE,
    display_name         TEXT    NOT NULL,
    labels               TEXT    NOT NULL,
    origin_longitude_deg REAL,
    origin_latitude_deg  REAL,
    -- How finished tracks are kept, as JSON; NULL keeps none.
    history              TEXT,
    revision             INTEGER NOT NULL,
    created_at_us        INTEGER NOT NULL,
    updated_at_us        INTEGER NOT NULL,
    CHECK ((origin_longitude_deg IS NULL) = (origin_latitude_deg IS NULL))
) STRICT;

-- receivers: [{"receiver_id": text, "target_id": text, "clock_offset_us": integer, "sigma_m": number, if known}]
-- gnss_bias_sigma_m: standard deviation per axis of the bias that all fixes of the camera have in common; NULL is the
-- model's own prior. Numbers of model versions are never assigned twice, even after a version was deleted.
-- site_key: NULL if the camera belongs to no site. A site that cameras name cannot be deleted.
CREATE TABLE cameras (
    key                INTEGER PRIMARY KEY AUTOINCREMENT,
    id                 TEXT    NOT NULL UNIQUE,
    -- Of a profile, what no statement asks for, as JSON.
    profile            TEXT    NOT NULL,
    learn_automatically INTEGER NOT NULL,
    revision           INTEGER NOT NULL,
    created_at_us      INTEGER NOT NULL,
    updated_at_us      INTEGER NOT NULL,
    active_model       INTEGER,
    last_model_number  INTEGER NOT NULL DEFAULT 0,
    site_key           INTEGER REFERENCES sites (key),
    FOREIGN KEY (key, active_model) REFERENCES models (camera_key, number)
) STRICT;
CREATE INDEX cameras_of_site ON cameras (site_key, id) WHERE site_key IS NOT NULL;

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

-- Boxes that no receiver has a fix for. A table of their own, since the columns of the fix in
-- samples are NOT NULL. A key is in one of the two tables only; a sample with a
-- fix replaces one without.
CREATE TABLE samples_without_fix (
    camera_key          INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    time_us             INTEGER NOT NULL,
    target_id           TEXT    NOT NULL,
    left_px             REAL    NOT NULL,
    top_px              REAL    NOT NULL,
    width_px            REAL    NOT NULL,
    height_px           REAL    NOT NULL,
    class               TEXT,
    score               REAL,
    truth_longitude_deg REAL,
    truth_latitude_deg  REAL,
    PRIMARY KEY (camera_key, time_us, target_id)
) STRICT, WITHOUT ROWID;

-- Rows of each camera in the two tables, counted with every import and deletion, so that a limit needs no scan.
CREATE TABLE sample_counts (
    camera_key  INTEGER PRIMARY KEY REFERENCES cameras (key) ON DELETE CASCADE,
    samples     INTEGER NOT NULL,
    without_fix INTEGER NOT NULL DEFAULT 0
) STRICT;

-- Ids are UUIDs of version 7 as text: their order is the order of asking.
-- seed holds the 64 bits of an unsigned number. A progress number that is NULL was not a number.
-- priority is 1 for a run that a client asked for, 0 for one that the server started by itself. lease_us is the length of the
-- current lease: one that ends further ahead than its own length was taken while the clock was wrong, and counts as expired.
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
    lease_us             INTEGER,
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
    priority             INTEGER NOT NULL,
    CHECK ((state = 'running') = (lease_until_us IS NOT NULL))
) STRICT, WITHOUT ROWID;

CREATE UNIQUE INDEX one_live_run_per_camera ON training_runs (camera_key)
    WHERE state IN ('queued', 'running');
-- Waiting runs in the order in which they are claimed.
CREATE INDEX waiting_training_runs ON training_runs (priority DESC, id) WHERE state IN ('queued', 'running');
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

-- sha256 is hexadecimal, over the metadata and the weights. The weights stand last, so that reading all else never touches
-- them.
CREATE TABLE models (
    camera_key    INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    number        INTEGER NOT NULL,
    run_id        TEXT    UNIQUE,
    created_at_us INTEGER NOT NULL,
    sha256        TEXT    NOT NULL,
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

-- How far a version's position was from the fix of training samples that were held out. A later version
-- is compared on the same samples, as far as they are still stored.
CREATE TABLE held_out_errors (
    camera_key   INTEGER NOT NULL,
    model_number INTEGER NOT NULL,
    time_us      INTEGER NOT NULL,
    target_id    TEXT    NOT NULL,
    distance_m   REAL    NOT NULL,
    PRIMARY KEY (camera_key, model_number, time_us, target_id),
    FOREIGN KEY (camera_key, model_number) REFERENCES models (camera_key, number) ON DELETE CASCADE
) STRICT, WITHOUT ROWID;

-- What the watch on the cameras found: at most one move per model version, for a model that no longer
-- fits is replaced. retraining_run is the run that was started because of it, if any.
CREATE TABLE camera_moves (
    camera_key     INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    model_number   INTEGER NOT NULL,
    began_at_us    INTEGER NOT NULL,
    raised_at_us   INTEGER NOT NULL,
    shift_east_m   REAL    NOT NULL,
    shift_north_m  REAL    NOT NULL,
    statistic      REAL    NOT NULL,
    targets        INTEGER NOT NULL,
    retraining_run TEXT,
    PRIMARY KEY (camera_key, model_number),
    FOREIGN KEY (camera_key, model_number) REFERENCES models (camera_key, number)
) STRICT, WITHOUT ROWID;

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

-- Evaluations over stored samples: jobs as training runs are, with the same rules for lease and fence.
-- A range's end that is NULL is open. The truth is a point, or lines (JSON: lists of lists of
-- [longitude, latitude]), or, if both are NULL, what the samples state. Methods are a JSON list.
-- The report stands last, so that reading all else never touches it.

CREATE TABLE evaluations (
    id                  TEXT    NOT NULL PRIMARY KEY,
    camera_key          INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    train_from_us       INTEGER,
    train_until_us      INTEGER,
    test_from_us        INTEGER,
    test_until_us       INTEGER,
    truth_longitude_deg REAL,
    truth_latitude_deg  REAL,
    truth_lines         TEXT,
    methods             TEXT    NOT NULL,
    recipe              TEXT    NOT NULL,
    seeds               INTEGER NOT NULL,
    box_shift_px        REAL    NOT NULL,
    gnss_sigma_m        REAL,
    state               TEXT    NOT NULL
                        CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    attempt             INTEGER NOT NULL DEFAULT 0,
    fence               INTEGER NOT NULL DEFAULT 0,
    lease_until_us      INTEGER,
    lease_us            INTEGER,
    cancel_requested    INTEGER NOT NULL DEFAULT 0,
    phase               TEXT    NOT NULL DEFAULT '',
    steps_done          INTEGER NOT NULL DEFAULT 0,
    steps_planned       INTEGER NOT NULL DEFAULT 0,
    remaining_s         REAL,
    outcome             TEXT,
    created_at_us       INTEGER NOT NULL,
    started_at_us       INTEGER,
    ended_at_us         INTEGER,
    report              TEXT,
    CHECK ((truth_longitude_deg IS NULL) = (truth_latitude_deg IS NULL)),
    CHECK ((state = 'running') = (lease_until_us IS NOT NULL))
) STRICT;

CREATE INDEX live_evaluations ON evaluations (id) WHERE state IN ('queued', 'running');
CREATE INDEX evaluations_of_camera ON evaluations (camera_key, id);

-- Keys that clients present. The secret is random, so its SHA-256 is all that is needed to recognise it.
-- Rows are never changed but for their last use and their revocation: a reader sees from the numbers of
-- rows and of revoked ones whether anything has changed.

CREATE TABLE api_keys (
    id              TEXT    NOT NULL PRIMARY KEY,
    name            TEXT    NOT NULL,
    role            TEXT    NOT NULL,
    cameras         TEXT    NOT NULL,
    sha256          BLOB    NOT NULL UNIQUE CHECK (length(sha256) = 32),
    created_at_us   INTEGER NOT NULL,
    expires_at_us   INTEGER,
    last_used_at_us INTEGER,
    revoked_at_us   INTEGER
) STRICT, WITHOUT ROWID;

-- Who changed what, when and from where; written in the transaction of the change. Cameras are named by
-- their id, for entries outlive them. Numbers are never used twice.

CREATE TABLE audit_log (
    number     INTEGER PRIMARY KEY AUTOINCREMENT,
    time_us    INTEGER NOT NULL,
    actor      TEXT    NOT NULL,
    key_id     TEXT,
    address    TEXT,
    request_id TEXT,
    action     TEXT    NOT NULL,
    camera_id  TEXT,
    subject    TEXT
) STRICT;

CREATE INDEX audit_log_of_camera ON audit_log (camera_id, number) WHERE camera_id IS NOT NULL;

-- Answers that are repeated for a client that sends a change again under its Idempotency-Key; written in the
-- transaction of the change. Owner is the id of the API key that the client presented, '' without one. Digest
-- is the SHA-256 of what the request asked for. Numbers are never used twice: the oldest go first.

CREATE TABLE idempotency_keys (
    number          INTEGER PRIMARY KEY AUTOINCREMENT,
    owner           TEXT    NOT NULL,
    idempotency_key TEXT    NOT NULL,
    digest          BLOB    NOT NULL,
    answer          TEXT    NOT NULL,
    created_at_us   INTEGER NOT NULL,
    UNIQUE (owner, idempotency_key)
) STRICT;

-- Connections with other systems. `settings` is JSON and never contains a secret; `secrets` is a JSON object of texts,
-- which no interface shows.
CREATE TABLE connections (
    key           INTEGER PRIMARY KEY AUTOINCREMENT,
    id            TEXT    NOT NULL UNIQUE,
    display_name  TEXT    NOT NULL,
    paused        INTEGER NOT NULL CHECK (paused IN (0, 1)),
    settings      TEXT    NOT NULL,
    secrets       TEXT    NOT NULL,
    revision      INTEGER NOT NULL,
    created_at_us INTEGER NOT NULL,
    updated_at_us INTEGER NOT NULL
) STRICT;

-- Messages of sinks, in the order of their delivery. A row is deleted when its receiver has acknowledged it; a row with
-- a reason is not tried any more.
CREATE TABLE outbox (
    number         INTEGER PRIMARY KEY AUTOINCREMENT,
    connection_key INTEGER NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    message_id     TEXT    NOT NULL,
    subject        TEXT    NOT NULL,
    payload        BLOB    NOT NULL,
    created_at_us  INTEGER NOT NULL,
    dead_reason    TEXT
) STRICT;
CREATE INDEX outbox_queued ON outbox (connection_key, number) WHERE dead_reason IS NULL;
CREATE INDEX outbox_dead ON outbox (connection_key, number) WHERE dead_reason IS NOT NULL;

-- How far the outbox of a sink has come in the log of positions that the server keeps for it. The row is there before the
-- server makes positions and goes when all of them are in the outbox, so that of an earlier run tells of positions that may
-- be lost.
CREATE TABLE outbox_logs (
    connection_key INTEGER NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    log            TEXT    NOT NULL,
    position       INTEGER NOT NULL,
    PRIMARY KEY (connection_key, log)
) STRICT, WITHOUT ROWID;

-- How far sources have read the partitions of their topics, where the peer does not keep that for them (Kafka). All
-- messages before `next_offset` are settled.
CREATE TABLE source_offsets (
    connection_key   INTEGER NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    topic            TEXT    NOT NULL,
    partition_number INTEGER NOT NULL,
    next_offset      INTEGER NOT NULL,
    PRIMARY KEY (connection_key, topic, partition_number)
) STRICT, WITHOUT ROWID;

-- What cameras have recorded that learn automatically: parts of a few seconds, the oldest of which give way.
CREATE TABLE recording_parts (
    number         INTEGER PRIMARY KEY AUTOINCREMENT,
    camera_key     INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    recorded_at_us INTEGER NOT NULL,
    row_count      INTEGER NOT NULL,
    content        BLOB NOT NULL
) STRICT;
CREATE INDEX recording_parts_by_camera ON recording_parts (camera_key, number);

-- What a camera sees, as one still picture: JPEG or PNG, as `media_type` says.
CREATE TABLE camera_pictures (
    camera_key    INTEGER PRIMARY KEY REFERENCES cameras (key) ON DELETE CASCADE,
    media_type    TEXT NOT NULL,
    content       BLOB NOT NULL,
    updated_at_us INTEGER NOT NULL
) STRICT;

-- Places on the ground, of a site or of a camera. `settings` is JSON. Keys are never used twice.
CREATE TABLE places (
    key           INTEGER PRIMARY KEY AUTOINCREMENT,
    id            TEXT NOT NULL UNIQUE,
    site_key      INTEGER REFERENCES sites (key) ON DELETE CASCADE,
    camera_key    INTEGER REFERENCES cameras (key) ON DELETE CASCADE,
    settings      TEXT NOT NULL,
    revision      INTEGER NOT NULL,
    created_at_us INTEGER NOT NULL,
    updated_at_us INTEGER NOT NULL,
    CHECK ((site_key IS NULL) <> (camera_key IS NULL))
) STRICT;
CREATE INDEX places_of_site ON places (site_key, id) WHERE site_key IS NOT NULL;
CREATE INDEX places_of_camera ON places (camera_key, id) WHERE camera_key IS NOT NULL;

-- Events of places, in the order of their commits. `content` is JSON. An event that is found again has the id of the first.
CREATE TABLE place_events (
    number       INTEGER PRIMARY KEY AUTOINCREMENT,
    event_id     TEXT NOT NULL UNIQUE,
    place_key    INTEGER NOT NULL REFERENCES places (key) ON DELETE CASCADE,
    kind         TEXT NOT NULL,
    stored_at_us INTEGER NOT NULL,
    content      TEXT NOT NULL
) STRICT;
CREATE INDEX place_events_of_place ON place_events (place_key, number);

-- Counts of places by minute and by hour (`step_s`), class ('' if unknown) and figure; values are added up.
CREATE TABLE place_counts (
    place_key INTEGER NOT NULL REFERENCES places (key) ON DELETE CASCADE,
    step_s    INTEGER NOT NULL,
    from_s    INTEGER NOT NULL,
    class     TEXT NOT NULL,
    figure    TEXT NOT NULL,
    value     REAL NOT NULL,
    PRIMARY KEY (place_key, step_s, from_s, class, figure)
) STRICT, WITHOUT ROWID;
