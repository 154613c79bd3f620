# Sourced by the scripts that talk to a running server. Makes the temporary `folder`, and when the script ends stops the
# server, shows its log after a failure, and removes the folder.
# shellcheck shell=bash
folder="$(mktemp -d)"
server=
finish() {
  status=$?
  if [ -n "$server" ]; then
    kill "$server" 2>/dev/null || true
    wait "$server" 2>/dev/null || true
  fi
  if [ "$status" -ne 0 ] && [ -f "$folder/log" ]; then tail -n 20 "$folder/log" >&2; fi
  rm -rf "$folder"
  exit "$status"
}
trap finish EXIT
sightfix="$(.ci/binary)"

# Says what is missing, and ends the script.
fail() {
  echo "$(basename "$0"): $1" >&2
  exit 1
}

# Makes the virtual environment `$folder/venv` with these packages.
python_packages() {
  local python="${PYTHON:-python3}"
  "$python" -m venv "$folder/venv" || fail "$python with its venv module is needed"
  "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@" ||
    fail "pip cannot install $*; is a package index reachable?"
}

# Starts the server on `$folder/data` and a free port: its `address` is host:port.
start_server() {
  SIGHTFIX_LOG_FORMAT=json "$sightfix" serve --data "$folder/data" --listen 127.0.0.1:0 >/dev/null 2>"$folder/log" &
  server=$!
  address=
  for _ in $(seq 300); do
    address="$(sed -n 's/.*"address":"\([^"]*\)".*/\1/p' "$folder/log" | head -n 1)"
    if [ -n "$address" ]; then return; fi
    kill -0 "$server" 2>/dev/null || break
    sleep 0.1
  done
  fail "the server does not start"
}
