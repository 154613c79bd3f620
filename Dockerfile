# syntax=docker/dockerfile:1
FROM rust:1.95.0-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends gcc g++ libc6-dev make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /build
COPY . .
RUN --mount=type=cache,target=/usr/local/cargo/registry --mount=type=cache,target=/build/target \
    cargo build --release --locked \
    && cp target/release/sightfix /usr/local/bin/sightfix && mkdir /data

# The C library, certificates and nothing else: no shell, no package manager.
FROM gcr.io/distroless/cc-debian12
COPY --from=build /usr/local/bin/sightfix /usr/local/bin/sightfix
COPY --from=build --chown=10001:10001 --chmod=700 /data /data
USER 10001
WORKDIR /data
VOLUME /data
ENV SIGHTFIX_DATA=/data SIGHTFIX_LISTEN=0.0.0.0:8080
# Reachable by others: give it a key (SIGHTFIX_ADMIN_KEY or --admin-key-file), or start it with --insecure.
EXPOSE 8080
HEALTHCHECK --interval=10s --timeout=3s --start-period=10s CMD ["/usr/local/bin/sightfix", "health"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["/usr/local/bin/sightfix"]
CMD ["serve"]
