-- 1 for a run that a client asked for, 0 for one that the server started by itself.
ALTER TABLE training_runs ADD COLUMN priority INTEGER NOT NULL DEFAULT 1;

-- Waiting runs in the order in which they are claimed.
CREATE INDEX waiting_training_runs ON training_runs (priority DESC, id) WHERE state IN ('queued', 'running');
DROP INDEX live_training_runs;
