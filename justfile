# The commands that people run; `just` lists them. Each works without just, too.

# All tests.
test:
    cargo test

# What a commit must pass besides tests: formatting, lints, links.
check:
    cargo fmt --all --check
    cargo clippy --all-targets -- -D warnings
    .ci/links

# A server with a demonstration.
demo:
    cargo run --release -- serve --demo

# The console's files, which are committed.
console:
    cd console && npm ci && npm run build

# The descriptions of the interfaces, which are committed.
interfaces:
    cargo run -- openapi > docs/openapi.json
    cd clients/python && python -m codegen.proto_reference
    UPDATE_REFERENCE=1 cargo test --test it reference

# The pages of docs/ as a site in target/site.
docs:
    .ci/docs

# All that a change must pass, as on a clean clone.
ci:
    .ci/run
