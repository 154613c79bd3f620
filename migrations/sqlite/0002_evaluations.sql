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
