//! Messages of receivers; where each comes from is stated beside it.

use super::messages::{context, fixes, read, sigmas_mm};
use crate::{FixFormat, MessageContext, Reading};
use crate::{MessageFormat, SourceSettings, decoder, read_received_fixes, source_decoder};

fn sentence(body: &str) -> String {
    let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    format!("${body}*{checksum:02X}\r\n")
}

fn seconds(reading: &Reading) -> Vec<String> {
    fixes(reading).into_iter().map(|(_, _, _, time)| time[17..].trim_end_matches('Z').to_owned()).collect()
}

fn rmc(second: u32, status: char, mode: &str) -> String {
    sentence(&format!(
        "GPRMC,1200{second}.00,{status},3037.6808,N,10359.2068,E,0.5,054.7,010626,020.3,E{mode}"
    ))
}

fn gga(second: u32) -> String {
    sentence(&format!("GPGGA,1200{second}.00,3037.6808,N,10359.2068,E,1,08,0.9,545.4,M,46.9,M,,"))
}

#[test]
fn the_best_of_a_receivers_sentences_is_read_and_none_twice() {
    let of = |log: &[String]| {
        let log = log.concat();
        let filed =
            read_received_fixes(log.as_bytes(), FixFormat::Nmea, context().time_bounds).expect("a file");
        let filed = filed.filter(|row| row.as_ref().expect("it goes on").is_ok()).count();
        (seconds(&read(MessageFormat::Nmea, &log)), filed)
    };
    let texts = |texts: &[&str]| texts.iter().map(|&text| text.to_owned()).collect::<Vec<_>>();
    let gll = |second: u32| sentence(&format!("GPGLL,3037.6808,N,10359.2068,E,1200{second}.00,A,A"));
    let rmc = |second: u32| rmc(second, 'A', ",A");
    let both = [rmc(10), gga(10), gll(10), rmc(11), gga(11), gll(11)];
    assert_eq!(of(&both), (texts(&["10", "11"]), 2), "GGA alone");
    assert_eq!(of(&[rmc(10), rmc(11), rmc(12)]), (texts(&["10", "11", "12"]), 3), "RMC alone");
    assert_eq!(
        of(&[gll(10), rmc(10), gll(11), rmc(11)]),
        (texts(&["10", "11"]), 2),
        "RMC says more than GLL"
    );
    assert_eq!(of(&[gll(10), gll(11)]), (texts(&["10", "11"]), 0), "GLL alone, which has no date");
    assert_eq!(
        of(&[gga(10), rmc(10), rmc(11), rmc(12)]),
        (texts(&["10", "10", "11", "12"]), 4),
        "GGA has ended"
    );
    assert_eq!(of(&[rmc(10)]), (Vec::new(), 1), "the only one of a file");
}

/// Sentences in the form that NMEA 0183 gives them, of receivers of one to six systems.
#[test]
fn gns_states_a_mode_per_system() {
    let gns = |modes: &str| {
        let one = |second: u32| {
            sentence(&format!("GNGNS,1200{second}.00,3037.6808,N,10359.2068,E,{modes},19,0.9,107.0,-23.4,,"))
        };
        sigmas_mm(&read(MessageFormat::Nmea, &(one(10) + &one(11))))
    };
    assert_eq!(gns("A"), [Some(3_182), Some(3_182)]);
    assert_eq!(gns("NRNN"), [Some(19), Some(19)], "the second system is used");
    assert_eq!(gns("AAAAAA"), [Some(3_182), Some(3_182)]);
    assert!(gns("NNNN").is_empty() && gns("EE").is_empty());
}

#[test]
fn rmc_says_how_a_position_was_found() {
    let of = |status, mode: &str| {
        sigmas_mm(&read(MessageFormat::Nmea, &(rmc(10, status, mode) + &rmc(11, status, mode))))
    };
    assert_eq!(of('A', ",D"), [Some(2_121), Some(2_121)]);
    assert_eq!(of('A', ""), [None, None], "NMEA before 2.3 says nothing");
    assert!(of('V', ",N").is_empty() && of('A', ",E").is_empty() && of('A', ",S").is_empty());
}

