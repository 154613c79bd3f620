//! The other ends of connections.

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::Duration;

use hyper::body::Bytes;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::harness::{TestServer, own_address};
use crate::tls::Authority;

/// A mosquitto of its own, which keeps sessions in memory; killed when dropped.
pub(crate) struct Broker {
    process: Child,
    pub(crate) port: u16,
    /// How its own clients reach it.
    client_arguments: Vec<String>,
    _folder: TempDir,
}

impl Broker {
    pub(crate) fn start() -> Self {
        Self::start_at(own_address().port())
    }

    pub(crate) fn start_at(port: u16) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        Self::start_in(folder, port, "", vec!["-h".to_owned(), "127.0.0.1".to_owned()])
    }

    /// One that is reached by TLS alone, with a certificate of the authority for `localhost`.
    pub(super) fn start_encrypted(authority: &Authority) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let (certificate, key) = authority.issue();
        let file = |name: &str, content: String| {
            let path = folder.path().join(name);
            std::fs::write(&path, content).expect("a file can be written");
            path.to_str().expect("text").to_owned()
        };
        let trusted = file("ca.pem", authority.certificate.pem());
        let settings = format!(
            "certfile {}\nkeyfile {}\n",
            file("certificate.pem", certificate.pem()),
            file("key.pem", key.serialize_pem())
        );
        let client_arguments = ["-h", "localhost", "--cafile", &trusted].map(str::to_owned).to_vec();
        Self::start_in(folder, own_address().port(), &settings, client_arguments)
    }

    fn start_in(folder: TempDir, port: u16, settings: &str, client_arguments: Vec<String>) -> Self {
        let path = folder.path().join("mosquitto.conf");
        // As the superuser it would become another user, who cannot read the folder.
        let text = format!("user root\nlistener {port} 127.0.0.1\nallow_anonymous true\n{settings}");
        std::fs::write(&path, text).expect("a file can be written");
        let mut command = Command::new("mosquitto");
        command.arg("-c").arg(&path).stdout(Stdio::null()).stderr(Stdio::null());
        let process = command.spawn().expect("mosquitto is installed");
        while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
            std::thread::sleep(Duration::from_millis(20));
        }
        Self { process, port, client_arguments, _folder: folder }
    }

    /// Where the server reaches it.
    pub(crate) fn address(&self) -> String {
        format!("mqtt://127.0.0.1:{}", self.port)
    }

    /// Publishes with QoS 1 by mosquitto's own client.
    pub(crate) fn publish(&self, topic: &str, message: &str) {
        let mut command = Command::new("mosquitto_pub");
        command.args(&self.client_arguments);
        command.args(["-p", &self.port.to_string(), "-q", "1", "-t", topic, "-s"]);
        let mut process = command.stdin(Stdio::piped()).spawn().expect("mosquitto-clients is installed");
        let mut input = process.stdin.take().expect("piped");
        input.write_all(message.as_bytes()).expect("it reads");
        drop(input);
        assert!(process.wait().expect("it ends").success());
    }

    /// Publishes each line as a message with QoS 1, in their order.
    pub(crate) fn publish_lines(&self, topic: &str, lines: impl Iterator<Item = String>) {
        let mut command = Command::new("mosquitto_pub");
        command.args(&self.client_arguments);
        command.args(["-p", &self.port.to_string(), "-q", "1", "-t", topic, "-l"]);
        let mut process = command.stdin(Stdio::piped()).spawn().expect("mosquitto-clients is installed");
        let mut input = process.stdin.take().expect("piped");
        for line in lines {
            writeln!(input, "{line}").expect("it reads");
        }
        drop(input);
        assert!(process.wait().expect("it ends").success());
    }

    /// The retained message of a topic; empty if there is none.
    pub(crate) fn retained(&self, topic: &str) -> String {
        let mut command = Command::new("mosquitto_sub");
        command.args(&self.client_arguments);
        command.args(["-p", &self.port.to_string(), "-t", topic, "-C", "1", "-W", "1", "--retained-only"]);
        let output = command.output().expect("mosquitto-clients is installed");
        String::from_utf8(output.stdout).expect("text").trim_end().to_owned()
    }

    fn subscriber(&self, topic: &str) -> Command {
        let mut command = Command::new("mosquitto_sub");
        command.args(&self.client_arguments);
        command.args(["-p", &self.port.to_string(), "-V", "5", "-q", "1", "-t", topic]);
        command.args(["-i", "subscriber", "-c", "-x", "600"]);
        command
    }

    /// Has the broker keep the messages of a topic from now on, in a session of mosquitto's own client.
    pub(crate) fn subscribe(&self, topic: &str) {
        let status = self.subscriber(topic).arg("-E").status().expect("mosquitto-clients is installed");
        assert!(status.success());
    }

    /// The first messages of that session, as lines of topic and payload.
    pub(crate) fn received(&self, topic: &str, count: u32) -> String {
        let output = self.subscriber(topic).args(["-v", "-C", &count.to_string()]).output();
        String::from_utf8(output.expect("mosquitto-clients is installed").stdout).expect("text")
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A camera's metadata on GStreamer's RTSP server; killed when dropped.
pub(crate) struct RtspCamera {
    process: Child,
    documents: ChildStdin,
    pub(crate) port: u16,
}

impl RtspCamera {
    pub(crate) fn start() -> Self {
        Self::start_at(own_address().port(), &[])
    }

    /// One that asks for digest authentication if a name and a password are given.
    pub(super) fn start_at(port: u16, user: &[&str]) -> Self {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/it/outside/rtsp_server.py");
        // Debian's Python has its bindings.
        let mut command = Command::new("/usr/bin/python3");
        command.args([script, &port.to_string()]).args(user).stderr(Stdio::null());
        let mut process =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("python3-gi is installed");
        let mut ready = String::new();
        let printed = process.stdout.take().expect("piped");
        BufReader::new(printed).read_line(&mut ready).expect("it writes");
        assert_eq!(ready, "ready\n");
        let documents = process.stdin.take().expect("piped");
        Self { process, documents, port }
    }

    pub(crate) fn address(&self) -> String {
        format!("rtsp://127.0.0.1:{}/onvif/metadata", self.port)
    }

    /// Sends an XML document without line breaks to those who play the stream.
    pub(crate) fn send(&mut self, document: &str) {
        writeln!(self.documents, "{document}").expect("it reads");
    }
}

impl Drop for RtspCamera {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Waits until something is true of a connection, and returns it.
pub(crate) async fn connection_when(
    server: &TestServer,
    id: &str,
    is_wanted: impl Fn(&Value) -> bool,
) -> Value {
    let mut connection = Value::Null;
    for _ in 0..3_000 {
        connection = server.get(&format!("/v1/connections/{id}")).await.expect(200).json();
        if is_wanted(&connection["status"]) {
            return connection;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("the status does not come: {connection}")
}

/// A camera `gate` of 1280 x 720 px.
pub(crate) async fn create_gate(server: &TestServer) {
    let camera = json!({"id": "gate", "image_size": {"width_px": 1280, "height_px": 720}});
    server.post("/v1/cameras", &camera).await.expect(201);
}

/// Sends a fix of a target of the camera `gate`; stores samples if asked to.
pub(crate) async fn send_fix(
    server: &TestServer,
    target: &str,
    time: &str,
    longitude_deg: f64,
    stores: bool,
) {
    send_fix_of(server, json!({"target_id": target}), time, longitude_deg, stores).await;
}

/// The same of a target or a receiver.
pub(crate) async fn send_fix_of(
    server: &TestServer,
    mut fix: Value,
    time: &str,
    longitude_deg: f64,
    stores: bool,
) {
    fix["time"] = json!(time);
    fix["fix"] = json!({"longitude_deg": longitude_deg, "latitude_deg": 30.628, "sigma_m": 1.5});
    let fix = json!({"observations": [fix]});
    let path = format!("/v1/cameras/gate/tracks?store_samples={stores}");
    server.post(&path, &fix).await.expect(200);
}

/// Changes a connection, whatever its revision.
pub(crate) async fn patch(server: &TestServer, id: &str, change: &Value) -> crate::harness::Answer {
    let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
    server.send("PATCH", &format!("/v1/connections/{id}"), &headers, Bytes::from(change.to_string())).await
}
