-- The node that runs a connection: reads its source, or delivers its outbox. Nobody does where node_id is NULL or no longer among
-- the nodes. The fence goes up by one with every acquisition.
CREATE TABLE connection_owners (
    connection_key BIGINT PRIMARY KEY REFERENCES connections (key) ON DELETE CASCADE,
    node_id        TEXT COLLATE "C",
    fence          BIGINT NOT NULL
);

-- What each node knows of a connection, as JSON, so that every node can show it.
CREATE TABLE connection_statuses (
    connection_key BIGINT NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    node_id        TEXT COLLATE "C" NOT NULL,
    status         TEXT   NOT NULL,
    PRIMARY KEY (connection_key, node_id)
);

-- The node whose source feeds a camera that another node owns; the owner gives the camera up for it.
ALTER TABLE camera_owners ADD COLUMN wanted_by TEXT COLLATE "C";
CREATE INDEX camera_owners_wanted ON camera_owners (node_id) WHERE wanted_by IS NOT NULL;
