//! Live streams: throughput against a bare tonic echo of the same messages, and the time to an answer
//! of many slow streams at once.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Duration, Instant};

use futures_util::StreamExt as _;
use futures_util::stream::{self, BoxStream};
use sightfix::domain::{Observation, PlaceId, TrackScope};
use sightfix::geo::{EastNorth, LocalPlane};
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::fusion_service_server::{FusionService, FusionServiceServer};
use sightfix::grpc::proto::stream_request::Kind as Sent;
use sightfix::grpc::proto::stream_response::Kind as Received;
use sightfix::places::settings::{EventKind, Geometry, PlaceSettings, Rule};
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, mpsc};
use tonic::transport::{Channel, Endpoint};

use crate::ratio::{self, in_turn};
use crate::served::{Served, runtime};
use crate::tables;

/// Items on their way of one stream.
const IN_FLIGHT: usize = 64;
/// Items of a round, over all its streams.
const ITEMS: usize = 64_000;
/// Places of a camera.
const PLACES: usize = 100;
/// The many slow streams.
const CAMERAS: usize = 200;
const RATE_HZ: f64 = 25.0;
const SECONDS: f64 = 60.0;
/// Times stay in the past: the observations begin in January 2026.
const FURTHEST_S: i64 = 240 * 86_400;
/// Streams of one connection.
const STREAMS_PER_CONNECTION: usize = 50;

/// Answers every item with a made answer that carries its seq.
struct Echo(proto::StreamAnswer);

#[tonic::async_trait]
impl FusionService for Echo {
    type StreamStream = BoxStream<'static, Result<proto::StreamResponse, tonic::Status>>;

    async fn fuse(
        &self,
        _: tonic::Request<proto::FuseRequest>,
    ) -> Result<tonic::Response<proto::FuseResponse>, tonic::Status> {
        Err(tonic::Status::unimplemented("streams only"))
    }

    async fn stream(
        &self,
        request: tonic::Request<tonic::Streaming<proto::StreamRequest>>,
    ) -> Result<tonic::Response<Self::StreamStream>, tonic::Status> {
        let made = self.0.clone();
        let answers = request.into_inner().map(move |message| {
            let kind = match message?.kind {
                Some(Sent::Item(item)) => {
                    Received::Answer(Box::new(proto::StreamAnswer { seq: item.seq, ..made.clone() }))
                }
                _ => Received::Opened(proto::StreamOpened::default()),
            };
            Ok(proto::StreamResponse { kind: Some(kind) })
        });
        Ok(tonic::Response::new(answers.boxed()))
    }
}

async fn bare_echo(answer: proto::StreamAnswer) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let address = listener.local_addr().expect("an address");
    let incoming = tonic::transport::server::TcpIncoming::from(listener).with_nodelay(Some(true));
    let server = tonic::transport::Server::builder().add_service(FusionServiceServer::new(Echo(answer)));
    tokio::spawn(async move { server.serve_with_incoming(incoming).await });
    address
}

/// Where the next feed's time begins, s after the first observation: a track takes no steps back.
static NEXT_BEGIN_S: AtomicI64 = AtomicI64::new(0);

/// The observations over and over, each round of them later than the one before.
struct Feed {
    begin_s: i64,
    observations: Arc<Vec<Observation>>,
    round_s: i64,
    target: String,
    next: usize,
    step: Option<Duration>,
}

impl Feed {
    fn new(observations: &Arc<Vec<Observation>>, target: String, step: Option<Duration>) -> Self {
        let (first, last) = (observations[0].time(), observations[observations.len() - 1].time());
        let round_s = last.duration_since(first).as_secs() + 60;
        let rounds = (ITEMS / observations.len()) as i64 + 1;
        let begin_s = NEXT_BEGIN_S.fetch_add(rounds * round_s, Ordering::Relaxed) % FURTHEST_S;
        Self { begin_s, observations: observations.clone(), round_s, target, next: 0, step }
    }

