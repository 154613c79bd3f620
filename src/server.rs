//! The composition root: settings -> store -> app -> one listener for REST and gRPC.
//!
//! A request enters here once, whatever its transport: it gets its id, its span, its place among
//! the requests in flight and its time, then goes to `http` or `grpc` by its content type.

mod connection;
mod entrance;

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

use entrance::Entrance;

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
        let app = App::new(store, clock, randomness, config.limits.clone(), Metrics::new()).await?;
        let listener = TcpListener::bind(config.listen)
            .await
            .with_context(|| format!("cannot listen on {}", config.listen))?;
        Ok(Self { config, app, listener, shutdown: Shutdown::new() })
    }

    /// The address that was taken; with port 0 in the settings, the system's choice.
    ///
    /// # Errors
    /// The system does not tell.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// The application behind both transports.
    #[must_use]
    pub fn app(&self) -> &App {
        &self.app
    }

    /// Ends the server when told to.
    #[must_use]
    pub fn shutdown(&self) -> Shutdown {
        self.shutdown.clone()
    }

    /// Answers until the shutdown begins, then ends in order: no new connections, streams ended,
    /// runs put back, requests finished, store closed.
    ///
    /// # Errors
    /// Requests that did not end within their time.
    pub async fn run(self) -> anyhow::Result<()> {
        let Self { config, app, listener, shutdown } = self;
        shutdown.spawn(worker::train(app.clone(), config.training.clone(), shutdown.clone()));
        shutdown.spawn(worker::evaluate(app.clone(), config.evaluation.clone(), shutdown.clone()));
        shutdown.spawn(keep_up(app.clone(), shutdown.clone()));
        let entrance = Arc::new(Entrance::new(app.clone(), &shutdown));
        connection::accept(listener, entrance, &config.limits, &shutdown).await;
        tracing::info!("ending");
        let in_order = shutdown.finish(Duration::from_secs(config.limits.drain_s)).await;
        app.store.close().await;
        anyhow::ensure!(in_order, "some requests did not end in time and were dropped");
        tracing::info!("ended");
        Ok(())
    }
}

async fn keep_up(app: App, shutdown: Shutdown) {
    loop {
        tokio::select! {
            () = shutdown.begun() => return,
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
            tracing::error!(%error, "cannot train moved cameras anew");
        }
    }
}
