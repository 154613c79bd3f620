//! The context of a request while it is answered: the layers of `server` fill it, the transports read it.
//!
//! It is one extension of the request. What it holds of bounded resources is given back when the last clone is dropped,
//! at the end of the response's body.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

use std::net::IpAddr;
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, OnceLock, PoisonError};

use hyper::body::Incoming;
use hyper::http::Extensions;
use hyper::http::uri::Scheme;

use crate::admission::{ClientId, Lease, Quotas, RequestClass};
use crate::app::access::{Caller, Principal};
use crate::domain::{Error, Refusal, Result};
use crate::telemetry::{RequestId, Route};

tokio::task_local! {
    static CURRENT: RequestContext;
}

/// The facts about a request before it is authenticated.
pub struct RequestHead {
    /// The client's own id, or a new one.
    pub id: RequestId,
    /// True for the transport gRPC, false for REST.
    pub is_grpc: bool,
    /// Its class, by method and path.
    pub class: RequestClass,
    /// The scheme by which the client reached the server or a trusted proxy.
    pub scheme: Scheme,
    /// The address of its sender.
    pub address: IpAddr,
}

/// One request. Clones share it.
#[derive(Clone)]
pub struct RequestContext(Arc<State>);

struct State {
    head: RequestHead,
    quotas: Arc<Quotas>,
    caller: OnceLock<Caller>,
    route: OnceLock<Route>,
    body_refusal: OnceLock<Refusal>,
    grant: Mutex<Grant>,
}

/// The bounded resources that a request holds.
#[derive(Default)]
struct Grant {
    /// Bytes of the body that are still to be charged for.
    charged_bytes: u64,
    received_bytes: u64,
    memory: Option<Lease>,
    place: Option<Lease>,
    /// Memory of the message that was decoded last.
    decoded: Option<Lease>,
    /// The rest of the body that its reader left.
    rest: Option<Incoming>,
    is_answered: bool,
}

impl RequestContext {
    /// A request that was granted nothing yet.
    #[must_use]
    pub fn new(head: RequestHead, quotas: Arc<Quotas>) -> Self {
        Self(Arc::new(State {
            head,
            quotas,
            caller: OnceLock::new(),
            route: OnceLock::new(),
            body_refusal: OnceLock::new(),
            grant: Mutex::default(),
        }))
    }

    /// The context among the extensions of a request.
    ///
    /// # Errors
    /// A fault for a request that did not come through the layers of the server.
    pub fn of(extensions: &Extensions) -> Result<&Self> {
        extensions.get().ok_or_else(|| Error::fault("a request came without its context"))
    }

    /// The id of the request.
    #[must_use]
    pub fn id(&self) -> &RequestId {
        &self.0.head.id
    }

    /// True if the request is for the transport gRPC.
    #[must_use]
    pub fn is_grpc(&self) -> bool {
        self.0.head.is_grpc
    }

    /// The class of the request, by method and path.
    #[must_use]
    pub fn class(&self) -> RequestClass {
        self.0.head.class
    }

    /// The scheme by which the client reached the server or a trusted proxy.
    #[must_use]
    pub fn scheme(&self) -> &Scheme {
        &self.0.head.scheme
    }

    /// The address of the sender.
    #[must_use]
    pub fn address(&self) -> IpAddr {
        self.0.head.address
    }

    /// Records who makes it; the first caller stays.
    pub fn authenticated(&self, caller: Caller) {
        let _ = self.0.caller.set(caller);
    }

    /// Who makes it: anonymous until it is authenticated.
    #[must_use]
    pub fn caller(&self) -> &Caller {
        static ANONYMOUS: LazyLock<Caller> = LazyLock::new(|| Caller::new(Principal::Anonymous, None, None));
        self.0.caller.get().unwrap_or(&ANONYMOUS)
    }

    /// As limits count the caller: by the key, or by the address without one.
    #[must_use]
    pub fn client(&self) -> ClientId {
        self.caller().actor().key_id.map_or_else(|| self.address().into(), ClientId::Key)
    }

    /// Records the route that it matched; the first stays.
    pub fn matched(&self, route: Route) {
        let _ = self.0.route.set(route);
    }

    /// The route that it matched, or [`Route::OTHER`].
    #[must_use]
    pub fn route(&self) -> Route {
        self.0.route.get().copied().unwrap_or(Route::OTHER)
    }

    fn grant(&self) -> MutexGuard<'_, Grant> {
        self.0.grant.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes memory for its head, and lets it send a body of which at most `charged_bytes` are held in memory.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn open(&self, charged_bytes: usize) -> Result<()> {
        let memory = match self.class() {
            RequestClass::Probe => None,
            _ => Some(self.0.quotas.open_request(self.client())?),
        };
        let mut grant = self.grant();
        grant.memory = memory;
        grant.charged_bytes = charged_bytes as u64;
        Ok(())
    }

