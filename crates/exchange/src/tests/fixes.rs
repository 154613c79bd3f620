//! Files of fixes with their times and receivers, and of detections.

use super::*;
use crate::domain::{Detection, ReceivedFix, TargetId};
use crate::{read_detections, read_received_fixes};

fn received(text: &str, format: FixFormat) -> Vec<std::result::Result<ReceivedFix, RowError>> {
    let rows = read_received_fixes(text.as_bytes(), format, rules().time_bounds).expect("a file");
    rows.map(|row| row.expect("a row")).collect()
}

/// Time, receiver, longitude and latitude of a good fix; line, field and reason of a bad one.
fn shown(row: &std::result::Result<ReceivedFix, RowError>) -> String {
    match row {
        Ok(it) => {
            let receiver = it.receiver_id.as_ref().map_or("-", |id| id.as_str());
            let place = it.fix.position;
            format!("{} {receiver} {:.6} {:.6}", it.time, place.longitude_deg(), place.latitude_deg())
        }
        Err(fault) => format!("line {}: {}: {}", fault.line, fault.field, fault.reason),
    }
}

fn all_shown(text: &str, format: FixFormat) -> Vec<String> {
    received(text, format).iter().map(shown).collect()
}

/// The sentence with its checksum.
fn sentence(body: &str) -> String {
    let sum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    format!("${body}*{sum:02X}\r\n")
}

fn gga(time: &str) -> String {
    sentence(&format!("GPGGA,{time},5000.000,N,01000.000,E,1,07,1.8,101.2,M,14.7,M,,"))
}

fn rmc(time: &str, status: &str, date: &str) -> String {
    sentence(&format!("GNRMC,{time},{status},5000.000,N,01000.000,E,0.1,0.0,{date},,,A"))
}

#[test]
fn nmea_dates_are_those_of_rmc_and_zda_across_midnight() {
    let zda = sentence("GPZDA,000001.00,15,12,2020,00,00");
    // A receiver without a fix reports the date of its firmware.
    let log = [
        rmc("235957.00", "V", "060180"),
        gga("235958.00"),
        rmc("235958.00", "A", "141220"),
        gga("235959.00"),
        rmc("235959.00", "A", "141220"),
        gga("000000.25"),
        gga("000001.00"),
        zda,
        gga("000002.00"),
    ];
    let expected = [
        "2020-12-14T23:59:58",
        "2020-12-14T23:59:59",
        "2020-12-15T00:00:00.25",
        "2020-12-15T00:00:01",
        "2020-12-15T00:00:02",
    ];
    let expected = expected.map(|time| format!("{time}Z - 10.000000 50.000000"));
    assert_eq!(all_shown(&log.concat(), FixFormat::Nmea), expected);
}

#[test]
fn nmea_fixes_without_a_date_have_no_times() {
    let log = [gga("235958.00"), gga("235959.00"), rmc("235959.00", "A", "311320")].concat();
    let shown = all_shown(&log, FixFormat::Nmea);
    assert_eq!(shown.len(), 2);
    assert!(shown[1].starts_with("line 2: time: has no date"), "{shown:?}");
    let fixes = read_fixes(log.as_bytes(), FixFormat::Nmea, rules().time_bounds).expect("a file");
    assert_eq!(fixes.filter(|row| row.as_ref().expect("a row").is_ok()).count(), 2);
    // Memory is bounded while a date is waited for.
    assert_eq!(all_shown(&gga("000000.00").repeat(1_000), FixFormat::Nmea).len(), 1_000);
}

