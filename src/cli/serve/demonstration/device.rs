//! Simulated devices that post their positions to a source of the server.

use std::net::SocketAddr;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full};
use hyper::Request;
use hyper::client::conn::http1::{self, SendRequest};
use hyper::header::HOST;
use hyper_util::rt::TokioIo;
use jiff::{SignedDuration, Timestamp};
use serde_json::json;
use tokio::net::TcpStream;
use tokio::time::Instant;

use super::ais::{ShipState, position_report};
use super::scenes::{PERIOD_S, Report};
use crate::domain::{ConnectionId, ReceiverId};
use crate::geo::Position;

/// Pause after a failure, in which the message is lost, as those of a real device are.
pub(super) const PAUSE: Duration = Duration::from_secs(1);

/// The source that devices report to.
pub(super) struct Source {
    pub(super) address: SocketAddr,
    pub(super) connection: ConnectionId,
}

/// Posts the reports at their times, period after period. The first period begins now, at `begin` by the server's clock.
pub(super) async fn report_forever<T>(
    source: Source,
    reports: Vec<Report<T>>,
    begin: Timestamp,
    message: impl Fn(&T, Timestamp) -> String,
) {
    let started = Instant::now();
    let mut sender = None;
    for period in 0_u32.. {
        for report in &reports {
            let after = SignedDuration::from_secs(i64::from(PERIOD_S) * i64::from(period)) + report.after;
            tokio::time::sleep_until(started + after.unsigned_abs()).await;
            let time = begin.saturating_add(after).unwrap_or(begin);
            let posted = source.post(sender.take(), message(&report.state, time)).await;
            match posted {
                Ok(open) => sender = Some(open),
                Err(error) => {
                    tracing::debug!(
                        error = format!("{error:#}"),
                        "a device of the demonstration was not heard"
                    );
                    tokio::time::sleep(PAUSE).await;
                }
            }
        }
    }
}

type Sender = SendRequest<Full<Bytes>>;

impl Source {
    /// Posts a message, over the open connection if there is one, and gives the connection back.
    async fn post(&self, open: Option<Sender>, message: String) -> anyhow::Result<Sender> {
        let mut sender = match open {
            Some(sender) => sender,
            None => self.connect().await?,
        };
        let request = Request::post(format!("/v1/connections/{}/messages", self.connection))
            .header(HOST, self.address.to_string())
            .body(Full::new(Bytes::from(message)))?;
        sender.ready().await?;
        let answer = sender.send_request(request).await?;
        let status = answer.status();
        let body = answer.into_body().collect().await?.to_bytes();
        anyhow::ensure!(status.is_success(), "{status}: {}", String::from_utf8_lossy(&body));
        Ok(sender)
    }

    async fn connect(&self) -> anyhow::Result<Sender> {
        let stream = TcpStream::connect(self.address).await?;
        let (sender, connection) = http1::handshake(TokioIo::new(stream)).await?;
        // It ends with its sender.
        tokio::spawn(async move { drop(connection.await) });
        Ok(sender)
    }
}

/// The message of a phone, as OwnTracks sends it.
pub(super) fn phone_message((phone, position): &(ReceiverId, Position), time: Timestamp) -> String {
    json!({
        "_type": "location",
        "topic": format!("owntracks/demo/{phone}"),
        "tst": time.as_second(),
        "lon": position.longitude_deg(),
        "lat": position.latitude_deg(),
    })
    .to_string()
}

/// The sentence of a ship.
pub(super) fn ship_message(ship: &ShipState, time: Timestamp) -> String {
    position_report(ship, time)
}
