-- Which server answers, and on which line of its history: a standby that becomes the primary begins a new timeline, and a
-- backup that is restored to another server has another identifier. Empty where the server does not tell.
CREATE FUNCTION database_history() RETURNS TEXT LANGUAGE plpgsql AS $$
BEGIN
    RETURN (SELECT system_identifier FROM pg_control_system()) || '/'
        || left(pg_walfile_name(pg_current_wal_insert_lsn()), 8);
EXCEPTION WHEN OTHERS THEN
    RETURN '';
END
$$;
