//! Requests to an ONVIF device and its answers, by which its still pictures are found (ONVIF Core and Media Service
//! Specifications, over SOAP 1.2).

use quick_xml::Reader;
use quick_xml::escape::{escape, unescape};
use quick_xml::events::{BytesStart, Event};

use crate::xml::{Element as _, not_xml};

/// Media type of requests and answers.
pub const SOAP: &str = "application/soap+xml; charset=utf-8";

/// A request to a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OnvifRequest {
    /// Asks the device service for the path of its media service.
    MediaService,
    /// Asks the media service for the token of its first profile.
    Profile,
    /// Asks the media service for the path and query of the still picture of a profile.
    SnapshotUri(String),
}

impl OnvifRequest {
    /// The document to post.
    #[must_use]
    pub fn document(&self) -> String {
        let body = match self {
            Self::MediaService => r#"<GetCapabilities xmlns="http://www.onvif.org/ver10/device/wsdl"><Category>Media</Category></GetCapabilities>"#.to_owned(),
            Self::Profile => r#"<GetProfiles xmlns="http://www.onvif.org/ver10/media/wsdl"/>"#.to_owned(),
            Self::SnapshotUri(profile) => format!(
                r#"<GetSnapshotUri xmlns="http://www.onvif.org/ver10/media/wsdl"><ProfileToken>{}</ProfileToken></GetSnapshotUri>"#,
                escape(profile.as_str())
            ),
        };
        format!(
            r#"<s:Envelope xmlns:s="http://www.w3.org/2003/05/soap-envelope"><s:Body>{body}</s:Body></s:Envelope>"#
        )
    }

    /// The value in the answer. Addresses are reduced to path and query: the device may know itself by another name and port
    /// than its clients, and nobody else is to be asked.
    ///
    /// # Errors
    /// It is not XML, or lacks the element.
    pub fn answer(&self, document: &str) -> Result<String, String> {
        let found = match self {
            Self::MediaService => text(document, "XAddr")?.as_deref().and_then(path),
            Self::Profile => attribute(document, "Profiles", "token")?,
            Self::SnapshotUri(_) => text(document, "Uri")?.as_deref().and_then(path),
        };
        found.ok_or_else(|| format!("the camera's answer to {self:?} lacks what was asked for"))
    }
}

/// Path and query of a URL.
fn path(url: &str) -> Option<String> {
    let (_, rest) = url.trim().split_once("://")?;
    Some(rest.find('/').map_or("/", |begin| &rest[begin..]).to_owned())
}

/// The text of the first element of a name; an empty one has none.
fn text(document: &str, name: &str) -> Result<Option<String>, String> {
    first(document, name, |xml, element| {
        let content = xml.read_text(element.name()).map_err(not_xml)?;
        Ok(Some(unescape(&content).map_err(not_xml)?.into_owned()))
    })
}

/// An attribute of the first element of a name.
fn attribute(document: &str, name: &str, attribute: &str) -> Result<Option<String>, String> {
    first(document, name, |_, element| element.attribute(attribute))
}

/// Reads the first element of a name, if there is one.
fn first(
    document: &str,
    name: &str,
    read: impl FnOnce(&mut Reader<&[u8]>, &BytesStart<'_>) -> Result<Option<String>, String>,
) -> Result<Option<String>, String> {
    let mut xml = Reader::from_str(document);
    // An empty element is read as one that begins and ends.
    xml.config_mut().expand_empty_elements = true;
    loop {
        match xml.read_event().map_err(not_xml)? {
            Event::Eof => return Ok(None),
            Event::Start(element) if element.local_name().as_ref() == name => {
                return read(&mut xml, &element);
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Shaped as the examples of the ONVIF Application Programmer's Guide.
    #[test]
    fn paths_and_the_first_profile_are_taken_from_answers() {
        let capabilities = r#"<?xml version="1.0"?><SOAP-ENV:Envelope xmlns:SOAP-ENV="s" xmlns:tds="d" xmlns:tt="t"><SOAP-ENV:Body>
            <tds:GetCapabilitiesResponse><tds:Capabilities><tt:Media><tt:XAddr>http://169.254.76.145/onvif/services</tt:XAddr>
            </tt:Media></tds:Capabilities></tds:GetCapabilitiesResponse></SOAP-ENV:Body></SOAP-ENV:Envelope>"#;
        assert_eq!(OnvifRequest::MediaService.answer(capabilities).expect("a path"), "/onvif/services");
        let profiles =
            r#"<r><trt:Profiles token="Profile_&amp;1" fixed="true"/><trt:Profiles token="2"/></r>"#;
        let profile = OnvifRequest::Profile.answer(profiles).expect("a token");
        let request = OnvifRequest::SnapshotUri(profile);
        assert!(request.document().contains("<ProfileToken>Profile_&amp;1</ProfileToken>"), "{request:?}");
        let uri = "<r><tt:Uri>http://10.0.0.9:8080/still.cgi?a=1&amp;b=2</tt:Uri></r>";
        assert_eq!(request.answer(uri).expect("a path"), "/still.cgi?a=1&b=2");
    }

    #[test]
    fn an_answer_without_what_was_asked_for_is_refused() {
        for document in
            ["", "<r/>", "no XML <", "<r><Uri>still.jpg</Uri></r>", "<r><Uri>http://x", "<r><Uri/></r>"]
        {
            OnvifRequest::SnapshotUri("1".to_owned()).answer(document).expect_err(document);
        }
    }
}
