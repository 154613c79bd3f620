//! Runs the real binary: a server with its own data folder on a free port, or a command.

use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::{Arc, Mutex};

use http_body_util::{BodyExt as _, Full};
use hyper::body::{Bytes, Incoming};
use hyper::{HeaderMap, Request, Response, StatusCode};
use hyper_util::client::legacy::Client;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioExecutor;
use serde_json::Value;
use sightfix::grpc::proto;
use tempfile::TempDir;
use tokio::net::{TcpSocket, TcpStream};
use tonic::transport::{Channel, Endpoint};

/// A command of the binary, without arguments.
pub(crate) fn sightfix() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sightfix"));
    for setting in ["SIGHTFIX_DATA", "SIGHTFIX_DATABASE", "SIGHTFIX_LISTEN", "SIGHTFIX_TEST_POSTGRES"] {
        command.env_remove(setting);
    }
    command.current_dir(std::env::temp_dir());
    command
}

/// Where the store of a test is: in its folder, or, where `SIGHTFIX_TEST_POSTGRES` is the URL of a server's database, in
/// a database of that server that belongs to the folder.
pub(crate) fn store_arguments(folder: &Path) -> [String; 2] {
    match std::env::var("SIGHTFIX_TEST_POSTGRES") {
        Ok(server) => ["--database".to_owned(), database_of(&server, folder)],
        Err(_) => ["--data".to_owned(), folder.to_str().expect("UTF-8").to_owned()],
    }
}

/// URL of the database that belongs to a folder; created at its first use.
fn database_of(server: &str, folder: &Path) -> String {
    let name: String = folder.to_string_lossy().chars().filter(char::is_ascii_alphanumeric).collect();
    let create = format!("CREATE DATABASE \"{name}\"");
    let created = Command::new("psql").args([server, "-qc", &create]).output().expect("psql runs");
    let errors = String::from_utf8_lossy(&created.stderr).into_owned();
    assert!(created.status.success() || errors.contains("already exists"), "{errors}");
    let (server, _) = server.rsplit_once('/').expect("a URL with a database");
    format!("{server}/{name}")
}

/// Runs the binary to completion; returns standard output.
pub(crate) fn run(arguments: &[&str]) -> String {
    let mut arguments: Vec<String> = arguments.iter().map(|&argument| argument.to_owned()).collect();
    if let Some(at) = arguments.iter().position(|argument| argument == "--data") {
        let store = store_arguments(Path::new(&arguments[at + 1]));
        arguments[at..at + 2].clone_from_slice(&store);
    }
    let output = sightfix().args(&arguments).output().expect("the binary runs");
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {errors}");
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// A running server; killed when dropped.
pub(crate) struct TestServer {
    process: Child,
    pub(crate) address: SocketAddr,
    client: Client<HttpConnector, Full<Bytes>>,
    log: Arc<Mutex<Vec<Value>>>,
}

/// A complete response.
pub(crate) struct Answer {
    pub(crate) status: StatusCode,
    pub(crate) headers: HeaderMap,
    pub(crate) body: Bytes,
}

impl Answer {
    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }

    pub(crate) fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub(crate) fn header(&self, name: &str) -> &str {
        self.headers.get(name).unwrap_or_else(|| panic!("no header {name}")).to_str().expect("visible ASCII")
    }

    /// Asserts the status and returns the response.
    #[track_caller]
    pub(crate) fn expect(self, status: u16) -> Self {
        assert_eq!(self.status.as_u16(), status, "{}", self.text());
        self
    }
}

impl TestServer {
    /// Starts a server on a data folder.
    pub(crate) fn start(folder: &Path) -> Self {
        Self::start_with(folder, &[])
    }

    /// Starts a server with settings from the environment.
    pub(crate) fn start_with(folder: &Path, settings: &[(&str, &str)]) -> Self {
        let mut command = sightfix();
        command.args(["serve", "--listen", "127.0.0.1:0"]).args(store_arguments(folder));
        // With PostgreSQL no data folder is stated, in which the archive would be.
        if std::env::var_os("SIGHTFIX_TEST_POSTGRES").is_some() {
            command.env("SIGHTFIX_ARCHIVE", folder.join("archive"));
        }
        command.envs(settings.iter().copied()).stdout(Stdio::null());
        Self::run(command)
    }

    /// Starts a server at an address of [`own_address`], so that it can be restarted there.
    pub(crate) fn start_at(folder: &Path, address: SocketAddr) -> Self {
        let mut command = sightfix();
        command.args(["serve", "--listen", &address.to_string()]).args(store_arguments(folder));
        command.stdout(Stdio::null());
        Self::run(command)
    }