#[test]
fn gpx_points_are_read() {
    let gpx = r#"<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="x" xmlns="http://www.topografix.com/GPX/1/1" xmlns:g="urn:g">
 <metadata><time>2001-01-01T00:00:00Z</time></metadata>
 <trk><name>a walk &amp; more</name><trkseg>
  <trkpt lat="30.6" lon="103.9"><ele>500</ele><time>2020-12-14T06:41:48.500Z</time>
   <extensions><g:time>2001-01-01T00:00:00Z</g:time></extensions></trkpt>
  <trkpt
    lon='103.95' lat='30.65'><time> 2020-12-14T14:41:49+08:00 </time></trkpt>
  <trkpt lat="91" lon="103.9"><time>2020-12-14T06:41:50Z</time></trkpt>
  <trkpt lon="103.9"><time>2020-12-14T06:41:50Z</time></trkpt>
  <trkpt lat="30.6" lon="103.9"><time>2020-12-14T06:41:50</time></trkpt>
  <trkpt lat="30.6" lon="103.9"/>
 </trkseg></trk>
 <wpt lat="1" lon="2"><time>2020-12-14T06:41:51Z</time></wpt>
</gpx>
"#;
    let shown = all_shown(gpx, FixFormat::Gpx);
    let expected = [
        "2020-12-14T06:41:48.5Z - 103.900000 30.600000",
        "2020-12-14T06:41:49Z - 103.950000 30.650000",
        "line 9: lat: ",
        "line 10: lat: is required",
        "line 11: time: must be RFC 3339",
        "line 12: time: is required",
        "2020-12-14T06:41:51Z - 2.000000 1.000000",
    ];
    assert_eq!(shown.len(), expected.len(), "{shown:?}");
    for (shown, expected) in shown.iter().zip(expected) {
        assert!(shown.starts_with(expected), "{shown} is not {expected}");
    }
}

#[test]
fn invalid_gpx_ends_with_a_reason() {
    let broken = |text: String| {
        let mut rows =
            read_received_fixes(text.as_bytes(), FixFormat::Gpx, rules().time_bounds).expect("a reader");
        let refused = rows.by_ref().find_map(std::result::Result::err).expect("a refusal");
        assert!(rows.next().is_none(), "nothing follows");
        assert_eq!(refused.kind(), ErrorKind::MalformedBody);
        refused.to_string()
    };
    for (text, reason) in [
        (String::new(), "ends before"),
        ("time,longitude,latitude\n".to_owned(), "ends before"),
        ("<kml></kml>".to_owned(), "must be `gpx`"),
        ("<gpx>\n<trk>".to_owned(), "line 2: the file ends"),
        ("<gpx>\n<trk></gpx>".to_owned(), "line 2: not XML"),
        (format!("<gpx>{}", "<a>".repeat(1_000)), "deep"),
        (format!("<gpx><trkpt lat=\"1\" lon=\"{}\"/></gpx>", "1".repeat(200_000)), "64 KiB"),
        (format!("<gpx><name>{}</name></gpx>", "x".repeat(1_000_000)), "64 KiB"),
    ] {
        let error = broken(text);
        assert!(error.contains(reason), "{error} does not contain {reason}");
    }
}

#[test]
fn gpsd_reports_of_position_are_read() {
    let log = r#"{"class":"VERSION","release":"3.25","proto_major":3}
{"class":"DEVICES","devices":[{"class":"DEVICE","path":"/dev/ttyUSB0"}]}
{"class":"TPV","device":"/dev/ttyUSB0","mode":1}
{"class":"TPV","device":"/dev/ttyUSB0","status":2,"mode":3,"time":"2020-12-14T06:41:48.000Z","ept":0.005,"lat":30.6,"lon":103.9,"eph":2.5}
{"class":"SKY","device":"/dev/ttyUSB0","hdop":1.2}

{"class":"TPV","mode":2,"time":"2020-12-14T06:41:49.000Z","lat":30.6,"lon":103.9}
{"class":"TPV","mode":2,"time":"2020-12-14T06:41:50.000Z","lat":30.6}
{"class":"TPV","mode":2,"lat":30.6,"lon":103.9}
{"class":"TPV","mode":3,"status":8,"time":"2020-12-14T06:41:50.000Z","lat":30.6,"lon":103.9}
not json
"#;
    let shown = all_shown(log, FixFormat::Gpsd);
    let expected = [
        "line 3: mode: the receiver had no fix",
        "2020-12-14T06:41:48Z /dev/ttyUSB0 103.900000 30.600000",
        "2020-12-14T06:41:49Z - 103.900000 30.600000",
        "line 8: lon: is required",
        "line 9: time: is required",
        "line 10: status: ",
        "line 11: : not JSON",
    ];
    assert_eq!(shown.len(), expected.len(), "{shown:?}");
    for (shown, expected) in shown.iter().zip(expected) {
        assert!(shown.starts_with(expected), "{shown} is not {expected}");
    }
}

