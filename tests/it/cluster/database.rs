//! A PostgreSQL server of a test's own, which may be killed and whose disk may be full, and a way to it that may be cut.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tempfile::TempDir;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

use crate::harness::own_address;

/// Size of the disk where it may be full: a new database, its log, and room for the test.
const DISK: &str = "size=96m";

/// A running server; ended when dropped.
pub(super) struct Database {
    process: Child,
    binaries: PathBuf,
    port: u16,
    folder: TempDir,
    is_mounted: bool,
}

impl Database {
    /// Starts a server in a folder; on a small disk of its own where this process may mount one.
    pub(super) async fn start() -> Self {
        let settings =
            ["-U", "postgres", "-E", "UTF8", "--locale=C.UTF-8", "-A", "trust", "-N", "--wal-segsize=1"];
        Self::create("initdb", &settings).await
    }

    /// A standby of this server, which has everything that is acknowledged up to now and receives what follows without
    /// the primary waiting for it.
    pub(super) async fn standby(&self) -> Self {
        let (port, flush) = (self.port.to_string(), "SELECT pg_current_wal_flush_lsn()");
        let from =
            ["-h", "127.0.0.1", "-p", &port, "-U", "postgres", "-R", "-X", "stream", "-c", "fast", "-N"];
        let standby = Self::create("pg_basebackup", &from).await;
        let position = self.sql(flush).expect("the primary answers");
        standby.until(&format!("SELECT pg_last_wal_replay_lsn() >= '{position}'")).await;
        standby
    }

    /// Receives nothing more from its primary.
    pub(super) async fn stop_receiving(&self) {
        self.sql("ALTER SYSTEM SET primary_conninfo = ''").expect("set");
        self.sql("SELECT pg_reload_conf()").expect("loaded");
        self.until("SELECT count(*) = 0 FROM pg_stat_wal_receiver").await;
    }

    /// Becomes a primary.
    pub(super) async fn promote(&self) {
        self.sql("SELECT pg_promote()").expect("promoted");
        self.until("SELECT NOT pg_is_in_recovery()").await;
    }