    /// Starts the demonstration on an empty folder; returns what it prints once it is ready.
    pub(crate) fn demonstrate(folder: &Path) -> (Self, String) {
        let mut command = sightfix();
        command.args(["serve", "--demo", "--listen", "127.0.0.1:0"]).args(store_arguments(folder));
        command.stdout(Stdio::piped());
        let mut server = Self::run(command);
        let lines = BufReader::new(server.process.stdout.take().expect("piped")).lines();
        let mut printed = String::new();
        for line in lines.map_while(Result::ok) {
            printed.push_str(&line);
            printed.push('\n');
            if line.trim_end().ends_with("/docs") {
                break;
            }
        }
        (server, printed)
    }

    /// Starts a command that ends up as a server, and waits until it listens.
    pub(crate) fn run(command: Command) -> Self {
        Self::try_run(command).unwrap_or_else(|log| panic!("the server does not listen: {log:?}"))
    }

    /// The same; the log of a process that ends before it listens.
    pub(crate) fn try_run(mut command: Command) -> Result<Self, Vec<Value>> {
        let command = command.env("SIGHTFIX_LOG_FORMAT", "json").stderr(Stdio::piped());
        let mut process = command.spawn().expect("the binary starts");
        let mut lines = BufReader::new(process.stderr.take().expect("piped")).lines();
        let mut address = None;
        let log = Arc::new(Mutex::new(Vec::new()));
        for line in lines.by_ref() {
            let entry = log_entry(line.expect("UTF-8"));
            if let Some(text) = entry["address"].as_str() {
                address = Some(text.parse().expect("an address"));
                break;
            }
            log.lock().expect("no panic").push(entry);
        }
        // Keep reading: a full pipe would block the server.
        let rest = log.clone();
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                rest.lock().expect("no panic").push(log_entry(line));
            }
        });
        let Some(address) = address else {
            process.wait().expect("the process has ended");
            return Err(std::mem::take(&mut log.lock().expect("no panic")));
        };
        let client = Client::builder(TokioExecutor::new()).build_http();
        Ok(Self { process, address, client, log })
    }

    /// Entries of the server's log, as text, that contain a text.
    pub(crate) fn log_lines(&self, text: &str) -> Vec<String> {
        let log = self.log.lock().expect("no panic");
        log.iter().map(Value::to_string).filter(|line| line.contains(text)).collect()
    }

    /// Waits until the log has an entry of which this is true, and returns it.
    pub(crate) async fn logged(&self, is_wanted: impl Fn(&Value) -> bool) -> Value {
        for _ in 0..2_400 {
            let found = self.log.lock().expect("no panic").iter().find(|entry| is_wanted(entry)).cloned();
            match found {
                Some(entry) => return entry,
                None => tokio::time::sleep(std::time::Duration::from_millis(50)).await,
            }
        }
        panic!("the server's log has no such entry: {:?}", self.log.lock().expect("no panic"))
    }

    /// Where gRPC clients connect.
    pub(crate) fn endpoint(&self) -> Endpoint {
        Endpoint::from_shared(format!("http://{}", self.address)).expect("an address")
    }

    /// A connection of a gRPC client.
    pub(crate) async fn channel(&self) -> Channel {
        self.endpoint().connect().await.expect("a connection")
    }

    /// Process id of the server.
    pub(crate) fn pid(&self) -> u32 {
        self.process.id()
    }

    /// Sends a signal, by the name that `kill` knows.
    pub(crate) fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([name, &self.pid().to_string()]).status();
        assert!(sent.expect("kill runs").success());
        // A thread stops when it runs next: until all have, the process goes on.
        while name == "-STOP" && !self.is_stopped() {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }

    /// True if all threads of the process are stopped.
    fn is_stopped(&self) -> bool {
        let threads = std::fs::read_dir(format!("/proc/{}/task", self.pid())).expect("it is there");
        threads.flatten().all(|thread| {
            let stat = std::fs::read_to_string(thread.path().join("stat")).unwrap_or_default();
            stat.rsplit_once(") ").is_none_or(|(_, rest)| rest.starts_with('T'))
        })
    }

    /// Kills the process with SIGKILL.
    pub(crate) fn kill(mut self) {
        self.kill_now();
    }

    /// The same; its log can still be read. Nothing happens if it has ended.
    pub(crate) fn kill_now(&mut self) {
        self.process.kill().expect("the server can be killed");
        self.process.wait().expect("the server is gone");
    }

    /// True if the process has ended by itself.
    pub(crate) fn has_ended(&mut self) -> bool {
        self.process.try_wait().expect("the process can be asked").is_some()
    }

    /// Sends SIGTERM and waits; returns whether the server exited successfully.
    pub(crate) fn terminate(mut self) -> bool {
        self.signal("-TERM");
        self.process.wait().expect("the server ends").success()
    }

    /// Sends a request; returns the response with an unread body.
    pub(crate) async fn open(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: impl Into<Bytes>,
    ) -> Response<Incoming> {
        let mut request = Request::builder().method(method).uri(format!("http://{}{path}", self.address));
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let request = request.body(Full::new(body.into())).expect("a request");
        self.client.request(request).await.expect("an answer")
    }

    /// Sends a request and reads the complete response.
    pub(crate) async fn send(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: impl Into<Bytes>,
    ) -> Answer {
        let (head, body) = self.open(method, path, headers, body).await.into_parts();
        let body = body.collect().await.expect("a whole body").to_bytes();
        Answer { status: head.status, headers: head.headers, body }
    }

    pub(crate) async fn get(&self, path: &str) -> Answer {
        self.send("GET", path, &[], Bytes::new()).await
    }

    pub(crate) async fn post(&self, path: &str, body: &Value) -> Answer {
        self.send("POST", path, &[("content-type", "application/json")], body.to_string()).await
    }

    /// Starts a training run and waits until it has ended; returns its final state.
    pub(crate) async fn train(&self, camera: &str, request: &Value) -> Value {
        let started = self.post(&format!("/v1/cameras/{camera}/training-runs"), request).await.expect(202);
        let path = started.header("location").to_owned();
        loop {
            let run = self.get(&path).await.expect(200).json();
            if !matches!(run["state"].as_str(), Some("queued" | "running" | "cancelling")) {
                return run;
            }
            tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        }
    }
}