#[test]
fn solutions_of_rtklib_are_read_with_their_time_system() {
    let columns = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)";
    let row =
        "2019/09/18 16:47:34.000   23.837350600   90.262550200   -36.2680   2  12   0.0300   0.0400   0.0081";
    let file = format!(
        "% program   : RTKLIB demo5 b34k\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)\n{row}\n\
         %  GPST                  {columns}\n{row}\n2071 319654.5, 23.8, 90.2, 0, 5, 7\n\n\
         2019/09/18 16:47:34.000   95.0  90.2  0 1 12\nyesterday 8 1 2\n\
         %  JST                   {columns}\n{row}\n%  GPST   x-ecef(m) y-ecef(m) z-ecef(m)\n{row}\n"
    );
    let shown = all_shown(&file, FixFormat::Rtklib);
    let expected = [
        "line 3: : no line before it begins with % GPST",
        "2019-09-18T16:47:16Z - 90.262550 23.837351",
        "2019-09-18T16:47:16.5Z - 90.200000 23.800000",
        "line 8: latitude_deg: ",
        "line 9: time: must be 2026/01/05",
        "2019-09-18T07:47:34Z - 90.262550 23.837351",
        "line 13: longitude(deg): is required: choose Lat/Lon/Height",
    ];
    assert_eq!(shown.len(), expected.len(), "{shown:?}");
    for (shown, expected) in shown.iter().zip(expected) {
        assert!(shown.starts_with(expected), "{shown} is not {expected}");
    }
    let rows = received(&file, FixFormat::Rtklib);
    let sigma_m = |at: usize| rows[at].as_ref().expect("a fix").fix.sigma_m.expect("stated").metres();
    assert!((sigma_m(1) - 0.035_36).abs() < 1e-5 && (sigma_m(2) - 5.303).abs() < 1e-3);
}

/// A FIT file of these messages, with its checksum.
fn fit_file(messages: &[u8]) -> Vec<u8> {
    let mut file = vec![12, 0x10, 0, 0];
    file.extend(u32::try_from(messages.len()).expect("short").to_le_bytes());
    file.extend(b".FIT");
    file.extend(messages);
    let checksum = file.iter().fold(0_u16, |sum, byte| {
        (0..8).fold(sum ^ u16::from(*byte), |sum, _| if sum & 1 == 1 { sum >> 1 ^ 0xA001 } else { sum >> 1 })
    });
    file.extend(checksum.to_le_bytes());
    file
}

/// Semicircles of degrees.
fn semicircles(degrees: f64) -> i32 {
    (degrees / 180.0 * 2_147_483_648.0).round() as i32
}

/// Records of both byte orders, with and without a developer's field, a time of five bits and an accuracy; the times of the
/// examples of the protocol's description (FIT SDK, "Compressed Timestamp Header").
fn fit_messages() -> Vec<u8> {
    let position = [semicircles(30.628), semicircles(103.98678)];
    let little = position.map(i32::to_le_bytes).concat();
    let big = position.map(i32::to_be_bytes).concat();
    // A file_id, whose fields are skipped.
    let mut messages = vec![0x40, 0, 0, 0, 0, 2, 0, 1, 0, 8, 3, 7, 0, 4, b'a', b'b', 0];
    // Local type 1, little endian, with a developer's field of two bytes and an accuracy.
    messages.extend([0x61, 0, 0, 20, 0, 4, 253, 4, 0x86, 0, 4, 0x85, 1, 4, 0x85, 31, 1, 2, 1, 0, 2, 0]);
    messages.push(1);
    messages.extend([0x3B, 0x95, 0xE8, 0x3B].into_iter().chain(little).chain([5, 0xAA, 0xBB]));
    // Local type 2, big endian, without a time of its own.
    messages.extend([0x42, 0, 1, 0, 20, 2, 0, 4, 0x85, 1, 4, 0x85]);
    for short_time_s in [0x1D, 0x02] {
        messages.push(0x80 | 2 << 5 | short_time_s);
        messages.extend(&big);
    }
    messages.push(0x80 | 2 << 5 | 0x03);
    messages.extend([0x7F, 0xFF, 0xFF, 0xFF, 0x7F, 0xFF, 0xFF, 0xFF]);
    messages
}

