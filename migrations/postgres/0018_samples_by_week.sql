-- Samples in partitions by week of their time, so that old ones are dropped as tables. All that is stored so far becomes
-- one partition, which ends with the present week; partitions of later weeks are added while the server runs. What has
-- no partition goes to the default one. Weeks begin with those of the Unix epoch, on Thursdays 00:00 UTC.
DO $$
DECLARE
    week_us CONSTANT BIGINT := 604800000000;
    upto_us CONSTANT BIGINT := (floor(extract(epoch FROM now()) * 1000000 / week_us)::BIGINT + 1) * week_us;
    name    TEXT;
    early   TEXT;
BEGIN
    FOREACH name IN ARRAY ARRAY['samples', 'samples_without_fix'] LOOP
        early := name || '_before_' || to_char(to_timestamp(upto_us / 1000000) AT TIME ZONE 'UTC', 'YYYYMMDD');
        -- Partitions bound what a search by time reads.
        EXECUTE format('DROP INDEX %I', name || '_by_time');
        EXECUTE format('ALTER TABLE %I RENAME TO %I', name, early);
        EXECUTE format('ALTER INDEX %I RENAME TO %I', name || '_pkey', early || '_pkey');
        EXECUTE format('CREATE TABLE %I (LIKE %I INCLUDING DEFAULTS INCLUDING CONSTRAINTS INCLUDING INDEXES) '
                       'PARTITION BY RANGE (time_us)', name, early);
        EXECUTE format('ALTER TABLE %I ADD FOREIGN KEY (camera_key) REFERENCES cameras (key) ON DELETE CASCADE', name);
        EXECUTE format('CREATE TABLE %I PARTITION OF %I DEFAULT', name || '_other', name);
        EXECUTE format('WITH later AS (DELETE FROM %I WHERE time_us >= %s RETURNING *) INSERT INTO %I SELECT * FROM later',
                       early, upto_us, name);
        EXECUTE format('ALTER TABLE %I ATTACH PARTITION %I FOR VALUES FROM (MINVALUE) TO (%s)', name, early, upto_us);
    END LOOP;
END
$$;
