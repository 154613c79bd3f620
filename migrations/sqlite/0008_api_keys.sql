-- Keys that clients present. The secret is random, so its SHA-256 is all that is needed to recognise it.
-- Rows are never changed but for their last use and their revocation: a reader sees from the numbers of
-- rows and of revoked ones whether anything has changed.

CREATE TABLE api_keys (
    id              TEXT    NOT NULL PRIMARY KEY,
    name            TEXT    NOT NULL,
    role            TEXT    NOT NULL,
    cameras         TEXT    NOT NULL,
    sha256          BLOB    NOT NULL UNIQUE CHECK (length(sha256) = 32),
    created_at_us   INTEGER NOT NULL,
    expires_at_us   INTEGER,
    last_used_at_us INTEGER,
    revoked_at_us   INTEGER
) STRICT, WITHOUT ROWID;