/// A line of the log. The message of a panic, and the reason of a start that fails, are no JSON.
fn log_entry(line: String) -> Value {
    serde_json::from_str(&line).unwrap_or(Value::String(line))
}

impl Drop for TestServer {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// An address for a sequence of servers. It is below the range of ephemeral ports, so that no client
/// socket takes it while no server is running.
pub(crate) fn own_address() -> SocketAddr {
    static GIVEN: AtomicU16 = AtomicU16::new(0);
    let first = 20_000 + (std::process::id() % 10_000) as u16;
    loop {
        let port = first + GIVEN.fetch_add(1, Ordering::Relaxed);
        let address = SocketAddr::from(([127, 0, 0, 1], port));
        if std::net::TcpListener::bind(address).is_ok() {
            return address;
        }
    }
}

/// Connects to a server from another loopback address than its other clients, which makes it another
/// client to limits that count by address.
pub(crate) async fn connect_from(ip: [u8; 4], server: SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().expect("a socket");
    socket.bind(SocketAddr::from((ip, 0))).expect("all of 127.0.0.0/8 is this machine");
    socket.connect(server).await.expect("the server listens")
}

/// A message of an import stream: one sample of target `a` for camera `c`.
pub(crate) fn import_message() -> proto::ImportSamplesRequest {
    let side = Some(20.0);
    let sample = proto::Sample {
        time: Some(prost_types::Timestamp { seconds: 1_600_000_000, nanos: 0 }),
        target_id: "a".to_owned(),
        bounding_box: Some(proto::BoundingBox {
            left_px: side,
            top_px: side,
            width_px: side,
            height_px: side,
        }),
        fix: Some(Box::new(proto::Fix {
            longitude_deg: Some(103.9),
            latitude_deg: Some(30.6),
            sigma_m: None,
        })),
        ..proto::Sample::default()
    };
    proto::ImportSamplesRequest { camera_id: "c".to_owned(), samples: vec![sample], ..Default::default() }
}

pub(crate) fn data_folder() -> TempDir {
    tempfile::tempdir().expect("a folder")
}

/// Path of a file or folder of the real recordings. Tests that use it are ignored by default; their names contain
/// `shared`, so that a filter selects exactly them.
pub(crate) fn shared(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    assert!(path.exists(), "{} does not exist", path.display());
    path
}

/// Samples of a small simulated square, as CSV.
pub(crate) fn simulated_csv() -> String {
    use sightfix::exchange::{Format, write_samples};
    use sightfix::simulation::{Options, simulate};
    let mut csv = Vec::new();
    let samples = simulate(&Options::demo()).training_samples();
    write_samples(&mut csv, Format::Csv, &samples).expect("memory can be written");
    String::from_utf8(csv).expect("UTF-8")
}

/// The time now.
pub(crate) fn now() -> jiff::Timestamp {
    #[expect(clippy::disallowed_methods, reason = "the server reads the wall clock, too")]
    jiff::Timestamp::now()
}
