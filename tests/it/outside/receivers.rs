//! Receivers whose fixes come live.

use rustix::pty::OpenptFlags;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream, UdpSocket};

use super::peers::{connection_when, create_gate};
use crate::harness::{TestServer, data_folder, now, own_address};

/// GGA and RMC of now, at 30.628 degrees north, 103.98678 degrees east.
fn sentences() -> String {
    let now = now();
    let time = now.strftime("%H%M%S.00");
    let date = now.strftime("%d%m%y");
    let sentence = |body: String| {
        let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        format!("${body}*{checksum:02X}\r\n")
    };
    let rmc = sentence(format!("GPRMC,{time},A,3037.6800,N,10359.2068,E,0.5,054.7,{date},020.3,E"));
    let gga = sentence(format!("GPGGA,{time},3037.6800,N,10359.2068,E,1,08,0.9,545.4,M,46.9,M,,"));
    rmc + &gga
}

async fn start(source: Value) -> (TestServer, tempfile::TempDir) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    server.post("/v1/connections", &json!({"id": "receiver", "source": source})).await.expect(201);
    (server, folder)
}

async fn assert_tracked(server: &TestServer, target: &str) {
    let tracks = server.get("/v1/cameras/gate/tracks").await.expect(200).json();
    let track = tracks["features"]
        .as_array()
        .expect("features")
        .iter()
        .find(|it| it["properties"]["target_id"] == target);
    let position = &track.unwrap_or_else(|| panic!("{tracks}"))["geometry"]["coordinates"];
    let near =
        |index: usize, degrees: f64| (position[index].as_f64().expect("a number") - degrees).abs() < 1e-6;
    assert!(near(0, 103.986_78) && near(1, 30.628), "{position}");
}

#[tokio::test]
async fn nmea_over_tcp_feeds_the_track_of_the_connections_receiver() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let (server, _folder) = start(json!({
        "address": format!("tcp://{address}"), "format": "nmea", "camera_ids": ["gate"], "receiver_id": "boat",
    }))
    .await;
    let (mut stream, _) = listener.accept().await.expect("the server connects");
    // A line in pieces, one that is no sentence, one that is too long.
    let sentences = sentences();
    let (first, rest) = sentences.split_at(20);
    stream.write_all(first.as_bytes()).await.expect("written");
    tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    stream.write_all(rest.as_bytes()).await.expect("written");
    stream.write_all(b"noise\r\n").await.expect("written");
    stream.write_all(&vec![b'x'; 3 << 20]).await.expect("written");
    stream.write_all(b"\r\n").await.expect("written");
    stream.write_all(sentences.as_bytes()).await.expect("written");
    let connection = connection_when(&server, "receiver", |status| status["messages"] == 5).await;
    let status = &connection["status"];
    assert_eq!((&status["items"], &status["skipped"]), (&json!(2), &json!(1)), "{status}");
    assert_tracked(&server, "boat").await;
    let tried = server.post("/v1/connections/receiver/test", &json!({})).await.expect(200).json();
    assert!(tried["message"]["text"].as_str().expect("text").starts_with("$GPGGA"), "{tried}");
    assert!(tried["message"]["reading"][0].as_str().expect("text").contains("latitude 30.628"), "{tried}");
}

/// The radius of the track of a target, m.
async fn r95_m(server: &TestServer, target: &str) -> f64 {
    let tracks = server.get("/v1/cameras/gate/tracks").await.expect(200).json();
    let features = tracks["features"].as_array().expect("features");
    let track = features.iter().find(|it| it["properties"]["target_id"] == target);
    track.unwrap_or_else(|| panic!("{tracks}"))["properties"]["r95_m"].as_f64().expect("a number")
}