    fn item(&mut self) -> proto::StreamRequest {
        let index = self.next;
        self.next += 1;
        let observation = &self.observations[index % self.observations.len()];
        let (seconds, nanos) = match self.step {
            None => {
                let rounds = (index / self.observations.len()) as i64;
                (
                    self.begin_s + observation.time().as_second() + rounds * self.round_s,
                    observation.time().subsec_nanosecond(),
                )
            }
            Some(step) => {
                let passed = step * u32::try_from(index).expect("a short bench");
                let nanos = i32::try_from(passed.subsec_nanos()).expect("below a second");
                (self.begin_s + self.observations[0].time().as_second() + passed.as_secs() as i64, nanos)
            }
        };
        let [left_px, top_px, width_px, height_px] =
            observation.bounding_box().expect("a box").sides_px().map(Some);
        let fix = observation.fix().expect("a fix").position;
        let item = proto::StreamItem {
            seq: index as u64 + 1,
            time: Some(prost_types::Timestamp { seconds, nanos }),
            target_id: Some(self.target.clone()),
            bounding_box: Some(proto::BoundingBox { left_px, top_px, width_px, height_px }),
            fix: Some(proto::Fix {
                longitude_deg: Some(fix.longitude_deg()),
                latitude_deg: Some(fix.latitude_deg()),
                sigma_m: None,
            }),
            ..proto::StreamItem::default()
        };
        proto::StreamRequest { kind: Some(Sent::Item(item)) }
    }
}

async fn connect(address: SocketAddr) -> Channel {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("a URI");
    endpoint.tcp_nodelay(true).connect().await.expect("the server listens")
}

/// Opens a stream; gives its sender and its responses.
async fn open(
    channel: Channel,
    camera: &str,
    client_name: String,
) -> (mpsc::Sender<proto::StreamRequest>, tonic::Streaming<proto::StreamResponse>) {
    let (items, queue) = mpsc::channel(2 * IN_FLIGHT);
    let opening = proto::StreamOpening { camera_id: camera.to_owned(), client_name, ..Default::default() };
    items.send(proto::StreamRequest { kind: Some(Sent::Opening(opening)) }).await.expect("room");
    let messages = stream::unfold(queue, |mut queue| async move { queue.recv().await.map(|it| (it, queue)) });
    let responses = FusionServiceClient::new(channel).stream(messages).await.expect("a stream").into_inner();
    (items, responses)
}

/// Items per second over `streams` streams, each with its items in flight.
async fn throughput(
    address: SocketAddr,
    camera: &str,
    observations: &Arc<Vec<Observation>>,
    streams: usize,
) -> f64 {
    let began = Instant::now();
    let mut clients = tokio::task::JoinSet::new();
    let each = ITEMS / streams;
    for index in 0..streams {
        let (camera, mut feed) =
            (camera.to_owned(), Feed::new(observations, format!("target-{index}"), None));
        clients.spawn(async move {
            let (items, mut responses) =
                open(connect(address).await, &camera, format!("bench-{index}")).await;
            let room = Arc::new(Semaphore::new(IN_FLIGHT));
            let places = room.clone();
            let sending = tokio::spawn(async move {
                for _ in 0..each {
                    places.acquire().await.expect("open").forget();
                    items.send(feed.item()).await.expect("the stream is open");
                }
                items
            });
            let mut answered = 0;
            while answered < each {
                let message = responses.message().await.expect("no end").expect("no end");
                if let Some(Received::Answer(answer)) = message.kind {
                    let track = answer.track.expect("the target is followed");
                    let late = proto::track_rejection::Reason::TooLate;
                    assert!(track.rejections.iter().all(|rejection| rejection.reason() != late), "{track:?}");
                    answered += 1;
                    room.add_permits(1);
                }
            }
            drop(sending.await.expect("no panic"));
        });
    }
    clients.join_all().await;
    (each * streams) as f64 / began.elapsed().as_secs_f64()
}

/// An answer as the server gives it.
async fn sample_answer(served: &Served, observations: &Arc<Vec<Observation>>) -> proto::StreamAnswer {
    let mut feed = Feed::new(observations, "target-0".to_owned(), None);
    let (items, mut responses) =
        open(connect(served.address).await, served.camera.as_str(), "probe".to_owned()).await;
    items.send(feed.item()).await.expect("room");
    items.send(feed.item()).await.expect("room");
    loop {
        let message = responses.message().await.expect("no end").expect("no end");
        if let Some(Received::Answer(answer)) = message.kind
            && answer.seq == 2
        {
            return *answer;
        }
    }
}

/// Squares of 10 m on the ways of the targets, which are entered and left.
async fn put_places(served: &Served) {
    let rules = [EventKind::Enter, EventKind::Leave].map(Rule::of);
    for number in 0..PLACES {
        let middle = &served.observations[number * served.observations.len() / PLACES];
        let plane = LocalPlane::new(middle.fix().expect("a fix").position);
        let corner = |(east_m, north_m): (f64, f64)| {
            let position = plane.to_position(EastNorth { east_m, north_m });
            [position.longitude_deg(), position.latitude_deg()]
        };
        let ring = [(-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0), (-5.0, -5.0)].map(corner);
        let settings = PlaceSettings {
            display_name: format!("Place {number}"),
            labels: BTreeMap::new(),
            geometry: Geometry::Polygon(vec![ring.to_vec()]),
            radius_m: None,
            probability: PlaceSettings::DEFAULT_PROBABILITY,
            rules: rules.to_vec(),
        };
        let id = PlaceId::new(&format!("place-{number}")).expect("a slug");
        let scope = TrackScope::Camera(served.camera.clone());
        served.app.places().create(id, scope, &settings).await.expect("a new place");
    }
}

