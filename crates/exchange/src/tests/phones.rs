//! Bodies of applications for phones; where each comes from is stated beside it.

use super::messages::{context, fixes, read, sigmas_mm};
use crate::{MessageFormat, decoder};

const PHONE: MessageFormat = MessageFormat::Phone;

/// The receiver, the place, the time and the standard deviation of the only fix of a body.
fn only_fix(body: &str) -> (Option<String>, f64, f64, String, Option<i64>) {
    let reading = read(PHONE, body);
    let fixes = fixes(&reading);
    let [(receiver, longitude_deg, latitude_deg, time)] = &fixes[..] else { panic!("{reading:?}") };
    (receiver.map(str::to_owned), *longitude_deg, *latitude_deg, time.clone(), sigmas_mm(&reading)[0])
}

fn refusal(body: &str) -> String {
    decoder(PHONE).decode(body.as_bytes(), &context()).expect_err("it is refused")
}

/// Members as the booklet of OwnTracks has them, tech/json and features/traccar.
const OWN_TRACKS: &str = r#"{"_type": "location", "lat": 48.85833, "lon": 2.29513, "tst": 1497476456, "acc": 15, "alt": 50,
    "batt": 94, "bs": 1, "conn": "w", "created_at": 1497476457, "t": "u", "tid": "JJ", "vac": 3, "vel": 4, "cog": 270}"#;

#[test]
fn own_tracks_is_named_by_its_topic_and_else_by_its_tracker_id() {
    let expected = |receiver: &str| {
        (Some(receiver.to_owned()), 2.29513, 48.85833, "2017-06-14T21:40:56Z".to_owned(), Some(9_936))
    };
    assert_eq!(only_fix(OWN_TRACKS), expected("JJ"));
    let with_topic = OWN_TRACKS.replace(r#""t": "u""#, r#""topic": "owntracks/jane/phone""#);
    assert_eq!(only_fix(&with_topic), expected("jane/phone"));
    let own_topic = OWN_TRACKS.replace(r#""t": "u""#, r#""topic": "family/jane""#);
    assert_eq!(only_fix(&own_topic), expected("family/jane"));
    let mut by_mqtt = context();
    by_mqtt.subject = "owntracks/jane/phone";
    let reading = decoder(PHONE).decode(OWN_TRACKS.as_bytes(), &by_mqtt).expect("a location");
    assert_eq!(fixes(&reading)[0].0, Some("jane/phone"));

    for other in ["lwt", "transition", "waypoint", "status", "cmd", "steps"] {
        let reading = read(PHONE, &OWN_TRACKS.replace("\"location\"", &format!("\"{other}\"")));
        assert!(reading.items.is_empty() && reading.skipped[0].contains(other), "{reading:?}");
    }
    let encrypted = r#"{"_type":"encrypted","data":"SL7ubL6ZJzU8jb0tjhMNi="}"#;
    assert!(refusal(encrypted).contains("encryption key"), "{}", refusal(encrypted));
    assert_eq!(refusal(&OWN_TRACKS.replace("\"tst\"", "\"ts\"")), "tst is missing");
    assert!(read(PHONE, "").items.is_empty(), "a friend was deleted");
    for body in [OWN_TRACKS, encrypted, ""] {
        assert_eq!(PHONE.answer(body.as_bytes()), Some("[]"));
    }
}

/// The request of the README of Overland-iOS, section API, with a second record.
#[test]
fn overland_sends_batches_and_wants_to_read_that_they_were_taken() {
    let batch = r#"{"locations": [{"type": "Feature", "geometry": {"type": "Point", "coordinates": [-122.030581, 37.331800]},
        "properties": {"timestamp": "2015-10-01T08:00:00-0700", "altitude": 0, "speed": 4, "horizontal_accuracy": 30,
        "vertical_accuracy": -1, "motion": ["driving", "stationary"], "pauses": false, "activity": "other_navigation",
        "desired_accuracy": 100, "deferred": 1000, "significant_change": "disabled", "locations_in_payload": 1,
        "battery_state": "charging", "battery_level": 0.89, "device_id": "DEVICE", "wifi": ""}},
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [-122.03, 37.33]},
        "properties": {"timestamp": "2015-10-01T15:00:01Z", "horizontal_accuracy": -1, "device_id": ""}},
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [-122.03, 137.33]},
        "properties": {"timestamp": "2015-10-01T15:00:01Z", "horizontal_accuracy": 5}}]}"#;
    let batch = batch.replace("DEVICE", "iphone");
    let expected = (Some("iphone".to_owned()), -122.030581, 37.3318, "2015-10-01T15:00:00Z".to_owned());
    let reading = read(PHONE, &batch);
    let (receiver, longitude_deg, latitude_deg, time) = fixes(&reading)[0].clone();
    assert_eq!((receiver.map(str::to_owned), longitude_deg, latitude_deg, time), expected);
    assert_eq!(sigmas_mm(&reading), [Some(19_873)]);
    assert!(
        reading.skipped[0].contains("negative") && reading.skipped[1].contains("latitude_deg"),
        "{reading:?}"
    );
    assert_eq!(PHONE.answer(batch.as_bytes()), Some(r#"{"result":"ok"}"#));
    assert_eq!(fixes(&read(PHONE, &batch.replace("iphone", "")))[0].0, None, "an empty name is none");
}

/// A message of release 9.5.3 and a query of release 7.9, both of issue 85 of traccar-client.
#[test]
fn traccar_client_sends_json_or_a_query() {
    let json = r#"{"location": {"timestamp": "2025-08-28T11:51:46.587Z", "coords": {"latitude": -37.6998277,
        "longitude": 145.0686733, "accuracy": 4.32, "speed": 0.11, "heading": 158.44, "altitude": 103}, "is_moving": true,
        "odometer": 0, "battery": {"level": 0.88, "is_charging": false}, "activity": {"type": "still"}}, "device_id": "82879256"}"#;
    let id = || Some("82879256".to_owned());
    let expected = (id(), 145.0686733, -37.6998277, "2025-08-28T11:51:46.587Z".to_owned(), Some(2_862));
    assert_eq!(only_fix(json), expected);
    let mocked = json.replace("\"is_moving\"", "\"mock\": true, \"is_moving\"");
    assert!(read(PHONE, &mocked).skipped[0].contains("mock"));
    let query = "id=82879256&lat=-35.5555277&lon=145.5555733&timestamp=1693222306574&speed=0.211914&bearing=26.21394&accuracy=22.975999";
    let expected = (id(), 145.5555733, -35.5555277, "2023-08-28T11:31:46.574Z".to_owned(), Some(15_220));
    assert_eq!(only_fix(query), expected);
    assert_eq!(PHONE.answer(query.as_bytes()), None);
}

