-- In which transaction every camera was changed last, so that a poll reads what has changed and not all cameras. The numbers of
-- transactions are compared with the oldest one that had not ended at the poll before: none is missed that is committed late.
-- Rows of deleted cameras stay for a day; processes read all cameras every few minutes in any case.
CREATE TABLE camera_changes (
    camera_key BIGINT PRIMARY KEY,
    id         TEXT COLLATE "C" NOT NULL,
    is_deleted BOOLEAN          NOT NULL,
    changed_in XID8             NOT NULL,
    changed_at TIMESTAMPTZ      NOT NULL
);
CREATE INDEX camera_changes_by_transaction ON camera_changes (changed_in);
CREATE INDEX camera_changes_of_deleted ON camera_changes (changed_at) WHERE is_deleted;

CREATE FUNCTION note_camera_change() RETURNS TRIGGER LANGUAGE plpgsql AS $$
DECLARE
    camera cameras%ROWTYPE;
BEGIN
    IF TG_OP = 'DELETE' THEN
        camera := OLD;
        DELETE FROM camera_changes WHERE is_deleted AND changed_at < clock_timestamp() - INTERVAL '1 day';
    ELSE
        camera := NEW;
    END IF;
    INSERT INTO camera_changes VALUES (camera.key, camera.id, TG_OP = 'DELETE', pg_current_xact_id(), clock_timestamp())
    ON CONFLICT (camera_key) DO UPDATE
    SET is_deleted = EXCLUDED.is_deleted, changed_in = EXCLUDED.changed_in, changed_at = EXCLUDED.changed_at;
    RETURN NULL;
END
$$;

CREATE TRIGGER note_camera_change AFTER INSERT OR DELETE OR UPDATE OF revision, active_model ON cameras
    FOR EACH ROW EXECUTE FUNCTION note_camera_change();

INSERT INTO camera_changes SELECT key, id, FALSE, pg_current_xact_id(), clock_timestamp() FROM cameras;
