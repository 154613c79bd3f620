# An image with nothing but the static program: `.ci/static`, then
#   docker build --file deploy/scratch.Dockerfile --tag sightfix target/x86_64-unknown-linux-musl/release
FROM scratch
COPY --chmod=755 sightfix /sightfix
USER 10001
WORKDIR /data
VOLUME ["/data", "/tmp"]
ENV SIGHTFIX_DATA=/data SIGHTFIX_LISTEN=0.0.0.0:8080
EXPOSE 8080
HEALTHCHECK --interval=10s --timeout=3s --start-period=10s CMD ["/sightfix", "health"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["/sightfix"]
CMD ["serve"]
