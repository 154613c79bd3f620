//! The composition root: settings -> store -> app -> one listener for REST and gRPC.
//!
//! A request enters here once, whatever its transport: it gets its id, its span, its place among
//! the requests at work and its deadline, then goes to `http` or `grpc` by its content type.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod activity;
mod async_layer;
mod connection;
mod connection_gate;
mod cors;
mod credentials;
mod forward;
mod forwarded_answer;
mod frame_limit;
mod guarded_stream;
mod host_check;
mod peer;
mod pipeline;
mod proxies;
mod refused_body;
mod request_body;
mod revocable_body;
mod tls;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use tokio::net::TcpListener;
use tokio::runtime::Handle;

use crate::app::access::Caller;
use crate::app::{App, NodeSettings, Retention, store_limits, store_location};
use crate::archive::{Archive, Location as ArchiveLocation};
use crate::clock::{Clock, Randomness};
use crate::config::{Config, NodeRole, OtherNode};
use crate::connect;
use crate::domain::{Error, KeySecret};
use crate::exchange::ConnectionDraft;
use crate::exchange::wire::parse_document;
use crate::openid;
use crate::shutdown::Shutdown;
use crate::store::{Sharing, Store, StoreOptions};
use crate::telemetry::Metrics;
use crate::worker;

use connection_gate::ConnectionGate;
use forward::Forwarder;
use host_check::HostCheck;
use pipeline::RequestPipeline;
use proxies::TrustedProxies;
use tls::Tls;

/// How often metrics are gathered, and the registry looks for what another process on the same file
/// has changed.
const REFRESH_EVERY: Duration = Duration::from_secs(2);
/// Time that the end of the store gets after the requests have ended.
const CLOSE_LIMIT: Duration = Duration::from_secs(5);

/// A server that listens but does not answer yet.
pub struct Server {
    config: Config,
    app: App,
    listener: TcpListener,
    /// For probes and metrics alone.
    monitoring: Option<TcpListener>,
    tls: Option<Arc<Tls>>,
    proxies: TrustedProxies,
    shutdown: Shutdown,
}

/// Loads again what can change while a server runs.
#[derive(Clone)]
pub struct Reloader {
    app: App,
    tls: Option<Arc<Tls>>,
}

impl Reloader {
    /// Loads the certificate and the keys again, whether they have changed or not.
    pub async fn reload(&self) {
        self.reload_certificate(true).await;
        if let Err(error) = self.app.access.refresh(&self.app.store, &self.app.clock).await {
            tracing::error!(%error, "cannot look for changed keys");
        }
    }

    async fn reload_certificate(&self, in_any_case: bool) {
        let Some(tls) = self.tls.clone() else { return };
        // Reads files; a panic there must not end the loop that calls this.
        let _ = tokio::task::spawn_blocking(move || tls.reload(in_any_case)).await;
    }
}

impl Server {
    /// Opens the store, loads the active models and takes the port.
    ///
    /// # Errors
    /// Names the folder or the address that cannot be used.
    pub async fn bind(config: Config, clock: Clock, randomness: Randomness) -> anyhow::Result<Self> {
        let proxies = TrustedProxies::new(&config.trusted_proxies)?;
        let options = StoreOptions {
            limits: store_limits(&config.limits),
            role: "server".to_owned(),
            sharing: Sharing::OneServer,
        };
        let location = store_location(&config)?;
        let store =
            Store::open_at(&location, options).await.with_context(|| format!("cannot open {location}"))?;
        store.log_newcomers();
        let app = App::new(store, clock, randomness, config.limits.clone(), Metrics::new()).await?;
        if let Some(folder) = &config.export_folder {
            app.export_folder.get_or_init(|| folder.clone());
        }
        if config.role.answers_clients() {
            open_archive(&app, &config)?;
        }
        app.serial_devices.get_or_init(|| config.serial_devices.clone());
        let tls = Tls::load(&config.tls)?;
        if tls.as_ref().is_some_and(|tls| tls.takes_client_certificates()) {
            app.access.close();
        }
        if let Some(provider) = openid::Provider::new(&config.openid)? {
            app.access.use_openid(provider);
        }
        prepare_access(&app, &config).await?;
        declare_connections(&app, &config).await?;
        let listener = connection::listen(config.listen)
            .with_context(|| format!("cannot listen on {}", config.listen))?;
        let monitoring = config.metrics_listen.map(|address| {
            connection::listen(address)
                .with_context(|| format!("cannot listen on {address}, the setting metrics_listen"))
        });
        let monitoring = monitoring.transpose()?;
        if config.role.answers_clients() {
            app.nodes().refresh_registries().await?;
        }
        app.nodes().join(NodeSettings::of(&config, reachable_url(&listener, tls.is_some())?)).await?;
        Ok(Self { config, app, listener, monitoring, tls, proxies, shutdown: Shutdown::new() })
    }

    /// The address that was taken; with port 0 in the settings, the system's choice.
    ///
    /// # Errors
    /// The system does not report it.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// The address of probes and metrics alone, if there is one.
    #[must_use]
    pub fn monitoring_address(&self) -> Option<SocketAddr> {
        self.monitoring.as_ref()?.local_addr().ok()
    }