fn source(format: &str, rest: serde_json::Value) -> SourceSettings {
    let mut settings = serde_json::json!({"address": "push:", "format": format, "camera_ids": ["gate"]});
    settings.as_object_mut().expect("an object").extend(rest.as_object().expect("an object").clone());
    serde_json::from_value(settings).expect("settings")
}

fn read_as(settings: &SourceSettings, subject: &str, message: &str) -> Reading {
    let context = MessageContext { subject, ..context() };
    source_decoder(settings).decode(message.as_bytes(), &context).expect("a message")
}

#[test]
fn receivers_of_one_address_are_told_apart_by_sender_talker_or_tag() {
    let by = |from: &str| source("nmea", serde_json::json!({"receiver_from": from}));
    let glonass = gga(10).replace("$GPGGA", "$GLGGA");
    let glonass = sentence(glonass[1..].split('*').next().expect("a body"));
    let both = gga(10) + &glonass;
    let receivers = |reading: &Reading| -> Vec<Option<String>> {
        fixes(reading).into_iter().map(|(receiver, ..)| receiver.map(str::to_owned)).collect()
    };
    let named = |names: [&str; 2]| names.map(|name| Some(name.to_owned())).to_vec();
    assert_eq!(receivers(&read_as(&by("talker"), "10.0.0.7:4001", &both)), named(["GP", "GL"]));
    assert_eq!(receivers(&read_as(&by("sender"), "10.0.0.7:4001", &both)), named(["10.0.0.7"; 2]));
    assert_eq!(receivers(&read_as(&by("sender"), "boats/anna", &both)), named(["boats/anna"; 2]));
    assert_eq!(receivers(&read_as(&by("connection"), "10.0.0.7:4001", &both)), [None, None]);
    let tagged = format!("\\s:rover,n:15*00\\{}", gga(10));
    assert_eq!(receivers(&read_as(&by("sender"), "10.0.0.7:4001", &tagged)), [Some("rover".to_owned())]);

    // Each sender has its own date.
    let mut decoder = source_decoder(&by("sender"));
    let mut decode = |subject: &str, message: &str| {
        decoder.decode(message.as_bytes(), &MessageContext { subject, ..context() }).expect("a message")
    };
    decode("10.0.0.7:4001", &rmc(9, 'A', ",A").replace("010626", "010625"));
    let old = sentence("GPRMC,120009.00,A,3037.6808,N,10359.2068,E,0.5,054.7,010625,020.3,E,A");
    decode("10.0.0.7:4001", &old);
    assert_eq!(fixes(&decode("10.0.0.7:4002", &gga(10)))[0].3, "2025-06-01T12:00:10Z");
    assert_eq!(fixes(&decode("10.0.0.8:4001", &gga(10)))[0].3, "2026-06-01T12:00:10Z");
}

#[test]
fn a_date_of_an_earlier_count_of_gps_weeks_is_refused() {
    let dated = |date: &str| {
        let rmc = |second| {
            sentence(&format!("GPRMC,1200{second}.00,A,3037.6808,N,10359.2068,E,0.5,054.7,{date},020.3,E,A"))
        };
        read(MessageFormat::Nmea, &(rmc(10) + &rmc(11)))
    };
    // 2026-06-01 less 1024 weeks.
    let rolled_over = dated("161006");
    assert!(rolled_over.items.is_empty() && rolled_over.skipped[0].contains("1024 weeks"), "{rolled_over:?}");
    assert_eq!(dated("010606").items.len(), 2, "a recording of another day");
    assert_eq!(dated("010626").items.len(), 2);
}

