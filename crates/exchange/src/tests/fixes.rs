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
