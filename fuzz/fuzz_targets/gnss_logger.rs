#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| sightfix_fuzz::run("gnss_logger", input));
