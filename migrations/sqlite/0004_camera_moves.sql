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

ALTER TABLE cameras ADD COLUMN retrain_when_moved INTEGER NOT NULL DEFAULT 0;
