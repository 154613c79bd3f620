//! Fuzzed functions: one per kind of input, over the public interface, with the properties that hold whatever
//! the input is. The fuzz targets and the seeded test `tests/it/hostile` share them.

use std::io::Write as _;
use std::sync::LazyLock;

use prost::Message as _;
use sightfix::config::{Config, Overrides};
use sightfix::domain::{
    AuditNumber, BoundingBox, CameraId, EvaluationId, Fix, KeyId, KeySecret, Observation, Receivers, RunId,
    StoredSample, TimeBounds, parse_time,
};
use sightfix::exchange::{
    FixFormat, Format, RowRules, read_cursor, read_detections, read_fixes, read_observations,
    read_received_fixes, read_samples, wire,
};
use sightfix::fusion::two_step::fuse;
use sightfix::geo::Position;
use sightfix::grpc::proto;
use sightfix::model::Artifact;

/// A kind of input: its name, what is done with it, and inputs that are valid.
pub struct Target {
    /// Name of the fuzz target.
    pub name: &'static str,
    /// Must return, whatever it is given.
    pub run: fn(&[u8]),
    /// Where mutations begin.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All kinds of input.
pub const TARGETS: [Target; 14] = [
    Target { name: "csv", run: csv, seeds: || texts(&[CSV]) },
    Target { name: "ndjson", run: ndjson, seeds: || texts(&[SAMPLE_JSON]) },
    Target { name: "json", run: json, seeds: || texts(&[SAMPLE_JSON, OBSERVATION_JSON]) },
    Target { name: "nmea", run: |input| fixes(input, FixFormat::Nmea), seeds: || texts(&[NMEA]) },
    Target { name: "gpx", run: |input| fixes(input, FixFormat::Gpx), seeds: || texts(&[GPX]) },
    Target { name: "gpsd", run: |input| fixes(input, FixFormat::Gpsd), seeds: || texts(&[GPSD]) },
    Target { name: "rtklib", run: |input| fixes(input, FixFormat::Rtklib), seeds: || texts(&[RTKLIB]) },
    Target { name: "fit", run: |input| fixes(input, FixFormat::Fit), seeds: || vec![FIT.to_vec()] },
    Target {
        name: "gnss_logger",
        run: |input| fixes(input, FixFormat::GnssLogger),
        seeds: || texts(&[GNSS_LOGGER]),
    },
    Target { name: "protobuf", run: protobuf, seeds: protobuf_seeds },
    Target { name: "model", run: model, seeds: || vec![DEMO_MODEL.to_vec()] },
    Target { name: "cursor", run: cursor, seeds: || texts(&["Y2FtZXJhczpj", "bW9kZWxzOjc"]) },
    Target { name: "settings", run: settings, seeds: || texts(&[SETTINGS]) },
    Target { name: "words", run: words, seeds: || texts(&["2026-01-01T00:00:00.5+05:30", "north-gate"]) },
];

const CSV: &str = "time,target_id,left,top,width,height,longitude,latitude,sigma_m,class,score\n\
    2020-12-14T14:41:48+08:00,person-1,475,11,28,77,103.98678,30.6280135,2.2,person,0.9\n\
    2020-12-14T14:41:49Z,\"a \"\"quoted\"\" name\",475.5,11,28,77,-180,-90,,,\n";
const SAMPLE_JSON: &str = "{\"time\":\"2020-12-14T14:41:48Z\",\"target_id\":\"a\",\"bounding_box\":\
    {\"left_px\":475,\"top_px\":11,\"width_px\":28,\"height_px\":77},\
    \"fix\":{\"longitude_deg\":103.98678,\"latitude_deg\":30.6280135,\"sigma_m\":2.5},\"score\":0.5}\n";
const OBSERVATION_JSON: &str = "{\"time\":\"2026-01-01T00:00:00Z\",\"target_id\":\"a\",\
    \"fix\":{\"longitude_deg\":103.98678,\"latitude_deg\":30.6280135}}";
const NMEA: &str = "$GPRMC,120000.00,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n\
    $GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n";
const GPX: &str = "<?xml version=\"1.0\"?><gpx version=\"1.1\"><trk><trkseg>\
    <trkpt lat=\"59.4371\" lon=\"24.7453\"><time>2026-01-01T00:00:00Z</time><hdop>1.2</hdop></trkpt>\
    </trkseg></trk><wpt lat=\"-90\" lon=\"180\"/></gpx>";
const GPSD: &str = "{\"class\":\"TPV\",\"device\":\"/dev/ttyACM0\",\"mode\":3,\
    \"time\":\"2026-01-01T00:00:00.000Z\",\"lat\":59.4371,\"lon\":24.7453,\"epx\":1.5,\"epy\":2.5}\n";
const RTKLIB: &str = "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m)\n\
    2026/09/18 16:47:34.000 23.837350600 90.262550200 -36.2680 1 12 0.0034 0.0029\n2436 492454.5 23.8 90.2 0 5 7 1 1\n";
/// One position of an activity.
const FIT: &[u8] = b"\x0c\x10\x00\x00 \x00\x00\x00.FIT@\x00\x00\x14\x00\x04\xfd\x04\x86\x00\x04\x85\x01\x04\x85\x1f\x01\x02\x00T(\x80DA\xa8\xc7\x1517\xf2I\x05\xb3\xff";
const GNSS_LOGGER: &str = "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,\
    BearingDegrees,UnixTimeMillis,MockLocation\nFix,gps,30.628,103.98678,500,1.1,3.8,20,1780315220500,0\n";
const SETTINGS: &str = "data = \"data\"\nlisten = \"127.0.0.1:8080\"\nallowed_hosts = [\"a.example\"]\n\
    [training]\nworkers = 1\n[limits]\nbody_bytes = 1048576\nclient_share = 0.5\n";
const DEMO_MODEL: &[u8] = include_bytes!("../../models/demo-square.safetensors");

fn texts(texts: &[&str]) -> Vec<Vec<u8>> {
    texts.iter().map(|text| text.as_bytes().to_vec()).collect()
}

fn rules() -> RowRules {
    let now = "2026-06-01T00:00:00Z".parse().expect("an instant");
    RowRules { time_bounds: TimeBounds::at(now), image_size: None }
}

fn check_position(position: Position) {
    assert!(position.longitude_deg().abs() <= 180.0 && position.latitude_deg().abs() <= 90.0, "{position:?}");
}

fn check_fix(fix: Fix) {
    check_position(fix.position);
    assert!(fix.sigma_m.is_none_or(|sigma| sigma.metres() > 0.0 && sigma.metres().is_finite()), "{fix:?}");
}

fn check_box(bounding_box: BoundingBox) {
    let sides = bounding_box.sides_px();
    assert!(sides.iter().all(|side| side.is_finite()) && sides[2] > 0.0 && sides[3] > 0.0, "{sides:?}");
}

fn check_sample(sample: &StoredSample) {
    check_box(sample.bounding_box);
    sample.fix.into_iter().for_each(check_fix);
}

/// The position of an observation by the demonstration's model is on the earth, whatever the numbers are.
pub fn check_fusion(observation: &Observation) {
    static MODEL: LazyLock<sightfix::model::Regressor> = LazyLock::new(|| {
        Artifact::from_file(DEMO_MODEL).and_then(|artifact| artifact.load()).expect("the model is good")
    });
    for model in [None, Some((&*MODEL, 1))] {
        let Some(fused) = fuse(observation, model, None, None) else { continue };
        check_position(fused.fused);
        fused.regressed.into_iter().for_each(check_position);
        let weights = fused.confidences;
        assert!(fused.r95_m.is_finite() && fused.r95_m >= 0.0, "{observation:?}: {fused:?}");
        assert!((weights.regression + weights.gnss - 1.0).abs() < 1e-9, "{observation:?}: {fused:?}");
    }
}

fn read_rows(input: &[u8], format: Format) {
    let rules = rules();
    if let Ok(rows) = read_samples(input, format, &rules) {
        rows.filter_map(Result::ok).filter_map(Result::ok).for_each(|sample| check_sample(&sample));
    }
    if let Ok(rows) = read_observations(input, format, &rules) {
        let rows = rows.filter_map(Result::ok).filter_map(Result::ok);
        rows.for_each(|row| check_fusion(&row.observation));
    }
    if let Ok(rows) = read_detections(input, format, &rules, None) {
        rows.filter_map(Result::ok).filter_map(Result::ok).for_each(|row| check_box(row.bounding_box));
    }
}

fn csv(input: &[u8]) {
    read_rows(input, Format::Csv);
    fixes(input, FixFormat::Csv);
}

fn ndjson(input: &[u8]) {
    read_rows(input, Format::Ndjson);
}

fn json(input: &[u8]) {
    read_rows(input, Format::Json);
    if let Ok(observation) = wire::parse_document::<wire::Observation<'_>>(input)
        && let Ok(observation) = observation.to_domain(&rules().time_bounds, None, &Receivers::default())
    {
        check_fusion(&observation);
    }
}

fn fixes(input: &[u8], format: FixFormat) {
    let bounds = rules().time_bounds;
    if let Ok(rows) = read_fixes(input, format, bounds) {
        rows.filter_map(Result::ok).filter_map(Result::ok).for_each(|row| check_fix(row.fix));
    }
    if let Ok(rows) = read_received_fixes(input, format, bounds) {
        rows.filter_map(Result::ok).filter_map(Result::ok).for_each(|row| check_fix(row.fix));
    }
}

fn protobuf(input: &[u8]) {
    let _ = proto::StreamRequest::decode(input);
    let _ = proto::FuseRequest::decode(input);
    let _ = proto::ImportSamplesRequest::decode(input);
    let _ = proto::UpdateCameraRequest::decode(input);
}

/// Messages of clients.
pub fn protobuf_seeds() -> Vec<Vec<u8>> {
    let side = Some(20.0);
    let observation = proto::Observation {
        time: Some(prost_types::Timestamp { seconds: 1_767_225_600, nanos: 500 }),
        target_id: Some("a".to_owned()),
        bounding_box: Some(proto::BoundingBox {
            left_px: side,
            top_px: side,
            width_px: side,
            height_px: side,
        }),
        fix: Some(proto::Fix { longitude_deg: Some(103.9), latitude_deg: Some(30.6), sigma_m: Some(2.0) }),
    };
    let request = proto::FuseRequest { camera_id: "c".to_owned(), observations: vec![observation; 2] };
    vec![request.encode_to_vec()]
}

fn model(input: &[u8]) {
    let Ok(model) = Artifact::from_file(input).and_then(|artifact| artifact.load()) else { return };
    let bounding_box = BoundingBox::new(900.0, 500.0, 40.0, 90.0).expect("a box");
    let time = "2026-01-01T00:00:00Z".parse().expect("an instant");
    let observation = Observation::new(time, None, Some(bounding_box), None).expect("a box is enough");
    if let Some(fused) = fuse(&observation, Some((&model, 1)), None, None) {
        check_position(fused.fused);
    }
}

fn cursor(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let _ = read_cursor::<CameraId>("cursor", text);
    let _ = read_cursor::<RunId>("cursor", text);
    let _ = read_cursor::<EvaluationId>("cursor", text);
    let _ = read_cursor::<KeyId>("cursor", text);
    let _ = read_cursor::<AuditNumber>("cursor", text);
    let _ = read_cursor::<u32>("cursor", text);
}

fn settings(input: &[u8]) {
    let mut file = tempfile::Builder::new().suffix(".toml").tempfile().expect("a temporary file");
    file.write_all(input).expect("it is written");
    let _ = Config::load(Some(file.path()), Overrides::default());
}

/// Texts that become values of the domain.
fn words(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let _ = parse_time(text);
    let _ = CameraId::new(text);
    let _ = KeySecret::parse(text);
}

/// Runs a target by its name.
pub fn run(name: &str, input: &[u8]) {
    let target = TARGETS.iter().find(|target| target.name == name).expect("a target");
    (target.run)(input);
}
