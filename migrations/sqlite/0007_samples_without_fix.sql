-- Boxes that no receiver has a fix for. A table of their own: the columns of the fix in samples are NOT NULL,
-- and rows with a fix are read and written as before. A key is in one of the two tables only; a sample with a
-- fix takes the place of one without.
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

-- Rows of samples_without_fix; the column samples counts those of the table samples.
ALTER TABLE sample_counts ADD COLUMN without_fix INTEGER NOT NULL DEFAULT 0;

-- Standard deviation per axis of the bias that all fixes of the camera have in common. NULL: the model's
-- own prior.
ALTER TABLE cameras ADD COLUMN gnss_bias_sigma_m REAL;