#[test]
fn records_of_fit_files_are_read_in_both_byte_orders_and_from_files_in_a_row() {
    let file = fit_file(&fit_messages());
    let shown_of = |content: &[u8]| {
        let rows = read_received_fixes(content, FixFormat::Fit, rules().time_bounds).expect("a file");
        let rows: std::result::Result<Vec<_>, _> = rows.map(|row| row.map(|row| shown(&row))).collect();
        rows.map_err(|error| error.to_string())
    };
    let expected = [
        "2021-11-06T01:58:19Z - 103.986780 30.628000",
        "2021-11-06T01:58:21Z - 103.986780 30.628000",
        "2021-11-06T01:58:26Z - 103.986780 30.628000",
        "line 4: position_long: is missing: the receiver had no fix",
    ];
    let rows = shown_of(&file).expect("a file");
    assert_eq!(rows, expected);
    let both = shown_of(&[file.clone(), file.clone()].concat()).expect("two files");
    assert_eq!((both.len(), &both[4..7]), (8, &rows[..3]), "definitions and times begin again");
    let first = read_received_fixes(&file[..], FixFormat::Fit, rules().time_bounds).expect("a file").next();
    let sigma = first.expect("a row").expect("a file").expect("a fix").fix.sigma_m.expect("stated");
    assert!((sigma.metres() - 5.0 / 1.509_6).abs() < 1e-3);

    let damaged = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut file = file.clone();
        change(&mut file);
        shown_of(&file).expect_err("it is damaged")
    };
    assert!(damaged(&|file| file[60] ^= 1).contains("checksum"), "{}", damaged(&|file| file[60] ^= 1));
    assert!(damaged(&|file| file.truncate(file.len() - 6)).contains("after 3 positions the file breaks off"));
    assert!(damaged(&|file| file[4..8].fill(0)).contains("was not finished"));
    assert!(damaged(&|file| file[9] = b'X').contains("is not FIT"));
    assert!(damaged(&|file| file.clear()).contains("breaks off"));
    assert!(damaged(&|file| file[12] = 0).contains("no definition"));
    assert!(damaged(&|file| file[4] = 20).contains("longer than its file"));
}

/// Lines as releases 2.0 and 3.0 of GnssLogger write them, and the providers' names of GPSTest.
#[test]
fn logs_of_gnss_logger_give_the_fixes_of_the_receiver_alone() {
    let log = "# \n# Header Description:\n# \n# Raw,ElapsedRealtimeMillis,TimeNanos\n\
        # Fix,Provider,Latitude,Longitude,Altitude,Speed,Accuracy,(UTC)TimeInMs\n\
        Raw,1,2\nFix,gps,30.628,103.98678,500.1,1.1,4.0,1607927000500\n\
        #   Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,UnixTimeMillis,\
        SpeedAccuracyMps,BearingAccuracyDegrees,elapsedRealtimeNanos,VerticalAccuracyMeters,MockLocation\n\
        Fix,GPS,30.628,103.98678,500.1,1.1,,20.0,1607927001000,0.1,,1,3.0,0\n\
        Fix,FLP,30.7,103.9,,,12.0,,1607927001000,,,1,,0\nFix,network,30.7,103.9,,,400.0,,1607927001000,,,1,,0\n\
        Fix,GPS,30.628,,500.1,1.1,3.8,20.0,1607927002000,0.1,,1,3.0,0\n\
        Fix,GPS,30.628,103.98678,500.1,1.1,3.8,20.0,1607927003000,0.1,,1,3.0,1\nNMEA,$GPGGA,1\n";
    let expected = [
        "2020-12-14T06:23:20.5Z - 103.986780 30.628000",
        "2020-12-14T06:23:21Z - 103.986780 30.628000",
        "line 12: LongitudeDegrees: is required, as a number",
        "line 13: MockLocation: the position is simulated",
    ];
    for named_as in [FixFormat::GnssLogger, FixFormat::Nmea] {
        assert_eq!(all_shown(log, named_as), expected, "{named_as:?}");
    }
    let rows = received(log, FixFormat::GnssLogger);
    let sigma_m = |at: usize| rows[at].as_ref().expect("a fix").fix.sigma_m.map(|sigma| sigma.metres());
    assert!((sigma_m(0).expect("stated") - 2.650).abs() < 1e-3 && sigma_m(1).is_none());
    let bare = all_shown("Fix,gps,30.6,103.9\n", FixFormat::GnssLogger);
    assert!(bare[0].contains("names the columns"), "{bare:?}");
}

