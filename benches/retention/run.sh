#!/usr/bin/env bash
# What retention of samples costs in PostgreSQL: batched deletes by the BRIN over time, beside partitions that are dropped.
# Usage: benches/retention/run.sh URL [rows, 10000000 by default]. It works in the schema `retention` of that database.
set -euo pipefail
url="$1"
rows="${2:-10000000}"
sql() { psql "$url" -v ON_ERROR_STOP=1 -Atq -c "SET search_path = retention; SET synchronous_commit = off" "$@"; }
figure() { printf '| %s | %s |\n' "$1" "$2"; }
seconds() { local begin; begin="$(date +%s.%N)"; "$@" >/dev/null; python3 -c "import sys, time; print(f'{time.time() - $begin:.1f} s')"; }

# 1,000 cameras, a sample a second each; 10 days have the share of 1/10 each whatever the number of rows.
row="SELECT number % 1000 AS camera_key, number / 1000 * 1000000 AS time_us, 'target-' || number % 7 AS target_id, 1.5::FLOAT8 AS left_px, \
  2.5::FLOAT8 AS top_px, 3.5::FLOAT8 AS width_px, 4.5::FLOAT8 AS height_px, 103.98678 + random() AS longitude_deg, 30.628 + random() AS latitude_deg, \
  1.5::FLOAT8 AS sigma_m FROM generate_series(\$1::BIGINT, \$2::BIGINT - 1) AS numbers (number)"
columns="camera_key BIGINT NOT NULL, time_us BIGINT NOT NULL, target_id TEXT COLLATE \"C\" NOT NULL, left_px FLOAT8, top_px FLOAT8, \
  width_px FLOAT8, height_px FLOAT8, longitude_deg FLOAT8, latitude_deg FLOAT8, sigma_m FLOAT8, class TEXT, score FLOAT8, \
  truth_longitude_deg FLOAT8, truth_latitude_deg FLOAT8, PRIMARY KEY (camera_key, time_us, target_id)"
names="camera_key, time_us, target_id, left_px, top_px, width_px, height_px, longitude_deg, latitude_deg, sigma_m"

psql "$url" -qc 'DROP SCHEMA IF EXISTS retention CASCADE' -c 'CREATE SCHEMA retention' 2>/dev/null
sql -c "CREATE TABLE one ($columns); CREATE INDEX one_by_time ON one USING BRIN (time_us)" \
  -c "CREATE TABLE parted ($columns) PARTITION BY RANGE (time_us)"
day=$((rows / 1000 / 10 * 1000000))
for number in $(seq 0 9); do
  sql -c "CREATE TABLE parted_$number PARTITION OF parted FOR VALUES FROM ($((number * day))) TO ($(((number + 1) * day)))"
done
fill() {
  local table="$1" at="$2" upto="$3" next
  while [ "$at" -lt "$upto" ]; do
    next=$((at + 4000 < upto ? at + 4000 : upto))
    printf 'INSERT INTO %s (%s) %s;\n' "$table" "$names" "$(printf '%s' "$row" | sed "s/\$1/$at/; s/\$2/$next/")"
    at="$next"
  done | sql -f -
}
delete_before() {
  # In batches, so that no transaction is long: by blocks of the table, which rows of one time share.
  local table="$1" before="$2" step=$((day / 20)) at=0
  while [ "$at" -lt "$before" ]; do
    printf 'DELETE FROM %s WHERE time_us >= %s AND time_us < %s;\n' "$table" "$at" "$((at + step))"
    at=$((at + step))
  done | sql -f -
}
scan() { sql -c "SELECT count(*), avg(left_px) FROM $1 WHERE camera_key = 7"; }

echo "| $rows rows, 4,000 per transaction | |"; echo '|---|---:|'
figure 'fill, one table' "$(seconds fill one 0 "$rows")"
figure 'fill, ten partitions' "$(seconds fill parted 0 "$rows")"
size() { sql -c "SELECT pg_size_pretty(sum(pg_total_relation_size(oid))) FROM pg_class WHERE relname ~ '^$1(_[0-9])?\$'"; }
figure 'size with indexes, one table' "$(size one)"
figure 'size of the BRIN' "$(sql -c "SELECT pg_size_pretty(pg_relation_size('one_by_time'))")"
figure 'size, partitions' "$(size parted)"
sql -c 'ANALYZE one' -c 'ANALYZE parted'
figure "read a camera's samples, one table" "$(seconds scan one)"
figure "read a camera's samples, partitions" "$(seconds scan parted)"
figure 'delete a tenth by BRIN, 20 batches' "$(seconds delete_before one "$day")"
figure 'vacuum after it' "$(seconds sql -c 'VACUUM one')"
figure 'size after it' "$(size one)"
figure 'fill a tenth again' "$(seconds fill one "$rows" $((rows + rows / 10)))"
figure 'size after that' "$(size one)"
figure 'drop a partition of a tenth' "$(seconds sql -c 'DROP TABLE parted_0')"
psql "$url" -qc 'DROP SCHEMA retention CASCADE' 2>/dev/null
