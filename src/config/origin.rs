//! Origins of URLs in settings.

/// The origin of tiles; empty for a path of this server.
pub(super) fn tile_origin(url: &str) -> Option<&str> {
    if url.starts_with('/') && !url.starts_with("//") { Some("") } else { url_origin(url) }
}

/// Scheme and host of a URL, which end up in a header.
pub(super) fn url_origin(url: &str) -> Option<&str> {
    let host_at = url.find("://")? + 3;
    let host = url[host_at..].split('/').next()?;
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b".-:[]".contains(&byte);
    let is_usable =
        matches!(&url[..host_at], "http://" | "https://") && !host.is_empty() && host.bytes().all(is_plain);
    is_usable.then(|| &url[..host_at + host.len()])
}
