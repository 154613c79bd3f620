//! `sightfix serve`

mod demonstration;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use super::{DataFolder, runtime};
use crate::app::store_location;
use crate::clock::{Clock, Randomness};
use crate::config::{Config, Overrides};
use crate::server::{Reloader, Server};
use crate::shutdown::Shutdown;
use crate::telemetry::{self, LogControl};

/// Serve REST and gRPC on one port
#[derive(Args)]
pub(super) struct Serve {
    /// Address and port [env: SIGHTFIX_LISTEN] [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDR")]
    listen: Option<SocketAddr>,
    /// Address of this process for clients that others with the same database redirect here
    /// [env: SIGHTFIX_ADVERTISED_URL]
    #[arg(long, value_name = "URL")]
    advertise: Option<String>,
    /// Fill an empty data folder with a simulated harbour, train its cameras, and print requests to try
    #[arg(long)]
    demo: bool,
    /// Serve everybody on an address that other machines reach, while no key exists [env: SIGHTFIX_INSECURE]
    #[arg(long)]
    insecure: bool,
    /// File with the secret of an administrator's key; or set SIGHTFIX_ADMIN_KEY
    #[arg(long, value_name = "FILE")]
    admin_key_file: Option<PathBuf>,
    /// Certificate chain of the server (PEM): serve TLS; plain HTTP then only to this machine
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    tls_cert: Option<PathBuf>,
    /// Private key of the certificate (PEM)
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
    /// Authority of client certificates (PEM), which have the role of the setting tls.client_role
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    tls_client_ca: Option<PathBuf>,
    #[command(flatten)]
    folder: DataFolder,
}

impl Serve {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let overrides = Overrides {
            listen: self.listen,
            advertised_url: self.advertise,
            insecure: self.insecure,
            admin_key_file: self.admin_key_file,
            tls_certificate: self.tls_cert,
            tls_key: self.tls_key,
            tls_client_ca: self.tls_client_ca,
            ..self.folder.overrides()
        };
        let settings = Config::load(file, overrides.clone())?;
        let source = SettingsSource { file: file.map(Path::to_owned), overrides };
        runtime()?.block_on(async {
            let log = telemetry::start_log(&settings)?;
            let server = Server::bind(settings.clone(), Clock::system(), Randomness::system()).await?;
            let address = server.address().context("cannot determine the address")?;
            let (app, shutdown) = (server.app().clone(), server.shutdown());
            shut_down_on_signal(shutdown.clone())?;
            #[cfg(unix)]
            reload_on_hangup(source, log.clone(), server.reloader());
            tracing::info!(
                %address, store = %store_location(&settings)?, tls = server.has_tls(), "serving REST and gRPC"
            );
            if let Some(monitoring) = server.monitoring_address() {
                tracing::info!(%monitoring, "serving probes and metrics, without keys");
            }
            let has_tls = server.has_tls();
            let serving = tokio::spawn(server.run());
            // Without TLS and keys the simulated devices are let in as everybody on this machine is.
            let moves = !has_tls && app.access.is_open();
            let shown = if self.demo { demonstration::show(&app, address, moves).await } else { Ok(()) };
            if shown.is_err() {
                shutdown.drain();
            }
            serving.await.context("the server task panicked")??;
            log.close();
            shown
        })
    }
}

/// Shuts the server down at the first SIGINT or SIGTERM; a second one exits immediately. The signals are handled from
/// the return of this function on.
fn shut_down_on_signal(shutdown: Shutdown) -> anyhow::Result<()> {
    let mut signals = EndSignals::listen()?;
    tokio::spawn(async move {
        signals.next().await;
        shutdown.drain();
        signals.next().await;
        std::process::exit(130);
    });
    Ok(())
}

#[cfg(unix)]
struct EndSignals {
    terminate: tokio::signal::unix::Signal,
    interrupt: tokio::signal::unix::Signal,
}

#[cfg(unix)]
impl EndSignals {
    fn listen() -> anyhow::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        let handle = |kind| signal(kind).context("cannot handle SIGTERM and SIGINT");
        Ok(Self { terminate: handle(SignalKind::terminate())?, interrupt: handle(SignalKind::interrupt())? })
    }

    async fn next(&mut self) {
        tokio::select! {
            _ = self.terminate.recv() => {}
            _ = self.interrupt.recv() => {}
        }
    }
}

#[cfg(not(unix))]
struct EndSignals;

#[cfg(not(unix))]
impl EndSignals {
    fn listen() -> anyhow::Result<Self> {
        Ok(Self)
    }

    async fn next(&mut self) {
        let _ = tokio::signal::ctrl_c().await;
    }
}

/// Where the settings came from, to read them again.
#[cfg(unix)]
struct SettingsSource {
    file: Option<PathBuf>,
    overrides: Overrides,
}

#[cfg(unix)]
impl SettingsSource {
    /// Takes the log's filter of the settings as they are now; settings that cannot be read change nothing.
    fn reload_filter(&self, log: &LogControl) {
        let settings = Config::load(self.file.as_deref(), self.overrides.clone());
        match settings.and_then(|settings| log.set_filter(&settings.log_filter)) {
            Ok(()) => {}
            Err(error) => tracing::error!(error = format!("{error:#}"), "the log filter is unchanged"),
        }
    }
}

/// Loads certificate, keys and the log's filter again with each SIGHUP, which would else end the process: a
/// closed terminal must not stop a server.
#[cfg(unix)]
fn reload_on_hangup(source: SettingsSource, log: LogControl, reloader: Reloader) {
    use tokio::signal::unix::{SignalKind, signal};
    match signal(SignalKind::hangup()) {
        Ok(mut hangups) => {
            tokio::spawn(async move {
                while hangups.recv().await.is_some() {
                    tracing::info!(
                        "SIGHUP received: certificate, keys and log_filter are loaded again, other settings at the \
                         start only"
                    );
                    source.reload_filter(&log);
                    reloader.reload().await;
                }
            });
        }
        Err(error) => tracing::warn!(%error, "cannot listen for SIGHUP, which will end the server"),
    }
}
