-- Answers that are repeated for a client that sends a change again under its Idempotency-Key; written in the
-- transaction of the change. Owner is the id of the API key that the client presented, '' without one. Digest
-- is the SHA-256 of what the request asked for. Numbers are never used twice: the oldest go first.

CREATE TABLE idempotency_keys (
    number          INTEGER PRIMARY KEY AUTOINCREMENT,
    owner           TEXT    NOT NULL,
    idempotency_key TEXT    NOT NULL,
    digest          BLOB    NOT NULL,
    answer          TEXT    NOT NULL,
    created_at_us   INTEGER NOT NULL,
    UNIQUE (owner, idempotency_key)
) STRICT;

CREATE INDEX idempotency_keys_by_age ON idempotency_keys (created_at_us);
