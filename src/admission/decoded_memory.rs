//! Memory of decoded messages: charged where they are decoded, by code that knows nothing of the
//! request but that it is one.

use std::cell::RefCell;

use super::{BodyRefusal, ClientId, Lease, Quota};
use crate::domain::{Error, Result};

tokio::task_local! {
    static OF_REQUEST: DecodedMemory;
}

/// The memory of the message that one request decoded last.
pub struct DecodedMemory {
    quota: Quota,
    client: ClientId,
    refusal: BodyRefusal,
    held: RefCell<Option<Lease>>,
}

impl DecodedMemory {
    /// Nothing yet. What is refused is recorded as the reason why the body was.
    pub(super) const fn new(quota: Quota, client: ClientId, refusal: BodyRefusal) -> Self {
        Self { quota, client, refusal, held: RefCell::new(None) }
    }

    /// Answers a request, whose messages are charged; the last one's memory is given back at the end.
    pub async fn scope<F: Future>(self, answer: F) -> F::Output {
        OF_REQUEST.scope(self, answer).await
    }

    /// Charges the request that is answered for a message about to be decoded, instead of the one before. Nobody is
    /// charged outside of a request.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn charge(bytes: u64) -> Result<()> {
        OF_REQUEST.try_with(|memory| memory.hold(bytes)).unwrap_or(Ok(()))
    }

    fn hold(&self, bytes: u64) -> Result<()> {
        drop(self.held.take());
        match self.quota.try_acquire(self.client, bytes) {
            Ok(lease) => {
                *self.held.borrow_mut() = Some(lease);
                Ok(())
            }
            Err(error) => {
                if let Error::Refused(refusal) = &error {
                    self.refusal.set(refusal.clone());
                }
                Err(error)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::Quotas;
    use crate::config::Limits;

    #[tokio::test]
    async fn a_request_holds_the_memory_of_its_last_message() {
        let limits = Limits { request_memory_bytes: 1_000, client_share: 1.0, ..Limits::default() };
        let quotas = Quotas::new(&limits);
        let refusal = BodyRefusal::default();
        let memory = || quotas.decoded_memory(ClientId::UNKNOWN, refusal.clone());
        let held = || quotas.request_memory.usage().held;
        memory()
            .scope(async {
                DecodedMemory::charge(900).expect("it is free");
                DecodedMemory::charge(800).expect("the first was given back");
                assert_eq!(held(), 800);
                assert!(refusal.get().is_none());
                memory()
                    .scope(async { DecodedMemory::charge(300).expect_err("another request has the rest") })
                    .await;
            })
            .await;
        assert_eq!(held(), 0);
        assert!(refusal.get().is_some(), "it says why");
        DecodedMemory::charge(u64::MAX).expect("no request, no charge");
    }
}
