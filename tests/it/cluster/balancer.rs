//! The configuration of nginx in `deploy/cluster`, with real nodes behind it.

use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use serde_json::json;
use tokio::net::TcpStream;

use super::feed::Feed;
use super::{assert_stored_once, create, fence, items, node, sql, url};
use crate::harness::{TestServer, data_folder, own_address};

const CONFIGURATION: &str = include_str!("../../../deploy/cluster/nginx.conf");

/// nginx on two free ports; ended when dropped.
pub(super) struct Balancer {
    process: Child,
    pub(super) grpc: SocketAddr,
    rest: SocketAddr,
}

impl Balancer {
    pub(super) async fn start(folder: &Path, nodes: &[&TestServer]) -> Self {
        let (rest, grpc) = (own_address(), own_address());
        let mut text =
            CONFIGURATION.replace("8080;\n    listen 8081", &format!("{rest};\n    listen {grpc}"));
        for (number, server) in (1..).zip(nodes) {
            text = text.replace(&format!("sightfix-{number}:8080"), &server.address.to_string());
        }
        let file = folder.join("nginx.conf");
        std::fs::write(&file, text).expect("written");
        // Every stream of a node that is killed is an error to nginx; the tests report what came of them.
        let global =
            format!("daemon off; pid {}; error_log stderr crit;", folder.join("nginx.pid").display());
        let mut command = Command::new("nginx");
        command.args(["-p", folder.to_str().expect("UTF-8"), "-e", "stderr", "-c"]).arg(&file);
        let process = command.args(["-g", &global]).stdout(Stdio::null()).spawn().expect("nginx runs");
        // Ended by Drop, whatever comes.
        let balancer = Self { process, grpc, rest };
        for _ in 0..400 {
            if TcpStream::connect(grpc).await.is_ok() {
                return balancer;
            }
            tokio::time::sleep(Duration::from_millis(25)).await;
        }
        panic!("nginx does not listen")
    }
}

impl Drop for Balancer {
    fn drop(&mut self) {
        // In order, so that its workers end too.
        let pid = self.process.id().to_string();
        let _ = Command::new("kill").args(["-TERM", &pid]).status();
        let _ = self.process.wait();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL and nginx: .ci/postgres"]
async fn streams_and_requests_of_a_camera_meet_behind_nginx() {
    let (folder, files) = (data_folder(), data_folder());
    let nodes = [node(folder.path()), node(folder.path()), node(folder.path())];
    let balancer = Balancer::start(files.path(), &nodes.each_ref()).await;
    create(&nodes[0], &json!({"id": "yard"})).await;

    // A client that does not name its camera meets any node, and is redirected to the owner.
    let mut feed = Feed::new("yard", items(200));
    feed.upto = 50;
    feed.resume_at(&[&format!("http://{}", balancer.grpc)]).await;
    feed.upto = 100;
    feed.resume_at(&[&format!("http://{}", balancer.grpc)]).await;
    assert_eq!(fence(folder.path(), "yard"), 1, "one owner from the first stream on");

    // REST requests of the camera go to one node, whichever it is, and from there to the owner.
    let owner = sql(folder.path(), "SELECT url FROM nodes JOIN camera_owners ON node_id = id");
    let output = Command::new("curl")
        .args(["-sSfL", "-w", "%{http_code} %{num_redirects} %{url_effective}", "-o", "/dev/null"])
        .arg(format!("http://{}/v1/cameras/yard/tracks", balancer.rest))
        .output()
        .expect("curl runs");
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    println!("through nginx: {printed}; the owner is {owner}");
    assert!(printed.starts_with("200 "), "{printed} {}", String::from_utf8_lossy(&output.stderr));

    // The owner is killed; its camera goes to a node that nginx still knows.
    let mut nodes = nodes;
    let at = nodes.iter().position(|server| url(server) == owner).expect("a node");
    nodes[at].kill_now();
    feed.upto = 200;
    feed.resume_at(&[&format!("http://{}", balancer.grpc)]).await;
    println!("the owner was killed: {} attempts, {} redirects in all", feed.attempts, feed.redirects);
    assert_eq!(fence(folder.path(), "yard"), 2);
    assert_stored_once(&nodes[(at + 1) % 3], &feed).await;
}
