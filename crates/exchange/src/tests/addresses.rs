//! Addresses of connections that are read with their settings.

use serde_json::json;

use crate::SourceSettings;

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
