//! A scripted server, to inject faults of connection and server.

use std::collections::{BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use futures_util::stream::{self, BoxStream, StreamExt as _};
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_server::{FusionService, FusionServiceServer};
use sightfix::grpc::proto::stream_request::Kind as RequestKind;
use sightfix::grpc::proto::stream_response::Kind as ResponseKind;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tonic::{Request, Response, Status, Streaming};

/// The behaviour of one stream.
#[derive(Debug, Clone, Default)]
pub(super) struct Script {
    /// The stream fails after that many items; unacknowledged ones are discarded.
    pub(super) break_after: Option<u64>,
    /// The server requests a reconnect after that many items.
    pub(super) request_reconnect_after: Option<u64>,
    /// Number of items per acknowledgement.
    pub(super) acknowledge_every: u64,
    /// One of that many answers is dropped.
    pub(super) lose_every: Option<u64>,
    /// One of that many items is refused.
    pub(super) refuse_every: Option<u64>,
    /// No item is answered.
    pub(super) silent: bool,
    /// The stream is refused with this.
    pub(super) refuse: Option<Status>,
}

/// The items that the server has received.
#[derive(Debug, Default)]
pub(super) struct Received {
    pub(super) openings: Vec<proto::StreamOpening>,
    /// Seq, target, and nanoseconds of every item committed.
    pub(super) committed: Vec<(u64, String, i64)>,
    /// Number of items received, committed or not.
    pub(super) items: u64,
    /// Violations of the protocol by the client.
    pub(super) violations: BTreeSet<String>,
}

#[derive(Clone)]
pub(super) struct Fake {
    pub(super) address: SocketAddr,
    scripts: Arc<Mutex<VecDeque<Script>>>,
    received: Arc<Mutex<Received>>,
}

impl Fake {
    /// Streams get the scripts in order; further streams have no faults.
    pub(super) async fn start(scripts: impl IntoIterator<Item = Script>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let fake = Self {
            address: listener.local_addr().expect("its address"),
            scripts: Arc::new(Mutex::new(scripts.into_iter().collect())),
            received: Arc::default(),
        };
        let service = FusionServiceServer::new(fake.clone());
        let incoming = stream::unfold(listener, |listener| async {
            Some((listener.accept().await.map(|(stream, _)| stream), listener))
        });
        tokio::spawn(tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming));
        fake
    }

    pub(super) fn received(&self) -> std::sync::MutexGuard<'_, Received> {
        self.received.lock().expect("no panic holds it")
    }

    fn record_violation(&self, rule: &str) {
        self.received().violations.insert(rule.to_owned());
    }

    async fn serve(self, script: Script, mut requests: Streaming<proto::StreamRequest>, responses: Sender) {
        let opening = match requests.message().await {
            Ok(Some(proto::StreamRequest { kind: Some(RequestKind::Opening(opening)) })) => opening,
            _ => return self.record_violation("the first message opens"),
        };
        let mut stream = ServedStream {
            fake: self,
            script,
            opening,
            responses,
            items: 0,
            lost: 0,
            uncommitted: Vec::new(),
        };
        stream.fake.received().openings.push(stream.opening.clone());
        stream.respond(ResponseKind::Opened(proto::StreamOpened::default())).await;
        let mut last = stream.opening.resume_after_seq;
        loop {
            let item = match requests.message().await {
                Ok(Some(proto::StreamRequest { kind: Some(RequestKind::Item(item)) })) => item,
                Ok(Some(_)) => return stream.fake.record_violation("only items follow"),
                Ok(None) => return stream.acknowledge().await,
                Err(_) => return,
            };
            if item.seq <= last {
                stream.fake.record_violation("seqs rise, and begin above the one to resume after");
            }
            last = item.seq;
            if !stream.handle(item).await {
                return;
            }
        }
    }
}

type Sender = mpsc::Sender<Result<proto::StreamResponse, Status>>;

/// The server's side of one stream.
struct ServedStream {
    fake: Fake,
    script: Script,
    opening: proto::StreamOpening,
    responses: Sender,
    items: u64,
    lost: u64,
    uncommitted: Vec<proto::StreamItem>,
}

impl ServedStream {
    async fn respond(&self, kind: ResponseKind) {
        let _ = self.responses.send(Ok(proto::StreamResponse { kind: Some(kind) })).await;
    }

    /// Handles an item; returns whether the stream continues.
    async fn handle(&mut self, item: proto::StreamItem) -> bool {
        self.items += 1;
        self.fake.received().items += 1;
        let every = |number: Option<u64>| number.is_some_and(|number| self.items.is_multiple_of(number));
        let (seq, refused) = (item.seq, every(self.script.refuse_every));
        let lost = every(self.script.lose_every);
        if !refused {
            self.uncommitted.push(item);
        }
        self.lost += u64::from(lost);
        if !lost && !self.script.silent {
            let error =
                proto::StreamItemError { reason: "invalid-argument".to_owned(), ..Default::default() };
            let outcome = refused.then_some(proto::stream_answer::Outcome::Error(error));
            self.respond(ResponseKind::Answer(Box::new(proto::StreamAnswer {
                seq,
                outcome,
                lost_answers: self.lost,
                ..Default::default()
            })))
            .await;
        }
        if self.script.break_after == Some(self.items) {
            let _ = self.responses.send(Err(Status::unavailable("the connection broke"))).await;
            return false;
        }
        if self.script.request_reconnect_after == Some(self.items) {
            self.respond(ResponseKind::Reconnect(proto::StreamReconnect { reason: "old".to_owned() })).await;
        }
        if every_nth(self.items, self.script.acknowledge_every) {
            self.acknowledge_up_to(seq).await;
        }
        true
    }

    async fn acknowledge(&mut self) {
        if let Some(last) = self.uncommitted.last() {
            self.acknowledge_up_to(last.seq).await;
        }
    }

    async fn acknowledge_up_to(&mut self, seq: u64) {
        if !self.opening.store_samples {
            return;
        }
        let committed = self.uncommitted.drain(..).map(|item| {
            let time = item.time.expect("an item has a time");
            (
                item.seq,
                item.target_id.unwrap_or_default(),
                time.seconds * 1_000_000_000 + i64::from(time.nanos),
            )
        });
        self.fake.received().committed.extend(committed);
        self.respond(ResponseKind::Acknowledgement(proto::StreamAcknowledgement {
            seq,
            ..Default::default()
        }))
        .await;
    }
}

const fn every_nth(count: u64, number: u64) -> bool {
    number > 0 && count.is_multiple_of(number)
}

#[tonic::async_trait]
impl FusionService for Fake {
    type StreamStream = BoxStream<'static, Result<proto::StreamResponse, Status>>;

    async fn fuse(&self, _: Request<proto::FuseRequest>) -> Result<Response<proto::FuseResponse>, Status> {
        Err(Status::unimplemented("not scripted"))
    }

    async fn stream(
        &self,
        request: Request<Streaming<proto::StreamRequest>>,
    ) -> Result<Response<Self::StreamStream>, Status> {
        let script = self.scripts.lock().expect("no panic holds it").pop_front().unwrap_or_default();
        if let Some(status) = script.refuse {
            return Err(status);
        }
        let (responses, mut answers) = mpsc::channel(64);
        tokio::spawn(self.clone().serve(script, request.into_inner(), responses));
        Ok(Response::new(stream::poll_fn(move |context| answers.poll_recv(context)).boxed()))
    }
}
