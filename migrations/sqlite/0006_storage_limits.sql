-- Samples of each camera, counted with every import and deletion, so that a limit needs no scan.
CREATE TABLE sample_counts (
    camera_key INTEGER PRIMARY KEY REFERENCES cameras (key) ON DELETE CASCADE,
    samples    INTEGER NOT NULL
) STRICT;

INSERT INTO sample_counts (camera_key, samples)
SELECT camera_key, count(*) FROM samples GROUP BY camera_key;

-- Numbers of model versions are never assigned twice, even after a version was deleted.
-- 0: no version was stored since this column exists; the greatest number of the table counts then.
ALTER TABLE cameras ADD COLUMN last_model_number INTEGER NOT NULL DEFAULT 0;
