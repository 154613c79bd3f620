-- Processes that share the database. A row is one run of a process and lasts as long as that process renews it: whoever
-- has seen the same renewal for lease_ms deletes the row, and with it the node's ownership of every camera.
CREATE TABLE nodes (
    id            TEXT COLLATE "C" PRIMARY KEY,
    url           TEXT,
    role          TEXT    NOT NULL,
    version       TEXT    NOT NULL,
    lease_ms      BIGINT  NOT NULL,
    renewal       BIGINT  NOT NULL,
    is_draining   BOOLEAN NOT NULL DEFAULT FALSE,
    started_at_us BIGINT  NOT NULL,
    renewed_at_us BIGINT  NOT NULL
);

-- The node that has a camera's live state. Nobody has it where node_id is NULL or no longer among the nodes. The fence
-- goes up by one with every acquisition.
CREATE TABLE camera_owners (
    camera_key BIGINT PRIMARY KEY REFERENCES cameras (key) ON DELETE CASCADE,
    node_id    TEXT COLLATE "C",
    fence      BIGINT NOT NULL
);
CREATE INDEX camera_owners_of_node ON camera_owners (node_id);
