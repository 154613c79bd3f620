//! Sample, observation and fix files: CSV, NDJSON, JSON, NMEA and GeoJSON.
