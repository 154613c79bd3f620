//! Topics of sinks, by camera and target, or by place and kind of event.

use crate::domain::{CameraId, Error, Result, TargetId, check_text};

/// A topic with places for ids: of a camera and a target, or of a place and a kind of event.
#[derive(Debug, Clone)]
pub struct Topic {
    template: String,
    /// True for characters of a target's id that topics cannot have, or that separate their levels.
    is_special: fn(char) -> bool,
    /// True if the messages of a topic have a key by camera and target.
    has_keys: bool,
}

impl Topic {
    /// A topic of levels.
    ///
    /// # Errors
    /// `InvalidArgument` naming `topic` for one with wildcards.
    pub(super) fn of_levels(
        template: String,
        wildcards: &[char],
        is_special: fn(char) -> bool,
    ) -> Result<Self> {
        check_text("topic", &template, 1_024)?;
        if template.contains(wildcards) {
            return Err(Error::invalid("topic", "must not contain wildcards"));
        }
        Ok(Self::new(template, is_special))
    }

    /// A topic of levels that needs no check.
    pub(super) const fn new(template: String, is_special: fn(char) -> bool) -> Self {
        Self { template, is_special, has_keys: false }
    }

    /// A topic of messages with keys.
    ///
    /// # Errors
    /// `InvalidArgument` naming `topic` for one whose names break a rule.
    pub(super) fn with_keys(
        template: String,
        is_special: fn(char) -> bool,
        rule: impl Fn(&str) -> Result<()>,
    ) -> Result<Self> {
        check_text("topic", &template, 1_024)?;
        // With the longest ids.
        let longest = template.replace("{target}", &"t".repeat(128));
        let longest =
            ["{camera}", "{place}", "{kind}"].iter().fold(longest, |it, id| it.replace(id, &"c".repeat(63)));
        rule(&longest)?;
        Ok(Self { template, is_special, has_keys: true })
    }

    /// The topic of a target's position: `TOPIC/CAMERA/TARGET` where messages have keys.
    #[must_use]
    pub fn of(&self, camera: &CameraId, target: &TargetId) -> String {
        let level = target.as_str().replace(self.is_special, "_");
        let topic = self.template.replace("{camera}", camera.as_str()).replace("{target}", &level);
        if self.has_keys { format!("{topic}/{camera}/{target}") } else { topic }
    }

    /// The topic of an event of a place: `TOPIC/PLACE` where messages have keys.
    #[must_use]
    pub fn of_event(&self, place: &str, kind: &str) -> String {
        let topic = self.template.replace("{place}", place).replace("{kind}", kind);
        if self.has_keys { format!("{topic}/{place}") } else { topic }
    }
}
