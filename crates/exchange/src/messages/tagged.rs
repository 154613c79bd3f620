//! Tag blocks of NMEA 0183 sentences (IEC 61162-450).

/// A line without its tag block.
pub(super) struct Tagged<'a> {
    tags: &'a str,
    pub(super) sentence: &'a str,
}

impl<'a> Tagged<'a> {
    pub(super) fn of(line: &'a str) -> Self {
        match line.strip_prefix('\\').and_then(|rest| rest.split_once('\\')) {
            Some((tags, sentence)) => Self { tags: tags.split('*').next().unwrap_or_default(), sentence },
            None => Self { tags: "", sentence: line },
        }
    }

    /// The value of a tag, such as `c:`.
    pub(super) fn tag(&self, name: &str) -> Option<&'a str> {
        self.tags.split(',').find_map(|tag| tag.strip_prefix(name))
    }
}