fn not_compared(served: &Served) -> f64 {
    let metrics = served.app.metrics.render();
    let line =
        metrics.lines().find_map(|line| line.strip_prefix("sightfix_place_measurements_dropped_total "));
    line.map_or(0.0, |number| number.parse().expect("a number"))
}

/// Throughput of one stream and of sixteen, of one among places, then the time to an answer of two hundred.
pub(crate) fn run() {
    let runtime = runtime();
    let served = runtime.block_on(Served::start());
    let observations = Arc::new(served.observations.clone());
    ratio::head(
        &format!(
            "Live streams with tracking, {IN_FLIGHT} items in flight each, compared with a bare tonic echo"
        ),
        "items/s",
    );
    let answer = runtime.block_on(sample_answer(&served, &observations));
    let echo = runtime.block_on(bare_echo(answer));
    for streams in [1, 16] {
        let rate =
            |address| runtime.block_on(throughput(address, served.camera.as_str(), &observations, streams));
        let ratio = in_turn(|| rate(served.address), || rate(echo));
        ratio::row(&format!("{streams} streams"), &ratio);
    }
    let among_places = runtime.block_on(Served::start());
    runtime.block_on(put_places(&among_places));
    ratio::head(
        &format!("The same with {PLACES} places on the ways of the targets, compared with none"),
        "items/s",
    );
    let rate = |served: &Served| {
        runtime.block_on(throughput(served.address, served.camera.as_str(), &observations, 1))
    };
    ratio::row(&format!("{PLACES} places"), &in_turn(|| rate(&among_places), || rate(&served)));
    tables::head("Measurements of these tracks", &["", "not compared with places, as too many waited"]);
    tables::row("of all rounds", &[(not_compared(&among_places), 0)]);
    among_places.end();
    let mut times_s = runtime.block_on(many(&served, &observations));
    times_s.sort_by(f64::total_cmp);
    let quantile = |share: f64| 1e3 * times_s[((times_s.len() - 1) as f64 * share) as usize];
    tables::head(
        &format!(
            "{CAMERAS} live streams of {RATE_HZ} items per second for {SECONDS} s, client and server in one process"
        ),
        &["answers", "p50 (ms)", "p90 (ms)", "p99 (ms)", "max (ms)"],
    );
    tables::row(times_s.len(), &[0.5, 0.9, 0.99, 1.0].map(|share| (quantile(share), 2)));
    served.end();
}

/// Times from an item to its answer, s.
async fn many(served: &Served, observations: &Arc<Vec<Observation>>) -> Vec<f64> {
    let mut clients = tokio::task::JoinSet::new();
    let mut channel = connect(served.address).await;
    for index in 0..CAMERAS {
        if index % STREAMS_PER_CONNECTION == 0 {
            channel = connect(served.address).await;
        }
        let (channel, camera) = (channel.clone(), served.camera.as_str().to_owned());
        let step = Duration::from_secs_f64(1.0 / RATE_HZ);
        let mut feed = Feed::new(observations, format!("many-{index}"), Some(step));
        clients.spawn(async move {
            let (items, mut responses) = open(channel, &camera, format!("many-{index}")).await;
            let count = (RATE_HZ * SECONDS) as usize;
            let (sent, mut when) = mpsc::unbounded_channel();
            // Spread over one interval, as cameras are.
            tokio::time::sleep(step * u32::try_from(index).expect("few") / CAMERAS as u32).await;
            let mut tick = tokio::time::interval(step);
            let sending = tokio::spawn(async move {
                for _ in 0..count {
                    tick.tick().await;
                    sent.send(Instant::now()).expect("somebody waits");
                    items.send(feed.item()).await.expect("the stream is open");
                }
                items
            });
            let mut times = Vec::with_capacity(count);
            while times.len() < count {
                let message = responses.message().await.expect("no end").expect("no end");
                if matches!(message.kind, Some(Received::Answer(_))) {
                    times.push(when.recv().await.expect("was sent").elapsed().as_secs_f64());
                }
            }
            drop(sending.await.expect("no panic"));
            times
        });
    }
    clients.join_all().await.concat()
}
