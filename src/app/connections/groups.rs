//! Which connections have to run on one node.

use std::collections::HashSet;

use crate::domain::{CameraId, ConnectionKey, Result, SiteId};
use crate::exchange::{ConnectionSettings, SourceSettings};

/// Live state that is on one node.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Place {
    Camera(CameraId),
    Site(SiteId),
}

#[derive(Default)]
struct Group {
    keys: Vec<ConnectionKey>,
    places: HashSet<Place>,
    /// True if its messages may be for any camera.
    is_for_any: bool,
}

impl Group {
    fn meets(&self, other: &Self) -> bool {
        self.is_for_any || other.is_for_any || !self.places.is_disjoint(&other.places)
    }

    fn join(&mut self, other: Self) {
        self.keys.extend(other.keys);
        self.places.extend(other.places);
        self.is_for_any |= other.is_for_any;
    }
}

/// Groups of connections: sources of which two feed one camera, or cameras of one site, are in one; every sink is in a group
/// of its own. Keys of a group rise.
pub fn connection_groups<'a>(
    connections: impl IntoIterator<Item = (ConnectionKey, &'a ConnectionSettings)>,
    site_of: impl Fn(&CameraId) -> Option<SiteId>,
) -> Vec<Vec<ConnectionKey>> {
    let (mut sources, mut groups): (Vec<Group>, Vec<Vec<ConnectionKey>>) = (Vec::new(), Vec::new());
    for (key, settings) in connections {
        let Some(source) = &settings.source else {
            groups.push(vec![key]);
            continue;
        };
        let mut group = Group { keys: vec![key], is_for_any: source.names_any_camera(), ..Group::default() };
        // A camera whose id cannot be read is fed by nobody.
        let place = |camera: CameraId| match site_of(&camera) {
            Some(site) => Place::Site(site),
            None => Place::Camera(camera),
        };
        group.places.extend(fed_cameras(source).into_iter().flatten().map(place));
        let (met, rest): (Vec<_>, Vec<_>) = sources.into_iter().partition(|known| known.meets(&group));
        met.into_iter().for_each(|known| group.join(known));
        sources = rest;
        sources.push(group);
    }
    groups.extend(sources.into_iter().map(|group| group.keys));
    groups.iter_mut().for_each(|keys| keys.sort_unstable());
    groups.sort_unstable();
    groups
}

fn fed_cameras(source: &SourceSettings) -> Result<Vec<CameraId>> {
    let mapped = source.cameras.values().map(|mapping| mapping.camera());
    mapped.chain(source.fix_cameras()?.into_iter().map(Ok)).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn fixes(cameras: &[&str]) -> ConnectionSettings {
        let source = json!({"address": "push:", "format": "traccar", "camera_ids": cameras});
        serde_json::from_value(json!({"source": source})).expect("settings")
    }

    fn groups(
        settings: &[ConnectionSettings],
        site_of: impl Fn(&CameraId) -> Option<SiteId>,
    ) -> Vec<Vec<i64>> {
        let keyed = (1..).map(ConnectionKey).zip(settings);
        connection_groups(keyed, site_of)
            .into_iter()
            .map(|keys| keys.iter().map(|key| key.0).collect())
            .collect()
    }

    #[test]
    fn sources_of_one_camera_or_one_site_are_a_group() {
        let boxes = json!({"source": {"address": "mqtt://b:1883", "format": "frigate", "topics": ["frigate/events"]}});
        let boxes: ConnectionSettings = serde_json::from_value(boxes).expect("settings");
        let sink = json!({"sink": {"address": "udp://239.2.3.1:6969", "camera_ids": ["a"]}});
        let sink: ConnectionSettings = serde_json::from_value(sink).expect("settings");
        let nowhere = |_: &CameraId| None;
        let apart = [fixes(&["a"]), fixes(&["b", "c"]), sink, fixes(&["d"])];
        assert_eq!(groups(&apart, nowhere), [vec![1], vec![2], vec![3], vec![4]]);
        let of_port = |camera: &CameraId| {
            ["a", "d"].contains(&camera.as_str()).then(|| SiteId::new("port").expect("a slug"))
        };
        assert_eq!(groups(&apart, of_port), [vec![1, 4], vec![2], vec![3]]);
        // The third joins what was apart.
        assert_eq!(groups(&[fixes(&["a"]), fixes(&["b"]), fixes(&["b", "a"])], nowhere), [vec![1, 2, 3]]);
        assert_eq!(groups(&[fixes(&["a"]), fixes(&["b"]), boxes], nowhere), [vec![1, 2, 3]], "any camera");
    }
}
