# syntax=docker/dockerfile:1
FROM rust:1.95-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends gcc g++ libc6-dev make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /build
COPY . .
RUN --mount=type=cache,target=/usr/local/cargo/registry --mount=type=cache,target=/build/target \
    cargo build --release --locked && cp target/release/sightfix /usr/local/bin/sightfix

FROM debian:bookworm-slim
RUN useradd --system --uid 10001 --home-dir /data --create-home sightfix
COPY --from=build /usr/local/bin/sightfix /usr/local/bin/sightfix
USER 10001
VOLUME /data
ENV SIGHTFIX_DATA=/data SIGHTFIX_LISTEN=0.0.0.0:8080
# Reachable by others: give it a key (SIGHTFIX_ADMIN_KEY or --admin-key-file), or start it with --insecure.
EXPOSE 8080
HEALTHCHECK --interval=10s --timeout=3s --start-period=10s CMD ["sightfix", "health"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["sightfix"]
CMD ["serve"]