#[tokio::test]
async fn what_a_fix_states_wins_over_its_receiver_and_that_over_the_camera() {
    let address = own_address();
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let camera = json!({
        "id": "gate", "gnss_error": {"sigma_m": 0.02}, "receivers": [{"receiver_id": "rover", "sigma_m": 4.0}],
    });
    server.post("/v1/cameras", &camera).await.expect(201);
    let source = json!({
        "address": format!("udp://{address}"), "format": "nmea", "camera_ids": ["gate"], "receiver_id": "boat",
    });
    server.post("/v1/connections", &json!({"id": "receiver", "source": source})).await.expect(201);
    connection_when(&server, "receiver", |status| status["state"] == "running").await;
    let socket = UdpSocket::bind("127.0.0.1:0").await.expect("a port");
    socket.send_to(sentences().as_bytes(), address).await.expect("sent");
    let connection = connection_when(&server, "receiver", |status| status["items"] == 1).await;
    // Quality 1 with an HDOP of 0.9, whatever the camera's receivers usually reach: 3.18 m per axis.
    let stated_m = r95_m(&server, "boat").await;
    assert!((7.5..8.1).contains(&stated_m), "{stated_m} m");
    let reading = connection["status"]["last_message"]["reading"][0].as_str().expect("text");
    assert!(reading.contains("sigma 3.182 m per axis"), "{reading}");

    for receiver in ["rover", "other"] {
        let fix = json!({"observations": [{
            "time": now().to_string(), "receiver_id": receiver, "fix": {"longitude_deg": 103.98678, "latitude_deg": 30.628},
        }]});
        server.post("/v1/cameras/gate/tracks", &fix).await.expect(200);
    }
    let of_receiver_m = r95_m(&server, "rover").await;
    assert!((9.5..10.1).contains(&of_receiver_m), "{of_receiver_m} m");
    let of_camera_m = r95_m(&server, "other").await;
    assert!(of_camera_m < 0.1, "{of_camera_m} m");
}

#[tokio::test]
async fn a_datagram_may_have_several_sentences() {
    let address = own_address();
    let (server, _folder) = start(json!({
        "address": format!("udp://{address}"), "format": "nmea", "camera_ids": ["gate"], "receiver_id": "boat",
    }))
    .await;
    connection_when(&server, "receiver", |status| status["state"] == "running").await;
    let socket = UdpSocket::bind("127.0.0.1:0").await.expect("a port");
    socket.send_to(sentences().as_bytes(), address).await.expect("sent");
    connection_when(&server, "receiver", |status| status["items"] == 1).await;
    assert_tracked(&server, "boat").await;
}

#[tokio::test]
async fn gpsd_is_asked_for_its_reports() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let (server, _folder) =
        start(json!({"address": format!("gpsd://{address}"), "format": "gpsd", "camera_ids": ["gate"]}))
            .await;
    let (mut stream, _) = listener.accept().await.expect("the server connects");
    let mut asked = [0; 64];
    let bytes = stream.read(&mut asked).await.expect("a request");
    assert!(asked[..bytes].starts_with(b"?WATCH={\"enable\":true,\"json\":true}"));
    let now = now();
    let report = format!(
        "{{\"class\":\"TPV\",\"device\":\"boat\",\"mode\":3,\"time\":\"{now:.3}\",\"lat\":30.628,\"lon\":103.98678}}\n"
    );
    stream.write_all(report.as_bytes()).await.expect("written");
    connection_when(&server, "receiver", |status| status["items"] == 1).await;
    assert_tracked(&server, "boat").await;
}

#[tokio::test]
async fn traccar_hands_in_positions_and_is_answered_when_they_are_taken() {
    let (server, _folder) =
        start(json!({"address": "push:", "format": "traccar", "camera_ids": ["gate"]})).await;
    // The source begins beside the answer to its creation; a message that comes first waits for it.
    let now = now();
    let position = json!({
        "position": {"id": 7, "deviceId": 3, "fixTime": format!("{now:.3}"), "valid": true,
            "latitude": 30.628, "longitude": 103.98678, "accuracy": 4.0},
        "device": {"id": 3, "uniqueId": "boat"},
    });
    let path = "/v1/connections/receiver/messages";
    server.post(path, &position).await.expect(204);
    assert_tracked(&server, "boat").await;
    let refused = server.post(path, &json!({"position": {}})).await.expect(400);
    assert!(refused.text().contains("latitude"), "{}", refused.text());
    server.send("DELETE", "/v1/connections/receiver", &[], "").await.expect(204);
    server.post(path, &position).await.expect(404);
}

/// A serial line whose other end is held here. Its device has a name of its own, as that of an adapter by its number, so
/// that it can be pulled out and plugged in again.
struct SerialLine {
    folder: tempfile::TempDir,
    receiver: Option<std::fs::File>,
}

impl SerialLine {
    fn new() -> Self {
        Self { folder: tempfile::tempdir_in("/dev/shm").expect("a folder"), receiver: None }
    }

    fn device(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().expect("text").to_owned()
    }

    fn plug_in(&mut self) {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let receiver = rustix::pty::openpt(flags).expect("a pseudo-terminal");
        rustix::pty::grantpt(&receiver).expect("granted");
        rustix::pty::unlockpt(&receiver).expect("unlocked");
        let name = rustix::pty::ptsname(&receiver, Vec::new()).expect("a name").into_string().expect("text");
        std::os::unix::fs::symlink(name, self.device("receiver")).expect("a link");
        self.receiver = Some(receiver.into());
    }