/// A request of issue 1664 of traccar, whose time has no offset, and the body that Home Assistant's page on GPSLogger
/// tells to set, as the application fills it.
#[test]
fn queries_and_forms_name_the_same_by_other_names() {
    let query = "id=863071016800770&timestamp=2016-01-15%2021:41:18.000&lat=-26.619913&lon=152.859238&speed=0.72&altitude=433.10&heading=108.42&hdop=0.81&sat=11&batt=11.43&ignition=OFF";
    let time = "2016-01-15T21:41:18Z".to_owned();
    assert_eq!(
        only_fix(query),
        (Some("863071016800770".to_owned()), 152.859238, -26.619913, time, Some(2_864))
    );
    let form = "latitude=30.628&longitude=103.98678&device=a1b2&accuracy=7.5&battery=81&speed=1.2&direction=0.0&altitude=500&provider=gps&activity=";
    let expected =
        (Some("a1b2".to_owned()), 103.98678, 30.628, "2026-06-01T12:00:20.5Z".to_owned(), Some(4_968));
    assert_eq!(only_fix(form), expected);
    let json = r#"{"lat": 30.628, "lon": 103.98678, "device": "a1b2", "accuracy": "7.5", "time": "2026-06-01T20:00:20.500+08:00"}"#;
    assert_eq!(only_fix(json), expected);
    for time in [
        "2026-06-01T12:00:20.5Z",
        "2026-06-01T20:00:20.5+08:00",
        "2026-06-01T20:00:20.5%2B08:00",
        "1780315220.5",
    ] {
        assert_eq!(only_fix(&format!("{form}&time={time}")), expected, "{time}");
    }
    assert!(read(PHONE, &format!("{form}&valid=false")).items.is_empty());
    for (wrong, reason) in [
        (form.replace("longitude", "long"), "lon is missing"),
        (form.replace("30.628", "north"), "lat is `north`, not a number"),
        (form.replace("30.628", "92"), "latitude"),
        (format!("{form}&time=yesterday"), "RFC 3339"),
        ("<xml/>".to_owned(), "lon is missing"),
        ("[1, 2]".to_owned(), "array"),
        ("{".to_owned(), "JSON"),
    ] {
        assert!(refusal(&wrong).contains(reason), "{wrong}: {}", refusal(&wrong));
    }
}

/// The schema of PUSHING.md of awesome-sensor-logger, with the names of the README's table for locations.
#[test]
fn sensor_logger_states_nanoseconds() {
    let body = r#"{"messageId": 0, "sessionId": "identifier", "deviceId": "pixel", "payload": [
        {"name": "accelerometer", "time": 1698501144401773000, "values": {"x": 0.1, "y": 0.2, "z": 9.8}},
        {"name": "location", "time": 1698501145514000000, "values": {"latitude": 30.628, "longitude": 103.98678,
            "altitude": 500, "speed": 1.1, "bearing": 20, "horizontalAccuracy": 4, "verticalAccuracy": 6}},
        {"name": "location", "time": 1698501146514000000, "values": {"latitude": 30.628}}]}"#;
    let reading = read(PHONE, body);
    let time = "2023-10-28T13:52:25.514Z".to_owned();
    assert_eq!(fixes(&reading), [(Some("pixel"), 103.98678, 30.628, time)]);
    assert_eq!(sigmas_mm(&reading), [Some(2_650)]);
    assert_eq!(reading.skipped, ["values.longitude is missing"]);
    assert!(
        read(PHONE, &body.replace("\"location\"", "\"gyroscope\"")).skipped[0].contains("sensor location")
    );
}

/// The document of Home Assistant's developers on native applications, "Update device location".
#[test]
fn home_assistants_companion_names_no_receiver() {
    let body =
        r#"{"type": "update_location", "data": {"gps": [12.34, 56.78], "gps_accuracy": 120, "battery": 45}}"#;
    assert_eq!(only_fix(body), (None, 56.78, 12.34, "2026-06-01T12:00:20.5Z".to_owned(), Some(79_491)));
    assert_eq!(PHONE.answer(body.as_bytes()), Some("{}"));
    let other = read(PHONE, r#"{"type": "update_registration", "data": {"app_version": "2.0.0"}}"#);
    assert!(other.items.is_empty() && other.skipped[0].contains("update_registration"), "{other:?}");
    let encrypted = r#"{"type": "encrypted", "encrypted": true, "encrypted_data": "abc"}"#;
    assert!(refusal(encrypted).contains("without encryption"));
}
