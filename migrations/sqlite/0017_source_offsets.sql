-- How far sources have read the partitions of their topics, where the peer does not keep that for them (Kafka). All
-- messages before `next_offset` are settled.
CREATE TABLE source_offsets (
    connection_key   INTEGER NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    topic            TEXT    NOT NULL,
    partition_number INTEGER NOT NULL,
    next_offset      INTEGER NOT NULL,
    PRIMARY KEY (connection_key, topic, partition_number)
) STRICT, WITHOUT ROWID;