    fn pull_out(&mut self) {
        std::fs::remove_file(self.device("receiver")).expect("the link");
        self.receiver = None;
    }

    fn send(&mut self, text: &str) {
        let receiver = self.receiver.as_mut().expect("plugged in");
        std::io::Write::write_all(receiver, text.as_bytes()).expect("written");
    }
}

#[tokio::test]
async fn a_serial_receiver_may_be_pulled_out_and_plugged_in_again() {
    let mut line = SerialLine::new();
    line.plug_in();
    let device = line.device("receiver");
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_SERIAL_DEVICES", &device)]);
    create_gate(&server).await;
    let source = json!({"address": format!("serial://{device}?baud=38400"), "format": "nmea", "camera_ids": ["gate"],
        "receiver_id": "boat"});
    server.post("/v1/connections", &json!({"id": "receiver", "source": source})).await.expect(201);
    connection_when(&server, "receiver", |status| status["state"] == "running").await;
    line.send(&sentences());
    let status =
        connection_when(&server, "receiver", |status| status["messages"] == 2).await["status"].clone();
    assert_eq!(
        (&status["items"], &status["last_message"]["subject"]),
        (&json!(1), &json!(device)),
        "{status}"
    );
    assert_tracked(&server, "boat").await;

    line.pull_out();
    connection_when(&server, "receiver", |status| status["state"] == "waiting").await;
    line.plug_in();
    connection_when(&server, "receiver", |status| status["connects"] == 2).await;
    line.send("!AIVDM,1,1,,B,177KQJ5000G?tO`K>RA1wUbN0TKH,0*5C\r\n");
    connection_when(&server, "receiver", |status| status["items"] == 2).await;
}

#[tokio::test]
async fn only_serial_devices_that_the_operator_of_the_machine_names_are_read() {
    let mut line = SerialLine::new();
    line.plug_in();
    std::fs::write(line.device("file"), "a secret").expect("a file");
    let devices = format!("{},/dev/null", line.device("file"));
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_SERIAL_DEVICES", &devices)]);
    create_gate(&server).await;
    let draft = |id: &str, device: &str| {
        let source =
            json!({"address": format!("serial://{device}"), "format": "nmea", "camera_ids": ["gate"]});
        json!({"id": id, "source": source})
    };
    for address in [
        "/etc/passwd",
        "/dev/../etc/passwd",
        "/dev/",
        "receiver/dev/ttyUSB0",
        "/dev/ttyUSB0?baud=1200",
        "/dev/ttyUSB0?",
    ] {
        let refused = server.post("/v1/connections", &draft("wrong", address)).await.expect(422);
        assert!(refused.text().contains("source.address"), "{address}: {}", refused.text());
    }
    let unnamed = draft("unnamed", &line.device("receiver"));
    let refused = server.post("/v1/connections", &unnamed).await.expect(422).json();
    assert_eq!(refused["violations"][0]["field"], "source.address", "{refused}");
    assert!(refused.to_string().contains("serial_devices"), "{refused}");
    server.get("/v1/connections/unnamed").await.expect(404);
    for (id, device, reason) in [
        ("file", line.device("file"), "is no serial device"),
        ("null", "/dev/null".to_owned(), "is no serial device"),
    ] {
        server.post("/v1/connections", &draft(id, &device)).await.expect(201);
        let status = connection_when(&server, id, |status| status["state"] == "waiting").await;
        let error = status["status"]["last_error"]["message"].as_str().expect("an error");
        assert!(error.contains(reason) && !error.contains("secret"), "{id}: {error}");
    }
}

/// A client of a listening source, from an address of this machine.
async fn client_from(ip: &str, address: std::net::SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().expect("a socket");
    socket.bind(format!("{ip}:0").parse().expect("an address")).expect("an address of the loopback");
    socket.connect(address).await.expect("the source listens")
}

/// A source that listens, with some limits.
async fn listening(settings: &[(&str, &str)]) -> (TestServer, std::net::SocketAddr, tempfile::TempDir) {
    let (address, folder) = (own_address(), data_folder());
    let server = TestServer::start_with(folder.path(), settings);
    create_gate(&server).await;
    let source = json!({
        "address": format!("tcp-listen://{address}"), "format": "nmea", "camera_ids": ["gate"], "receiver_id": "boat",
    });
    server.post("/v1/connections", &json!({"id": "receiver", "source": source})).await.expect(201);
    connection_when(&server, "receiver", |status| status["state"] == "running").await;
    (server, address, folder)
}