    /// Takes the place among the requests at work.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn begin_work(&self) -> Result<()> {
        self.begin_work_of(&mut self.grant())
    }

    fn begin_work_of(&self, grant: &mut Grant) -> Result<()> {
        if grant.place.is_none() {
            grant.place = self.0.quotas.begin_work(self.class(), self.client())?;
        }
        Ok(())
    }

    /// Charges for the whole body that it may send, whatever comes of it.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn charge_whole_body(&self) -> Result<()> {
        self.grant().charge(u64::MAX)
    }

    /// Counts and charges for a part of the body. The request is worked on once the last one has come.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn receive(&self, bytes: u64, is_last: bool) -> Result<()> {
        let mut grant = self.grant();
        grant.received_bytes += bytes;
        grant.charge(bytes)?;
        if is_last { self.begin_work_of(&mut grant) } else { Ok(()) }
    }

    /// Bytes of the body that were passed on.
    #[must_use]
    pub fn received_bytes(&self) -> u64 {
        self.grant().received_bytes
    }

    /// Keeps the rest of a body until the answer begins.
    pub fn leave(&self, rest: Incoming) {
        let mut grant = self.grant();
        if !grant.is_answered {
            grant.rest = Some(rest);
        }
    }

    /// The work is done and the answer begins. Returns the rest of the body that its reader left.
    pub fn end_work(&self) -> Option<Incoming> {
        let mut grant = self.grant();
        grant.place = None;
        grant.decoded = None;
        grant.is_answered = true;
        grant.rest.take()
    }

    /// Records why its body was refused while it was read; the first reason stays.
    pub fn refuse_body(&self, error: &Error) {
        if let Error::Refused(refusal) = error {
            let _ = self.0.body_refusal.set(refusal.clone());
        }
    }

    /// The reason for which its body was refused, if it was.
    #[must_use]
    pub fn body_refusal(&self) -> Option<Error> {
        self.0.body_refusal.get().cloned().map(Error::Refused)
    }

    /// Answers it, and charges it for the messages that are decoded meanwhile.
    pub async fn scope<F: Future>(self, answer: F) -> F::Output {
        CURRENT.scope(self, answer).await
    }

    /// Charges the request that is answered for a message about to be decoded, instead of the one before: decoders do
    /// not know the request. Nobody is charged outside of a request.
    ///
    /// # Errors
    /// `Overloaded`, which is also why the body was refused.
    pub fn charge_decoded(bytes: u64) -> Result<()> {
        CURRENT.try_with(|context| context.hold_decoded(bytes)).unwrap_or(Ok(()))
    }

    fn hold_decoded(&self, bytes: u64) -> Result<()> {
        let mut grant = self.grant();
        grant.decoded = None;
        match self.0.quotas.decoded_memory(self.client(), bytes) {
            Ok(lease) => {
                grant.decoded = Some(lease);
                Ok(())
            }
            Err(error) => {
                self.refuse_body(&error);
                Err(error)
            }
        }
    }
}

impl Grant {
    /// Charges for bytes that are held in memory, up to the most that are charged for.
    fn charge(&mut self, bytes: u64) -> Result<()> {
        let charged = bytes.min(self.charged_bytes);
        self.charged_bytes -= charged;
        match &mut self.memory {
            Some(memory) if charged > 0 => memory.try_grow(charged),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use hyper::http::HeaderValue;

    use super::*;
    use crate::config::Limits;

    #[tokio::test]
    async fn a_request_holds_the_memory_of_its_last_message() {
        let limits = Limits { request_memory_bytes: 1_000, client_share: 1.0, ..Limits::default() };
        let quotas = Arc::new(Quotas::new(&limits));
        let held = || quotas.usages()[3].held;
        let head = RequestHead {
            id: RequestId::new(HeaderValue::from_static("the-request")),
            is_grpc: true,
            class: RequestClass::Other,
            scheme: Scheme::HTTP,
            address: [127, 0, 0, 1].into(),
        };
        let context = RequestContext::new(head, quotas.clone());
        let answer = async {
            RequestContext::charge_decoded(600).expect("there is so much");
            RequestContext::charge_decoded(900).expect("the one before is given back");
            assert_eq!(held(), 900);
            assert!(RequestContext::charge_decoded(1_001).is_err());
        };
        context.clone().scope(answer).await;
        assert!(context.body_refusal().is_some(), "the reason is known where the body is answered");
        context.end_work();
        assert_eq!(held(), 0);
        RequestContext::charge_decoded(u64::MAX).expect("nobody is charged outside of a request");
    }
}
