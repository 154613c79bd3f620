//! The composition root: settings -> store -> app -> one listener for REST and gRPC.
//!
//! A request enters here once, whatever its transport: it gets its id, its span, its place among
//! the requests at work and its deadline, then goes to `http` or `grpc` by its content type.

mod activity;
mod connection;
mod frame_limit;
mod guarded_stream;
mod host_check;
mod pipeline;
mod request_body;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use tokio::net::TcpListener;

use crate::app::{App, store_limits};
use crate::clock::{Clock, Randomness};
use crate::config::Config;
use crate::shutdown::Shutdown;
use crate::store::{Store, StoreOptions};
use crate::telemetry::Metrics;
use crate::worker;

use host_check::HostCheck;
use pipeline::RequestPipeline;

/// How often metrics are gathered, and the registry looks for what another process on the same file
/// has changed.
const REFRESH_EVERY: Duration = Duration::from_secs(2);

/// A server that listens but does not answer yet.
pub struct Server {
    config: Config,
    app: App,
    listener: TcpListener,
    shutdown: Shutdown,
}

impl Server {
    /// Opens the store, loads the active models and takes the port.
    ///
    /// # Errors
    /// Names the folder or the address that cannot be used.
    pub async fn bind(config: Config, clock: Clock, randomness: Randomness) -> anyhow::Result<Self> {
        let options = StoreOptions { limits: store_limits(&config.limits), role: "server".to_owned() };
        let store = Store::open_with(&config.data, options)
            .await
            .with_context(|| format!("cannot open the data folder {}", config.data.display()))?;
        store.log_newcomers();
        let app = App::new(store, clock, randomness, config.limits.clone(), Metrics::new()).await?;
        let listener = connection::listen(config.listen)
            .with_context(|| format!("cannot listen on {}", config.listen))?;
        Ok(Self { config, app, listener, shutdown: Shutdown::new() })
    }

    /// The address that was taken; with port 0 in the settings, the system's choice.
    ///
    /// # Errors
    /// The system does not report it.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// The application behind both transports.
    #[must_use]
    pub fn app(&self) -> &App {
        &self.app
    }

    /// Shuts the server down when it is asked to.
    #[must_use]
    pub fn shutdown(&self) -> Shutdown {
        self.shutdown.clone()
    }

    /// Answers until it is asked to shut down, then drains: no new connections, streams ended, runs put
    /// back, requests finished, store closed.
    ///
    /// # Errors
    /// The system does not report the address.
    pub async fn run(self) -> anyhow::Result<()> {
        let Self { config, app, listener, shutdown } = self;
        shutdown.spawn(worker::train(app.clone(), config.training.clone(), shutdown.clone()));
        shutdown.spawn(worker::evaluate(app.clone(), config.evaluation.clone(), shutdown.clone()));
        shutdown.spawn(maintenance_loop(app.clone(), shutdown.clone()));
        let hosts = HostCheck::new(&config.allowed_hosts, listener.local_addr()?);
        let pipeline = Arc::new(RequestPipeline::new(app.clone(), config.console, hosts, &shutdown));
        connection::accept(listener, pipeline, &config.limits, &shutdown).await;
        tracing::info!("shutting down");
        if !shutdown.drain_with_timeout(config.limits.drain_time()).await {
            tracing::warn!("requests that did not end within limits.drain_s were dropped");
        }
        app.close().await;
        tracing::info!("shut down");
        Ok(())
    }
}

async fn maintenance_loop(app: App, shutdown: Shutdown) {
    loop {
        tokio::select! {
            () = shutdown.draining() => return,
            () = tokio::time::sleep(REFRESH_EVERY) => {}
        }
        app.metrics.upkeep();
        match app.store.maintain().await {
            Ok(status) => app.metrics.storage(&status),
            Err(error) => tracing::error!(%error, "the maintenance of the store failed"),
        }
        if let Err(error) = app.registry.refresh(&app.store).await {
            tracing::error!(%error, "cannot look for changed cameras");
        }
        if let Err(error) = app.retrain_moved().await {
            tracing::error!(%error, "cannot retrain moved cameras");
        }
    }
}