#[test]
fn leap_seconds_are_those_of_the_date() {
    let file = "%  GPST latitude(deg) longitude(deg)\n2016/12/31 12:00:00 1 2\n2017/01/01 00:00:18 1 2\n";
    assert_eq!(
        all_shown(file, FixFormat::Rtklib),
        ["2016-12-31T11:59:43Z - 2.000000 1.000000", "2017-01-01T00:00:00Z - 2.000000 1.000000"]
    );
}

#[test]
fn a_csv_file_of_fixes_may_name_receivers() {
    let csv = "longitude,latitude,time,target_id,receiver_id\n\
               103.9,30.6,2020-12-14T06:41:48Z,person-1,phone\n\
               103.9,30.6,2020-12-14T06:41:49Z,person-1,\n\
               103.9,30.6,2020-12-14T06:41:50Z,,\n\
               103.9,30.6,,person-1,phone\n\
               103.9,95,2020-12-14T06:41:50Z,,\n";
    let shown = all_shown(csv, FixFormat::Csv);
    let expected = [
        "2020-12-14T06:41:48Z phone 103.900000 30.600000",
        "2020-12-14T06:41:49Z person-1 103.900000 30.600000",
        "2020-12-14T06:41:50Z - 103.900000 30.600000",
        "line 5: time: is required",
        "line 6: latitude: ",
    ];
    assert_eq!(shown.len(), expected.len(), "{shown:?}");
    for (shown, expected) in shown.iter().zip(expected) {
        assert!(shown.starts_with(expected), "{shown} is not {expected}");
    }
    // Where nothing but fixes may be, nothing else may name a receiver.
    let samples = format!("{HEADER},receiver_id\n");
    let refused = read_samples(samples.as_bytes(), Format::Csv, &rules()).err().expect("unknown").to_string();
    assert!(refused.contains("unknown column `receiver_id`"), "{refused}");
}

#[test]
fn detections_need_no_fix_and_may_share_a_target() {
    let csv = "time,left,top,width,height,score,target_id\n\
               2020-12-14T06:41:48Z,475,11,28,77,0.5,\n\
               2020-12-14T06:41:49Z,475,11,28,77,,car\n\
               2020-12-14T06:41:50Z,,,,,,car\n";
    let read = |target_id: Option<&str>| -> Vec<std::result::Result<Detection, RowError>> {
        let target_id = target_id.map(|id| TargetId::new(id).expect("a name"));
        let rows = read_detections(csv.as_bytes(), Format::Csv, &rules(), target_id).expect("a file");
        rows.map(|row| row.expect("a row")).collect()
    };
    let named = read(Some("person-1"));
    let targets: Vec<_> = named.iter().flatten().map(|it| it.target_id.as_str().to_owned()).collect();
    assert_eq!(targets, ["person-1", "car"]);
    assert_eq!(named[2].as_ref().expect_err("no box").line, 4);
    let fault = read(None)[0].as_ref().expect_err("no target").clone();
    assert_eq!((fault.line, fault.field.as_str()), (2, "target_id"));
}

proptest! {
    #[test]
    fn arbitrary_bytes_never_panic_as_fixes(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        for &format in FixFormat::ALL {
            for begin in ["", "<gpx><trkpt lat=\"1\" lon=\"2\">", "{\"class\":\"TPV\",", "$GPRMC,1", "% GPST latitude(deg) longitude(deg)\n2026/", "time,longitude,latitude\n"] {
                let text = [begin.as_bytes(), &bytes].concat();
                if let Ok(rows) = read_received_fixes(&text[..], format, rules().time_bounds) {
                    rows.for_each(drop);
                }
            }
        }
    }
}
