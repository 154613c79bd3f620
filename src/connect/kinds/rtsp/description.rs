//! The tracks of a stream, as its description (SDP, RFC 4566) names them.
//!
//! Descriptions of cameras break the order of lines that the standard asks for, so they are read line by line.

use rtsp_types::Url;

use crate::connect::credentials::PeerError;

/// Encoding of metadata that is not compressed (ONVIF Streaming Specification, 5.1.2.1.1).
const METADATA: &str = "vnd.onvif.metadata";

/// Where the requests for a stream's metadata go.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Controls {
    /// The whole stream.
    pub(super) stream: Url,
    /// Its metadata.
    pub(super) metadata: Url,
}

/// A part of a description: of the whole stream, or of one of its tracks.
#[derive(Default)]
struct Part<'a> {
    control: Option<&'a str>,
    encoding: &'a str,
}

impl Controls {
    /// Finds the metadata in a description whose relative URLs are below `base`.
    ///
    /// # Errors
    /// It has no metadata that can be read.
    pub(super) fn find(description: &str, base: &Url) -> Result<Self, PeerError> {
        let (mut stream, mut tracks) = (Part::default(), Vec::new());
        for line in description.lines().map(str::trim_end) {
            if line.starts_with("m=") {
                tracks.push(Part::default());
            }
            let part = tracks.last_mut().unwrap_or(&mut stream);
            if let Some(control) = line.strip_prefix("a=control:") {
                part.control = Some(control);
            } else if let Some((_, encoding)) =
                line.strip_prefix("a=rtpmap:").and_then(|map| map.split_once(' '))
            {
                part.encoding = encoding.split('/').next().unwrap_or_default();
            }
        }
        let metadata = tracks.iter().find(|track| track.encoding.eq_ignore_ascii_case(METADATA));
        let metadata = metadata.ok_or_else(|| without_metadata(&tracks))?;
        Ok(Self { stream: resolve(base, stream.control)?, metadata: resolve(base, metadata.control)? })
    }
}

fn without_metadata(tracks: &[Part<'_>]) -> PeerError {
    let is_metadata = |encoding: &str| encoding.to_ascii_lowercase().starts_with(METADATA);
    match tracks.iter().find(|track| is_metadata(track.encoding)) {
        Some(track) => PeerError(format!(
            "the metadata is compressed ({}); switch that off in the camera",
            track.encoding
        )),
        None => {
            "the stream has no ONVIF metadata; switch analytics and metadata on in the camera's media profile"
                .into()
        }
    }
}

/// The URL of a control attribute: absolute, below the base, or the base.
fn resolve(base: &Url, control: Option<&str>) -> Result<Url, PeerError> {
    let url = match control {
        None | Some("*") => return Ok(base.clone()),
        Some(url) if url.starts_with("rtsp://") || url.starts_with("rtsps://") => url.to_owned(),
        // Cameras have a query in the base and expect the control after it, so this is not `Url::join`.
        Some(path) => format!("{}/{path}", base.as_str().trim_end_matches('/')),
    };
    Url::parse(&url)
        .map_err(|error| PeerError(format!("the control attribute {url:.200} is no URL: {error}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(lines: &[&str], base: &str) -> Result<[String; 2], String> {
        let base = Url::parse(base).expect("a URL");
        let controls = Controls::find(&lines.join("\r\n"), &base).map_err(|error| error.to_string())?;
        Ok([controls.stream, controls.metadata].map(String::from))
    }

    /// The lines that matter of descriptions by cameras of Hikvision and GeoVision and by GStreamer.
    #[test]
    fn the_metadata_is_found_by_its_encoding() {
        let video = ["m=video 0 RTP/AVP 96", "a=control:track1", "a=rtpmap:96 H264/90000"];
        let absolute = "rtsp://192.168.5.106:554/Streaming/Channels/101/trackID=3?transportmode=unicast";
        let control = format!("a=control:{absolute}");
        let hikvision = [&["v=0", "t=0 0", "a=control:*"][..], &video].concat();
        let hikvision = [
            &hikvision[..],
            &["m=application 0 RTP/AVP 107", &control, "a=rtpmap:107 vnd.onvif.metadata/90000"],
        ];
        let base = "rtsp://192.168.5.106:554/Streaming/Channels/101/";
        assert_eq!(found(&hikvision.concat(), base), Ok([base.to_owned(), absolute.to_owned()]));

        let relative =
            ["m=application 0 RTP/AVP 107", "a=rtpmap:107 VND.ONVIF.METADATA/90000", "a=control:stream=0"];
        let below = |base: &str| found(&relative, base).map(|[_, metadata]| metadata);
        assert_eq!(below("rtsp://camera/onvif/"), Ok("rtsp://camera/onvif/stream=0".to_owned()));
        assert_eq!(below("rtsp://camera/a?b=c"), Ok("rtsp://camera/a?b=c/stream=0".to_owned()));
    }

    #[test]
    fn a_stream_without_readable_metadata_says_what_to_change() {
        let gzip = ["m=application 0 RTP/AVP 107", "a=rtpmap:107 vnd.onvif.metadata.gzip/90000"];
        assert!(found(&gzip, "rtsp://camera/").is_err_and(|error| error.contains("switch that off")));
        let video = ["m=video 0 RTP/AVP 96", "a=rtpmap:96 H264/90000"];
        assert!(found(&video, "rtsp://camera/").is_err_and(|error| error.contains("has no ONVIF metadata")));
    }
}