#[tokio::test]
async fn silent_clients_of_a_listener_do_not_keep_a_receiver_out() {
    let (server, address, _folder) = listening(&[("SIGHTFIX_LIMITS__CONNECTION_CLIENTS", "4")]).await;
    // One address gets half of the places, so another one still finds some.
    let mut silent = Vec::new();
    for _ in 0..3 {
        silent.push(client_from("127.0.0.1", address).await);
    }
    let status = connection_when(&server, "receiver", |status| status["refused_clients"] == 1).await;
    let status = &status["status"];
    assert_eq!(status["clients"], 2, "{status}");
    let error = status["last_error"]["message"].as_str().expect("text");
    assert!(error.contains("127.0.0.1 has 2 connections"), "{error}");
    for ip in ["127.0.0.3", "127.0.0.4"] {
        silent.push(client_from(ip, address).await);
    }
    connection_when(&server, "receiver", |status| status["clients"] == 4).await;
    // All places are taken; once a client has been silent for some time, it gives way.
    let mut receivers = Vec::new();
    for _ in 0..60 {
        let mut receiver = client_from("127.0.0.2", address).await;
        // A client that is refused may be reset while it sends.
        let _ = receiver.write_all(sentences().as_bytes()).await;
        receivers.push(receiver);
        tokio::time::sleep(std::time::Duration::from_millis(500)).await;
        let status = server.get("/v1/connections/receiver").await.expect(200).json()["status"].clone();
        if status["items"].as_u64() > Some(0) {
            let error = status["last_error"]["message"].as_str().expect("text");
            assert!(error.contains("which was silent, was closed"), "{error}");
            return assert_tracked(&server, "boat").await;
        }
    }
    panic!("the receiver never got a place");
}

#[tokio::test]
async fn a_line_of_a_listeners_client_takes_no_more_than_the_bytes_of_its_source() {
    let (server, address, _folder) = listening(&[("SIGHTFIX_LIMITS__CONNECTION_QUEUE_BYTES", "65536")]).await;
    let mut client = client_from("127.0.0.1", address).await;
    // Less than a message may have, and more than the source may hold.
    client.write_all(&vec![b'x'; 500_000]).await.expect("written");
    let status = connection_when(&server, "receiver", |status| status["lost"] == 1).await;
    assert_eq!(status["status"]["messages"], 0, "{status}");
    client.write_all(b"\r\n").await.expect("written");
    client.write_all(sentences().as_bytes()).await.expect("written");
    connection_when(&server, "receiver", |status| status["items"] == 1).await;
    assert_tracked(&server, "boat").await;
}

/// A broker of MQTT 5 that accepts everybody, never confirms a subscription and publishes without end (QoS 0).
async fn flooding_broker(listener: TcpListener) {
    let (mut stream, _) = listener.accept().await.expect("the server connects");
    let mut connect = [0; 1_024];
    assert!(stream.read(&mut connect).await.expect("a CONNECT") > 0);
    stream.write_all(&[0x20, 3, 0, 0, 0]).await.expect("a CONNACK");
    let payload = vec![b'x'; 16_000];
    // Topic `t`, no properties.
    let length = payload.len() + 4;
    let mut publish = vec![0x30, (length % 128) as u8 | 0x80, (length / 128) as u8, 0, 1, b't', 0];
    publish.extend_from_slice(&payload);
    while stream.write_all(&publish).await.is_ok() {}
}

#[tokio::test]
async fn a_subscription_that_is_never_confirmed_ends_whatever_the_broker_sends() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let flooding = tokio::spawn(flooding_broker(listener));
    let folder = data_folder();
    let server =
        TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__CONNECTION_QUEUE_BYTES", "262144")]);
    create_gate(&server).await;
    let source = json!({
        "address": format!("mqtt://{address}"), "topics": ["t"], "format": "nmea", "camera_ids": ["gate"],
        "receiver_id": "boat",
    });
    server.post("/v1/connections", &json!({"id": "receiver", "source": source})).await.expect(201);
    let is_refused = |status: &Value| {
        let message = status["last_error"]["message"].as_str();
        message.is_some_and(|message| message.contains("has not confirmed the subscription"))
    };
    let connection = connection_when(&server, "receiver", is_refused).await;
    assert!(connection["status"]["messages"].as_u64() > Some(0), "some were taken meanwhile: {connection}");
    flooding.abort();
}