    /// Waits until a statement gives true.
    async fn until(&self, statement: &str) {
        for _ in 0..400 {
            if self.sql(statement).is_ok_and(|answer| answer == "t") {
                return;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        panic!("{statement}: {}", self.log());
    }

    /// Makes the files of a server by one of PostgreSQL's programs, and starts it.
    async fn create(program: &str, arguments: &[&str]) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let is_mounted = is_superuser();
        if is_mounted {
            let mut mount = Command::new("mount");
            mount.args(["-t", "tmpfs", "-o", DISK, "tmpfs"]).arg(folder.path());
            assert!(mount.status().expect("mount runs").success(), "the superuser may mount");
            let owner = Command::new("chown").arg("nobody").arg(folder.path()).status();
            assert!(owner.expect("chown runs").success());
        }
        let (binaries, port) = (binaries(), own_address().port());
        let mut create = as_owner(&binaries.join(program));
        create.arg("-D").arg(folder.path().join("data")).current_dir(folder.path()).args(arguments);
        let created = create.output().expect("the program runs");
        assert!(created.status.success(), "{}", String::from_utf8_lossy(&created.stderr));
        let process = run(&binaries, folder.path(), port);
        let mut database = Self { process, binaries, port, folder, is_mounted };
        database.keep_running().await;
        database
    }

    /// URL of its database, at its own port or that of a proxy.
    pub(super) fn url(&self, port: Option<u16>) -> String {
        format!("postgres://postgres@127.0.0.1:{}/postgres", port.unwrap_or(self.port))
    }

    pub(super) fn address(&self) -> SocketAddr {
        SocketAddr::from(([127, 0, 0, 1], self.port))
    }

    /// The output of a statement, once the server answers.
    pub(super) fn sql(&self, statement: &str) -> Result<String, String> {
        let output = Command::new("psql").args([&self.url(None), "-Atqc", statement]).output();
        let output = output.expect("psql runs");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_owned();
        if output.status.success() { Ok(text(&output.stdout)) } else { Err(text(&output.stderr)) }
    }

    /// A number that a statement gives.
    pub(super) fn number(&self, statement: &str) -> u64 {
        self.sql(statement).expect("the server answers").parse().expect("a number")
    }

    /// Kills the server; its own processes follow.
    pub(super) fn kill(&mut self) {
        self.process.kill().expect("it can be killed");
        self.process.wait().expect("it is gone");
    }

    /// Waits until the server answers; starts it again if it has ended.
    pub(super) async fn keep_running(&mut self) {
        for _ in 0..1_200 {
            if self.process.try_wait().expect("it can be asked").is_some() {
                // Refused as long as a process of the one before is alive.
                self.process = run(&self.binaries, self.folder.path(), self.port);
            }
            if self.sql("SELECT 1").is_ok() {
                return;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        panic!("the database does not start: {}", self.log());
    }

    pub(super) const fn has_own_disk(&self) -> bool {
        self.is_mounted
    }

    /// Leaves no byte of its disk.
    pub(super) fn fill_disk(&self) {
        let mut fill = Command::new("dd");
        fill.arg("if=/dev/zero")
            .arg(format!("of={}", self.ballast().display()))
            .args(["bs=4096", "status=none"]);
        // It ends when there is no space.
        let filled = fill.stderr(Stdio::null()).status().expect("dd runs");
        assert!(self.is_mounted && !filled.success(), "the disk has an end");
    }

    pub(super) fn free_disk(&self) {
        std::fs::remove_file(self.ballast()).expect("it can be removed");
    }

    fn ballast(&self) -> PathBuf {
        self.folder.path().join("ballast")
    }

    fn log(&self) -> String {
        let log = std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default();
        log.lines().rev().take(20).collect::<Vec<_>>().join("\n")
    }
}

impl Drop for Database {
    fn drop(&mut self) {
        // At once, with all of its processes.
        let _ = Command::new("kill").args(["-QUIT", &self.process.id().to_string()]).status();
        let _ = self.process.wait();
        if self.is_mounted {
            let _ = Command::new("umount").arg("--lazy").arg(self.folder.path()).status();
        }
    }
}

fn run(binaries: &Path, folder: &Path, port: u16) -> Child {
    let log = std::fs::OpenOptions::new().create(true).append(true).open(folder.join("log"));
    let log = log.map_or_else(|_| Stdio::null(), Stdio::from);
    let mut command = as_owner(&binaries.join("postgres"));
    command.arg("-D").arg(folder.join("data")).args(["-p", &port.to_string()]).current_dir(folder);
    for setting in [
        "listen_addresses=127.0.0.1",
        "unix_socket_directories=",
        "max_connections=100",
        "shared_buffers=16MB",
        "min_wal_size=2MB",
        "max_wal_size=8MB",
        // A kill leaves what was written; the power of this machine is not cut.
        "fsync=off",
    ] {
        command.args(["-c", setting]);
    }
    command.stdout(Stdio::null()).stderr(log).spawn().expect("postgres runs")
}

/// A command that PostgreSQL refuses to run as the superuser.
fn as_owner(program: &Path) -> Command {
    if !is_superuser() {
        return Command::new(program);
    }
    let mut command = Command::new("setpriv");
    command.args(["--reuid", "nobody", "--regid", "nogroup", "--clear-groups"]).arg(program);
    command
}

fn is_superuser() -> bool {
    let output = Command::new("id").arg("-u").output().expect("id runs");
    output.stdout == b"0\n"
}

/// The programs of the newest version that Debian has installed.
fn binaries() -> PathBuf {
    let versions = std::fs::read_dir("/usr/lib/postgresql").expect("PostgreSQL is installed");
    let mut versions: Vec<PathBuf> = versions.map(|entry| entry.expect("a folder").path()).collect();
    versions.sort();
    versions.pop().expect("a version").join("bin")
}

/// The treatment of bytes that are sent over a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LinkState {
    /// It comes through, to this server.
    To(SocketAddr),
    /// It stays on the way, and nothing is closed.
    Cut,
    /// Every connection is accepted and closed, as by a balancer without a server.
    Closing,
}

/// A way to the database which may be cut, closed or led to another server.
pub(super) struct Link {
    pub(super) port: u16,
    target: SocketAddr,
    state: watch::Sender<LinkState>,
}

impl Link {
    pub(super) async fn to(target: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let port = listener.local_addr().expect("an address").port();
        let (state, current) = watch::channel(LinkState::To(target));
        tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                tokio::spawn(forward(client, current.clone()));
            }
        });
        Self { port, target, state }
    }

    pub(super) fn cut(&self) {
        self.state.send_replace(LinkState::Cut);
    }

    pub(super) fn close(&self) {
        self.state.send_replace(LinkState::Closing);
    }

    pub(super) fn mend(&self) {
        self.state.send_replace(LinkState::To(self.target));
    }

    /// Ends all connections; new ones lead to another server.
    pub(super) fn lead_to(&mut self, target: SocketAddr) {
        self.close();
        self.target = target;
        self.mend();
    }
}

/// Passes on what is sent as long as the way leads to one server.
async fn forward(client: TcpStream, mut state: watch::Receiver<LinkState>) {
    let Ok(begun) = state.wait_for(|state| *state != LinkState::Cut).await.map(|state| *state) else {
        return;
    };
    let LinkState::To(target) = begun else { return };
    let Ok(server) = TcpStream::connect(target).await else { return };
    let (mut from_client, mut to_client) = client.into_split();
    let (mut from_server, mut to_server) = server.into_split();
    let mut until = state.clone();
    tokio::select! {
        () = copy(&mut from_client, &mut to_server, state.clone(), begun) => {}
        () = copy(&mut from_server, &mut to_client, state, begun) => {}
        _ = until.wait_for(|state| *state != begun && *state != LinkState::Cut) => {}
    }
}

async fn copy(
    from: &mut tokio::net::tcp::OwnedReadHalf,
    to: &mut tokio::net::tcp::OwnedWriteHalf,
    mut state: watch::Receiver<LinkState>,
    begun: LinkState,
) {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    let mut bytes = vec![0; 65_536];
    while let Ok(count) = from.read(&mut bytes).await {
        if count == 0
            || state.wait_for(|state| *state == begun).await.is_err()
            || to.write_all(&bytes[..count]).await.is_err()
        {
            return;
        }
    }
}
