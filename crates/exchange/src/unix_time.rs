//! Unix times in the unit that their size tells.

use jiff::Timestamp;

/// Seconds, milliseconds, microseconds or nanoseconds since 1970: seconds below 1e11 (the year 5138), and each further
/// unit up to a thousand times as much. Before 1973 a finer unit would be taken for a coarser one.
///
/// # Errors
/// The error names the number if it is not a time.
pub(super) fn unix_time(number: f64) -> Result<Timestamp, String> {
    let per_second = match number.abs() {
        size if size < 1e11 => 1.0,
        size if size < 1e14 => 1e3,
        size if size < 1e17 => 1e6,
        _ => 1e9,
    };
    // The cast saturates, and NaN becomes 0; neither is within the bounds of valid times.
    Timestamp::from_microsecond((number / per_second * 1e6).round() as i64)
        .map_err(|_| format!("`{number}` is no Unix time"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_size_of_a_number_tells_its_unit() {
        let expected = "2023-10-28T13:52:25.514Z".parse::<Timestamp>().expect("a time");
        for number in [1_698_501_145.514, 1_698_501_145_514.0, 1_698_501_145_514_000.0, 1.698_501_145_514e18]
        {
            assert_eq!(unix_time(number), Ok(expected), "{number}");
        }
        assert!(unix_time(1e300).is_err());
    }
}
