-- SHA-256 (hexadecimal) over the metadata and the weights of a model version. NULL in rows that an earlier
-- release wrote; the next start of this release fills it in.
ALTER TABLE models ADD COLUMN sha256 TEXT;

-- Length of the current lease in microseconds. A lease that ends further ahead than its own length was
-- taken while the clock was wrong, and counts as expired. NULL in rows that an earlier release wrote.
ALTER TABLE training_runs ADD COLUMN lease_us INTEGER;
ALTER TABLE evaluations ADD COLUMN lease_us INTEGER;

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