/// Lines in the form of a BaseStation port, and a document with the names of readsb's README-json.md.
#[test]
fn aircraft_are_named_by_their_address() {
    let lines = "SEL,,496,2286,4CA4E5,27215,2026/06/01,12:00:18.100,2026/06/01,12:00:18.200,RYR1427\r\n\
        MSG,3,496,211,4CA2D6,10057,2026/06/01,13:00:18.386,2026/06/01,13:00:18.400,,37000,,,51.45735,-1.02826,,,0,0,0,0\r\n\
        MSG,4,496,469,4CA767,27854,2026/06/01,12:00:19.080,2026/06/01,12:00:19.090,,,288.6,103.2,,,-832,,,,,\r\n";
    let reading = read(MessageFormat::Adsb, lines);
    let time = "2026-06-01T12:00:18.386Z".to_owned();
    assert_eq!(fixes(&reading), [(Some("4CA2D6"), -1.02826, 51.45735, time)], "an hour ahead of UTC");
    assert_eq!((sigmas_mm(&reading), reading.skipped.len()), (vec![None], 0));

    let document = r#"{"now": 1780315220.0, "messages": 12345, "aircraft": [
        {"hex": "4ca2d6", "type": "adsb_icao", "flight": "RYR1427 ", "alt_baro": 37000, "gs": 288.6, "lat": 51.45735,
         "lon": -1.02826, "nic": 8, "rc": 186, "seen_pos": 1.5, "version": 2, "nac_p": 9, "sil": 3, "messages": 12, "seen": 0.2, "rssi": -20.1},
        {"hex": "~2a1b3c", "type": "mode_s", "alt_baro": "ground", "seen": 3.1, "rssi": -30.0},
        {"hex": "abcdef", "lat": 151.4, "lon": 2.0}]}"#;
    let reading = read(MessageFormat::Adsb, document);
    let time = "2026-06-01T12:00:18.5Z".to_owned();
    assert_eq!(fixes(&reading), [(Some("4CA2D6"), -1.02826, 51.45735, time)]);
    assert_eq!(sigmas_mm(&reading), [Some(12_256)]);
    assert!(reading.skipped.len() == 1 && reading.skipped[0].contains("latitude_deg"), "{reading:?}");
    let line = r#"{"now": 1780315220.0, "hex": "4ca2d6", "lat": 51.45735, "lon": -1.02826, "seen_pos": 1.5}"#;
    assert_eq!(fixes(&read(MessageFormat::Adsb, line)).len(), 1);

    let refused = |line: &str| read(MessageFormat::Adsb, line).skipped[0].clone();
    assert!(refused("*8D4840D6202CC371C32CE0576098;").contains("BaseStation"));
    let wrong_day = lines.replace("2026/06/01", "2026/05/30");
    assert!(refused(&wrong_day).contains("another day"));
    assert!(decoder(MessageFormat::Adsb).decode(b"{", &context()).is_err());
}

/// An event in the form in which ATAK sends its own position.
#[test]
fn events_of_tak_are_fixes_of_their_uid() {
    let event = r#"<?xml version="1.0" encoding="UTF-8" standalone="yes"?><event version="2.0" uid="ANDROID-359975090666199"
        type="a-f-G-U-C" time="2026-06-01T12:00:18.000Z" start="2026-06-01T12:00:18.000Z" stale="2026-06-01T12:06:33.000Z"
        how="m-g"><point lat="43.855682" lon="-66.108002" hae="26.77" ce="6.2" le="9999999.0"/><detail>
        <contact callsign="JENNY" endpoint="*:-1:stcp"/><track course="12.3" speed="0.0"/></detail></event>"#;
    let reading = read(MessageFormat::Cot, event);
    let time = "2026-06-01T12:00:18Z".to_owned();
    assert_eq!(fixes(&reading), [(Some("ANDROID-359975090666199"), -66.108002, 43.855682, time)]);
    assert_eq!(sigmas_mm(&reading), [Some(6_200)]);
    let unknown = read(MessageFormat::Cot, &event.replace("6.2", "9999999.0"));
    assert_eq!(sigmas_mm(&unknown), [None]);
    assert_eq!(
        read(MessageFormat::Cot, &event.repeat(2).replace("<?xml", "<?x")).items.len(),
        2,
        "one after the other"
    );
    for (of, by, reason) in [
        ("a-f-G-U-C", "b-t-f", "b-t-f"),
        ("m-g", "h-e", "by a person"),
        ("ANDROID-359975090666199", "sightfix.gate.van", "of this kind has sent"),
        ("43.855682", "93.855682", "latitude_deg"),
    ] {
        let reading = read(MessageFormat::Cot, &event.replace(of, by));
        assert!(reading.items.is_empty() && reading.skipped[0].contains(reason), "{reading:?}");
    }
    for (wrong, reason) in [(&b"\xbf\x01\xbf\x12"[..], "protobuf"), (b"<event/>", "uid"), (b"<a></b>", "XML")]
    {
        let refused = decoder(MessageFormat::Cot).decode(wrong, &context()).expect_err("no event");
        assert!(refused.contains(reason), "{refused}");
    }
}
