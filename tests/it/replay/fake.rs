//! A server that does as its script says: the faults of a line and of a server, at will.

use std::collections::{BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use futures_util::stream::{self, BoxStream, StreamExt as _};
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_server::{FusionService, FusionServiceServer};
use sightfix::grpc::proto::stream_request::Kind as Asked;
use sightfix::grpc::proto::stream_response::Kind as Told;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tonic::{Request, Response, Status, Streaming};

/// What one stream will meet.
#[derive(Debug, Clone, Default)]
pub(super) struct Script {
    /// The stream breaks after so many items; what was not acknowledged by then is forgotten.
    pub(super) break_after: Option<u64>,
    /// After so many items the client is invited to open another stream.
    pub(super) invite_after: Option<u64>,
    /// Items to an acknowledgement.
    pub(super) acknowledge_every: u64,
    /// Every so many answers one is lost.
    pub(super) lose_every: Option<u64>,
    /// Every so many items one is refused.
    pub(super) refuse_every: Option<u64>,
    /// Nothing is answered at all.
    pub(super) silent: bool,
    /// The stream is refused with this.
    pub(super) refuse: Option<Status>,
}

/// What the server has seen.
#[derive(Debug, Default)]
pub(super) struct Seen {
    pub(super) openings: Vec<proto::StreamOpening>,
    /// Seq, target, and nanoseconds of every item committed.
    pub(super) committed: Vec<(u64, String, i64)>,
    /// Times an item came, whether it was committed or not.
    pub(super) items: u64,
    /// What broke the rules of a client.
    pub(super) broken_rules: BTreeSet<String>,
}

#[derive(Clone)]
pub(super) struct Fake {
    pub(super) address: SocketAddr,
    scripts: Arc<Mutex<VecDeque<Script>>>,
    seen: Arc<Mutex<Seen>>,
}

impl Fake {
    /// Streams get the scripts in turn; those beyond them meet no fault.
    pub(super) async fn start(scripts: impl IntoIterator<Item = Script>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let fake = Self {
            address: listener.local_addr().expect("its address"),
            scripts: Arc::new(Mutex::new(scripts.into_iter().collect())),
            seen: Arc::default(),
        };
        let service = FusionServiceServer::new(fake.clone());
        let incoming = stream::unfold(listener, |listener| async {
            Some((listener.accept().await.map(|(line, _)| line), listener))
        });
        tokio::spawn(tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming));
        fake
    }

    pub(super) fn seen(&self) -> std::sync::MutexGuard<'_, Seen> {
        self.seen.lock().expect("no panic holds it")
    }

    fn break_rule(&self, rule: &str) {
        self.seen().broken_rules.insert(rule.to_owned());
    }

    async fn serve(self, script: Script, mut asked: Streaming<proto::StreamRequest>, told: Sender) {
        let opening = match asked.message().await {
            Ok(Some(proto::StreamRequest { kind: Some(Asked::Opening(opening)) })) => opening,
            _ => return self.break_rule("the first message opens"),
        };
        let mut stream = Served { fake: self, script, opening, told, items: 0, lost: 0, kept: Vec::new() };
        stream.fake.seen().openings.push(stream.opening.clone());
        stream.tell(Told::Opened(proto::StreamOpened::default())).await;
        let mut last = stream.opening.resume_after_seq;
        loop {
            let item = match asked.message().await {
                Ok(Some(proto::StreamRequest { kind: Some(Asked::Item(item)) })) => item,
                Ok(Some(_)) => return stream.fake.break_rule("only items follow"),
                Ok(None) => return stream.acknowledge().await,
                Err(_) => return,
            };
            if item.seq <= last {
                stream.fake.break_rule("seqs rise, and begin above the one to resume after");
            }
            last = item.seq;
            if !stream.take(item).await {
                return;
            }
        }
    }
}

type Sender = mpsc::Sender<Result<proto::StreamResponse, Status>>;

/// A stream being served.
struct Served {
    fake: Fake,
    script: Script,
    opening: proto::StreamOpening,
    told: Sender,
    items: u64,
    lost: u64,
    kept: Vec<proto::StreamItem>,
}

impl Served {
    async fn tell(&self, kind: Told) {
        let _ = self.told.send(Ok(proto::StreamResponse { kind: Some(kind) })).await;
    }

    /// Says whether the stream goes on.
    async fn take(&mut self, item: proto::StreamItem) -> bool {
        self.items += 1;
        self.fake.seen().items += 1;
        let every = |number: Option<u64>| number.is_some_and(|number| self.items.is_multiple_of(number));
        let (seq, refused) = (item.seq, every(self.script.refuse_every));
        let lost = every(self.script.lose_every);
        if !refused {
            self.kept.push(item);
        }
        self.lost += u64::from(lost);
        if !lost && !self.script.silent {
            let error =
                proto::StreamItemError { reason: "invalid-argument".to_owned(), ..Default::default() };
            let outcome = refused.then_some(proto::stream_answer::Outcome::Error(error));
            self.tell(Told::Answer(Box::new(proto::StreamAnswer {
                seq,
                outcome,
                lost_answers: self.lost,
                ..Default::default()
            })))
            .await;
        }
        if self.script.break_after == Some(self.items) {
            let _ = self.told.send(Err(Status::unavailable("the line broke"))).await;
            return false;
        }
        if self.script.invite_after == Some(self.items) {
            self.tell(Told::Reconnect(proto::StreamReconnect { reason: "old".to_owned() })).await;
        }
        if every_nth(self.items, self.script.acknowledge_every) {
            self.acknowledge_upto(seq).await;
        }
        true
    }

    async fn acknowledge(&mut self) {
        if let Some(last) = self.kept.last() {
            self.acknowledge_upto(last.seq).await;
        }
    }

    async fn acknowledge_upto(&mut self, seq: u64) {
        if !self.opening.store_samples {
            return;
        }
        let committed = self.kept.drain(..).map(|item| {
            let time = item.time.expect("an item has a time");
            (
                item.seq,
                item.target_id.unwrap_or_default(),
                time.seconds * 1_000_000_000 + i64::from(time.nanos),
            )
        });
        self.fake.seen().committed.extend(committed);
        self.tell(Told::Acknowledgement(proto::StreamAcknowledgement { seq, ..Default::default() })).await;
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
        let (told, mut answers) = mpsc::channel(64);
        tokio::spawn(self.clone().serve(script, request.into_inner(), told));
        Ok(Response::new(stream::poll_fn(move |context| answers.poll_recv(context)).boxed()))
    }
}