    /// The application that both transports use.
    #[must_use]
    pub fn app(&self) -> &App {
        &self.app
    }

    /// Loads certificate and keys again when it is asked to.
    #[must_use]
    pub fn reloader(&self) -> Reloader {
        Reloader { app: self.app.clone(), tls: self.tls.clone() }
    }

    /// True if it speaks TLS.
    #[must_use]
    pub const fn has_tls(&self) -> bool {
        self.tls.is_some()
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
        let reloader = self.reloader();
        let Self { config, app, listener, monitoring, tls, proxies, shutdown } = self;
        if config.role.works_on_jobs() {
            shutdown.spawn(worker::train(app.clone(), config.training.clone(), shutdown.clone()));
            shutdown.spawn(worker::train_sites(app.clone(), config.training.clone(), shutdown.clone()));
            shutdown.spawn(worker::evaluate(app.clone(), config.evaluation.clone(), shutdown.clone()));
        }
        shutdown.spawn(maintenance_loop(reloader, config.role, shutdown.clone()));
        shutdown.spawn(retention_loop(app.clone(), shutdown.clone()));
        shutdown.spawn(keep_registered(app.clone(), shutdown.clone()));
        if config.role.answers_clients() {
            shutdown.spawn(worker::learn(app.clone(), shutdown.clone()));
            shutdown.spawn(connect::Supervisor::start(app.clone()).await.run(shutdown.clone()));
        }
        let mut allowed_hosts = config.allowed_hosts.clone();
        // Clients are redirected to this name.
        let advertised = config.advertised_url.as_deref().and_then(|url| url.split_once("://"));
        allowed_hosts.extend(advertised.map(|(_, host)| host.to_owned()));
        let hosts = HostCheck::new(&allowed_hosts, &config.cors_origins, listener.local_addr()?);
        let cors = cors::layer(&config.cors_origins);
        let gate = ConnectionGate::new(&config.limits, proxies.clone());
        let pipeline = Arc::new(if config.role.answers_clients() {
            let forwarder = match config.camera_on_other_node {
                OtherNode::Redirect => None,
                OtherNode::Proxy => Some(Forwarder::new(config.limits.message_bytes, &shutdown)?),
            };
            RequestPipeline::new(app.clone(), config.console, hosts, proxies, cors, forwarder, &shutdown)
        } else {
            RequestPipeline::monitoring(app.clone(), hosts, &shutdown)
        });
        let monitored = async {
            let Some(listener) = monitoring else { return anyhow::Ok(()) };
            let hosts = HostCheck::new(&config.allowed_hosts, &[], listener.local_addr()?);
            let pipeline = Arc::new(RequestPipeline::monitoring(app.clone(), hosts, &shutdown));
            let monitoring = connection::Acceptor { pipeline, tls: None, gate: None };
            monitoring.accept(listener, &config.limits, &shutdown).await;
            Ok(())
        };
        let clients = connection::Acceptor { pipeline, tls, gate: Some(gate) };
        let served = clients.accept(listener, &config.limits, &shutdown);
        let (monitored, ()) = tokio::join!(monitored, served);
        monitored?;
        tracing::info!("shutting down");
        if !shutdown.drain_with_timeout(config.limits.drain_time()).await {
            tracing::warn!("requests that did not end within limits.drain_s were dropped");
        }
        // Everything that was acknowledged is stored; a database that does not answer would hold the end up.
        if tokio::time::timeout(CLOSE_LIMIT, app.close()).await.is_err() {
            tracing::warn!("the store could not be closed in time");
        }
        tracing::info!("shut down");
        Ok(())
    }
}

/// The address of a listener for clients; `None` where it is that of any machine.
fn reachable_url(listener: &TcpListener, has_tls: bool) -> std::io::Result<Option<String>> {
    let address = listener.local_addr()?;
    let scheme = if has_tls { "https" } else { "http" };
    Ok((!address.ip().is_unspecified()).then(|| format!("{scheme}://{address}")))
}

/// Opens the archive of finished tracks. Without the one that nobody asked for, the server starts all the same.
fn open_archive(app: &App, config: &Config) -> anyhow::Result<()> {
    let location = match &config.archive {
        Some(archive) => ArchiveLocation::new(archive),
        None => ArchiveLocation::Folder(config.data.join("archive")),
    };
    let (clock, randomness) = (app.clock.clone(), app.randomness.clone());
    let new_name = move || randomness.uuid_v7(clock.now()).to_string();
    match Archive::open(&location, Handle::current(), new_name) {
        Ok(archive) => app.archived_history.use_archive(archive),
        Err(error) if config.archive.is_none() => {
            tracing::warn!(%error, "no finished tracks are kept: name a folder in the setting archive");
        }
        Err(error) => return Err(anyhow::Error::new(error).context("cannot open the archive")),
    }
    Ok(())
}

