//! Addresses of connections that are read with their settings.

use serde_json::json;

use crate::{ConnectionSettings, Secrets, SourceSettings};

fn parsed(address: &str) -> Result<Vec<(String, u16)>, String> {
    let settings = json!({"address": address, "format": "frigate", "topics": ["events"]});
    let settings: SourceSettings = serde_json::from_value(settings).expect("settings");
    let address = settings.address().map_err(|error| error.to_string())?;
    Ok(std::iter::once((address.host, address.port)).chain(address.others).collect())
}

#[test]
fn a_cluster_of_kafka_has_several_hosts() {
    let hosts =
        |hosts: &[(&str, u16)]| Ok(hosts.iter().map(|(host, port)| ((*host).to_owned(), *port)).collect());
    assert_eq!(parsed("kafka://a,b:9093,[::1]:9094"), hosts(&[("a", 9092), ("b", 9093), ("::1", 9094)]));
    assert_eq!(parsed("mqtt://broker"), hosts(&[("broker", 1883)]));
    for (address, reason) in [
        ("mqtt://a,b", "for Kafka alone"),
        ("kafka://a,", "no host"),
        ("kafka://a,b:0", "no port from 1"),
        ("kafka://a,b/c", "end after the port"),
    ] {
        let refused = parsed(address).expect_err("it cannot work");
        assert!(refused.contains(reason), "{address}: {refused}");
    }
}

#[test]
fn a_field_that_the_kind_does_not_know_is_refused_by_its_name() {
    let refused = |side: &str, address: &str, field: &str, value: serde_json::Value| {
        let mut settings = json!({"address": address, "camera_ids": ["gate"]});
        if side == "source" {
            settings["format"] = json!("nmea");
        }
        settings[field] = value;
        let settings: ConnectionSettings = serde_json::from_value(json!({side: settings})).expect("settings");
        settings.check(&Secrets::default()).err().map(|error| error.to_string())
    };
    for (side, address, field, value) in [
        ("source", "udp://0.0.0.0:10110", "topics", json!(["a"])),
        ("source", "tcp://gps:10110", "username", json!("operator")),
        ("source", "push:", "ca_certificate", json!("PEM")),
        ("source", "push:", "sasl_mechanism", json!("plain")),
        ("sink", "https://hooks", "topic", json!("positions")),
        ("sink", "mqtt://b", "jetstream", json!(true)),
        ("sink", "tcp://tak:8087", "multicast_ttl", json!(2)),
        ("sink", "mqtt://b", "rotate_s", json!(60.0)),
        ("sink", "mqtt://b", "sasl_mechanism", json!("plain")),
    ] {
        let refusal = refused(side, address, field, value).expect("refused");
        assert!(refusal.contains(&format!("{side}.{field}")), "{refusal}");
        let scheme = address.split(':').next().expect("a scheme");
        assert!(refusal.contains(&format!("is not known for addresses of {scheme}:")), "{refusal}");
    }
    assert_eq!(refused("sink", "udp://239.2.3.1:6969", "multicast_ttl", json!(2)), None);
    assert_eq!(refused("source", "tls://gps:10110", "ca_certificate", json!("PEM")), None);
}
