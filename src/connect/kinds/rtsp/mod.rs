//! ONVIF metadata of a camera's RTSP stream, which RTP packets inside of the RTSP connection carry (RFC 2326, 10.12; ONVIF
//! Streaming Specification, 5.1).

mod codec;
mod description;
mod documents;
mod session;

use std::sync::Arc;

use futures_util::future::BoxFuture;

use self::documents::{Document, Documents};
use self::session::Session;
use crate::app::LiveConnection;
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::{OPEN_TIME, within};
use crate::connect::source::{Message, Source};
use crate::exchange::Address;

/// Metadata documents of a camera.
pub(super) struct RtspSource {
    session: Session,
    documents: Documents,
    subject: String,
    live: Arc<LiveConnection>,
}

impl RtspSource {
    pub(super) async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        max_bytes: usize,
        live: &Arc<LiveConnection>,
    ) -> Result<Self, PeerError> {
        let session = within(OPEN_TIME, Session::open(address, credentials)).await?;
        let subject = format!("{}:{}{}", address.host, address.port, address.path);
        Ok(Self { session, documents: Documents::new(max_bytes), subject, live: live.clone() })
    }
}

impl Source for RtspSource {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            loop {
                let packet = self.session.next_packet().await?;
                match self.documents.add(&packet)? {
                    Some(Document::Complete { content, size_bytes }) => {
                        let message = Message::new(0, self.subject.clone(), content);
                        return Ok(Message { size_bytes, ..message });
                    }
                    Some(Document::Damaged) => self.live.update(|status| status.lost += 1),
                    None => {}
                }
            }
        })
    }
}
