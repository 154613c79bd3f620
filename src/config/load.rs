//! Reads the settings of file, environment and flags, and checks them.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use super::origin::url_origin;
use super::secret::Secret;
use super::{Config, NodeRole};

/// Values from the command line, which win over all others.
#[derive(Debug, Clone, Default)]
pub struct Overrides {
    /// `--data`
    pub data: Option<PathBuf>,
    /// `--database`
    pub database: Option<Secret>,
    /// `--listen`
    pub listen: Option<SocketAddr>,
    /// `--advertise`
    pub advertised_url: Option<String>,
    /// `--insecure`
    pub insecure: bool,
    /// `--admin-key-file`
    pub admin_key_file: Option<PathBuf>,
    /// `--tls-cert`
    pub tls_certificate: Option<PathBuf>,
    /// `--tls-key`
    pub tls_key: Option<PathBuf>,
    /// `--tls-client-ca`
    pub tls_client_ca: Option<PathBuf>,
}

impl Config {
    /// Reads file and environment over the defaults, and lays the flags on top.
    ///
    /// Without a path, `sightfix.toml` in the working folder is read if it is there. Nested settings
    /// are set by two underscores: `SIGHTFIX_LIMITS__BODY_BYTES=65536`.
    ///
    /// # Errors
    /// Names the file or variable with a value that cannot be used, and unknown settings.
    pub fn load(file: Option<&Path>, overrides: Overrides) -> anyhow::Result<Self> {
        let source = match file {
            Some(path) => config::File::from(path).required(true),
            None => config::File::new("sightfix.toml", config::FileFormat::Toml).required(false),
        };
        let environment = config::Environment::with_prefix("SIGHTFIX")
            .prefix_separator("_")
            .separator("__")
            .list_separator(",")
            .with_list_parse_key("allowed_hosts")
            .with_list_parse_key("cors_origins")
            .with_list_parse_key("trusted_proxies")
            .with_list_parse_key("serial_devices")
            .with_list_parse_key("tls.client_camera_ids")
            .with_list_parse_key("openid.scopes")
            .with_list_parse_key("openid.admins")
            .with_list_parse_key("openid.operators")
            .with_list_parse_key("openid.viewers")
            .try_parsing(true);
        let mut loaded: Self = config::Config::builder()
            .add_source(source)
            .add_source(environment)
            .build()
            .and_then(config::Config::try_deserialize)
            .context("cannot read the settings")?;
        if let Some(data) = overrides.data {
            loaded.data = data;
            loaded.database = None;
        }
        if overrides.database.is_some() {
            loaded.database = overrides.database;
        }
        if let Some(listen) = overrides.listen {
            loaded.listen = listen;
        }
        if overrides.advertised_url.is_some() {
            loaded.advertised_url = overrides.advertised_url;
        }
        for (setting, flag) in [
            (&mut loaded.admin_key_file, overrides.admin_key_file),
            (&mut loaded.tls.certificate, overrides.tls_certificate),
            (&mut loaded.tls.key, overrides.tls_key),
            (&mut loaded.tls.client_ca, overrides.tls_client_ca),
        ] {
            if flag.is_some() {
                *setting = flag;
            }
        }
        loaded.insecure |= overrides.insecure;
        loaded.check()?;
        Ok(loaded)
    }

    /// The secret of the administrator's key, from the setting itself or the file that it names.
    ///
    /// # Errors
    /// Names the file that cannot be read.
    pub fn admin_key(&self) -> anyhow::Result<Option<Secret>> {
        let Some(path) = &self.admin_key_file else { return Ok(self.admin_key.clone()) };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the admin key from {}", path.display()))?;
        Ok(Some(Secret(text.trim().to_owned())))
    }

    fn check(&self) -> anyhow::Result<()> {
        let limits = &self.limits;
        anyhow::ensure!(
            self.admin_key.is_none() || self.admin_key_file.is_none(),
            "give admin_key or admin_key_file, not both"
        );
        anyhow::ensure!(
            self.role == NodeRole::Both || self.database.is_some(),
            "role = \"serve\" and role = \"train\" need the setting database: a data folder has one server"
        );
        anyhow::ensure!(self.node_lease_s >= 2, "node_lease_s must be at least 2");
        if let Some(url) = &self.advertised_url {
            anyhow::ensure!(
                url_origin(url) == Some(url.as_str()),
                "advertised_url must be like https://node-1.example.org:8443, without a path; `{url}` is not"
            );
        }
        self.tls.certificate_and_key()?;
        self.tls.client_scope()?;
        self.openid.check()?;
        for origin in &self.cors_origins {
            anyhow::ensure!(
                url_origin(origin) == Some(origin.as_str()),
                "cors_origins must be origins like https://maps.example.org, without a path; `{origin}` is none"
            );
        }
        anyhow::ensure!(limits.keys >= 1, "limits.keys must be at least 1");
        self.console.check()?;
        anyhow::ensure!(limits.pairings >= 1, "limits.pairings must be at least 1");
        anyhow::ensure!(
            limits.reserved_requests < limits.requests,
            "limits.reserved_requests must be below limits.requests"
        );
        anyhow::ensure!(
            limits.client_share > 0.0 && limits.client_share <= 1.0,
            "limits.client_share must be above 0 and at most 1"
        );
        for (name, seconds) in [
            ("header_s", limits.header_s),
            ("idle_s", limits.idle_s),
            ("body_grace_s", limits.body_grace_s),
            ("drain_s", limits.drain_s),
        ] {
            anyhow::ensure!(seconds >= 1, "limits.{name} must be at least 1");
        }
        anyhow::ensure!(limits.control_frames_per_s >= 1, "limits.control_frames_per_s must be at least 1");
        for (name, workers) in [("training", &self.training), ("evaluation", &self.evaluation)] {
            anyhow::ensure!(workers.workers >= 1, "{name}.workers must be at least 1");
            anyhow::ensure!(workers.lease_s >= 3, "{name}.lease_s must be at least 3");
        }
        for (name, limit) in [
            ("connection_message_bytes", limits.connection_message_bytes),
            ("connection_queue", limits.connection_queue),
            ("connection_unsettled", limits.connection_unsettled),
            ("connection_queue_bytes", limits.connection_queue_bytes),
            ("connection_batch_bytes", limits.connection_batch_bytes),
            ("connection_clients", limits.connection_clients),
            ("export_files", limits.export_files),
            ("site_queue", limits.site_queue),
            ("site_frames", limits.site_frames),
            ("boxes_per_frame", limits.boxes_per_frame),
            ("tracks_per_site", limits.tracks_per_site),
            ("site_events", limits.site_events),
        ] {
            anyhow::ensure!(limit >= 1, "limits.{name} must be at least 1");
        }
        anyhow::ensure!(self.limits.page_items >= 1, "limits.page_items must be at least 1");
        // One active version and the one that a training run adds.
        anyhow::ensure!(self.limits.models_per_camera >= 2, "limits.models_per_camera must be at least 2");
        Ok(())
    }
}