/// Stores the connections of the settings. Those that are not declared any more stay.
async fn declare_connections(app: &App, config: &Config) -> anyhow::Result<()> {
    for (index, declared) in config.connections.iter().enumerate() {
        let declare = async {
            let draft: ConnectionDraft = parse_document(&declared.json().map_err(Error::fault)?)?;
            app.connections().declare(draft.try_into()?).await
        };
        declare.await.with_context(|| format!("the setting connections[{index}]"))?;
    }
    Ok(())
}

/// Stores the administrator's key of the settings, and refuses to serve everybody by an oversight.
async fn prepare_access(app: &App, config: &Config) -> anyhow::Result<()> {
    if let Some(secret) = config.admin_key()? {
        let secret = KeySecret::parse(secret.reveal()).context(
            "the setting admin_key, or the file admin_key_file, must be a key of `sightfix keys generate`",
        )?;
        app.keys().ensure_admin(&secret).await?;
    }
    let is_loopback = config.listen.ip().is_loopback();
    if !app.access.is_open() {
        if !is_loopback && config.tls.certificate.is_none() {
            tracing::warn!("keys cross the network unencrypted: set up TLS here or at a proxy in front");
        }
        return Ok(());
    }
    anyhow::ensure!(
        is_loopback || config.insecure,
        "{} can be reached by other machines and no key exists: create one (sightfix keys create --role admin \
         --name NAME), set SIGHTFIX_ADMIN_KEY, or start with --insecure to serve everybody",
        config.listen
    );
    let from = if is_loopback { "on this machine" } else { "that reaches this address" };
    tracing::warn!("no key exists: everybody {from} may do everything; `sightfix keys create` changes that");
    Ok(())
}

/// Time between writes of when keys were used last, in rounds of the maintenance.
const STORE_USES_EVERY: u32 = 30;
/// Time between looks at the connections with other systems, in rounds of the maintenance.
const FIGURES_EVERY: u32 = 5;

async fn maintenance_loop(reloader: Reloader, role: NodeRole, shutdown: Shutdown) {
    let app = &reloader.app;
    let mut round = 0;
    loop {
        tokio::select! {
            () = shutdown.draining() => return,
            () = tokio::time::sleep(REFRESH_EVERY) => {}
        }
        app.metrics.maintenance_round();
        reloader.reload_certificate(false).await;
        gather_figures(app).await;
        // A worker reads what it trains when it trains it.
        if role.answers_clients()
            && let Err(error) = app.nodes().refresh_registries().await
        {
            tracing::error!(%error, "cannot look for changed sites and cameras");
        }
        if let Err(error) = app.access.refresh(&app.store, &app.clock).await {
            tracing::error!(%error, "cannot look for changed keys");
        }
        round = (round + 1) % STORE_USES_EVERY;
        if round % FIGURES_EVERY == 1 {
            match app.connections().figures().await {
                Ok(figures) => app.metrics.outside_connections(&figures),
                Err(error) => tracing::error!(%error, "the outboxes cannot be counted"),
            }
        }
        if round == 0
            && let Err(error) = app.access.store_last_uses(&app.store).await
        {
            tracing::error!(%error, "cannot store when keys were used last");
        }
        if let Err(error) = app.retraining().start_due().await {
            tracing::error!(%error, "cannot retrain moved cameras");
        }
    }
}

async fn keep_registered(app: App, shutdown: Shutdown) {
    app.nodes().keep_registered(shutdown).await;
}

/// Time between deletions of old samples, and before another attempt where one failed.
const RETENTION_EVERY: Duration = Duration::from_secs(3_600);
const RETENTION_RETRY: Duration = Duration::from_secs(60);

/// Deletes samples that are older than `limits.sample_days`, and prepares the tables of the weeks to come.
async fn retention_loop(app: App, shutdown: Shutdown) {
    let app = app.on_behalf_of(Caller::program("retention"));
    let work = async {
        loop {
            let pause = match app.samples().retain().await {
                Ok(Retention::Deleted(0)) => RETENTION_EVERY,
                Ok(Retention::Deleted(deleted)) => {
                    tracing::info!(deleted, "samples older than limits.sample_days were deleted");
                    RETENTION_EVERY
                }
                Ok(Retention::Refused(doubt)) => {
                    tracing::error!("no samples are deleted by limits.sample_days: {doubt}; set the clock");
                    RETENTION_EVERY
                }
                Err(error) => {
                    tracing::warn!(%error, "old samples could not be deleted; it is tried again");
                    RETENTION_RETRY
                }
            };
            tokio::time::sleep(pause).await;
        }
    };
    tokio::select! {
        () = shutdown.draining() => {}
        () = work => {}
    }
}

/// Maintains the store, and takes the figures of store, quotas and queues into the metrics.
async fn gather_figures(app: &App) {
    app.metrics.quotas(&app.quotas.usages());
    app.metrics.models_unusable(app.registry.model_faults().len());
    let maintained = async {
        app.metrics.storage(&app.store.maintain().await?);
        app.metrics.jobs(&app.store.job_counts().await?);
        Ok::<_, Error>(())
    };
    if let Err(error) = maintained.await {
        app.metrics.maintenance_failed();
        tracing::error!(%error, "the maintenance of the store failed");
    }
}
