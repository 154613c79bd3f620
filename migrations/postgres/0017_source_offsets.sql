-- How far sources have read the partitions of their topics, where the peer does not keep that for them (Kafka). All
-- messages before `next_offset` are settled.
CREATE TABLE source_offsets (
    connection_key   BIGINT NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    topic            TEXT COLLATE "C" NOT NULL,
    partition_number BIGINT NOT NULL,
    next_offset      BIGINT NOT NULL,
    PRIMARY KEY (connection_key, topic, partition_number)
);
