//! Where a store is: in a folder, or in a database of a server.

use std::fmt;
use std::path::{Path, PathBuf};

use sqlx::postgres::PgConnectOptions;

use crate::domain::{Error, Result};

/// Where a store is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Location {
    /// In the file of a data folder.
    Folder(PathBuf),
    /// In a PostgreSQL database.
    Database(DatabaseUrl),
}

impl Location {
    /// The database if a URL is given, else the folder.
    ///
    /// # Errors
    /// As [`DatabaseUrl::new`].
    pub fn new(folder: &Path, url: Option<&str>) -> Result<Self> {
        match url {
            Some(url) => DatabaseUrl::new(url).map(Self::Database),
            None => Ok(Self::Folder(folder.to_owned())),
        }
    }
}

impl fmt::Display for Location {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder(folder) => write!(out, "the data folder {}", folder.display()),
            Self::Database(url) => write!(out, "the database {url}"),
        }
    }
}

/// URL of a PostgreSQL database: `postgres://user:password@host:port/database?sslmode=verify-full`. It is shown
/// without user, password and parameters.
#[derive(Clone, PartialEq, Eq)]
pub struct DatabaseUrl {
    url: String,
    shown: String,
}

impl DatabaseUrl {
    /// A URL that names a PostgreSQL database.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`](crate::domain::ErrorKind); the message does not repeat the URL.
    pub fn new(url: &str) -> Result<Self> {
        let refused = |why: &str| {
            Error::invalid(
                "database",
                format!("must be a URL like postgres://user@host:5432/sightfix: {why}"),
            )
        };
        if !["postgres://", "postgresql://"].iter().any(|scheme| url.starts_with(scheme)) {
            return Err(refused("it begins otherwise"));
        }
        // The library connects to one host, and would look for one of that name.
        let authority = url.split("://").nth(1).and_then(|rest| rest.split('/').next()).unwrap_or_default();
        let host = authority.rsplit('@').next().unwrap_or_default();
        let query = url.split_once('?').map_or("", |(_, query)| query);
        let of_query = query.split('&').filter_map(|pair| pair.strip_prefix("host="));
        if of_query.chain([host]).any(|host| host.contains(',') || host.to_ascii_lowercase().contains("%2c"))
        {
            return Err(refused(
                "it names several hosts; give one address that always leads to the primary, such as that of HAProxy or \
                 PgBouncer, a virtual address, or a name that a fail-over changes",
            ));
        }
        let options: PgConnectOptions = url.parse().map_err(|_| refused("it cannot be read"))?;
        let database = options.get_database().unwrap_or_else(|| options.get_username());
        let shown = format!("postgres://{}:{}/{database}", options.get_host(), options.get_port());
        Ok(Self { url: url.to_owned(), shown })
    }

    /// With its secrets.
    #[cfg(test)]
    pub(super) fn revealed(&self) -> &str {
        &self.url
    }

    pub(super) fn options(&self) -> Result<PgConnectOptions> {
        self.url.parse().map_err(|_| Error::fault("the URL of the database cannot be read"))
    }
}

impl fmt::Display for DatabaseUrl {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(&self.shown)
    }
}

impl fmt::Debug for DatabaseUrl {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, out)
    }
}
