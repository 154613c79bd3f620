"""Tables of columns (pandas, numpy, lists) from and to rows.

The columns are those of a CSV file of samples; in tables of this package their names have units.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from sightfix._items import LiveItem
from sightfix._json import format_time, from_json
from sightfix.models import FusedFix, Observation, Sample

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd


class Table(Protocol):
    """A mapping of column names to values, or a DataFrame."""

    def items(self) -> Iterable[tuple[Any, Any]]:
        """Names and values of the columns."""


BOX = ("left_px", "top_px", "width_px", "height_px")
FIX = ("longitude_deg", "latitude_deg", "sigma_m")
COVARIANCE = ("east_m2", "north_m2", "east_north_m2")
TRUTH = {"truth_longitude_deg": "longitude_deg", "truth_latitude_deg": "latitude_deg"}
SAMPLE_COLUMNS = ("time", "target_id", *BOX, *FIX, "class", "score", *TRUTH)
ALIASES = {
    "left": "left_px",
    "top": "top_px",
    "width": "width_px",
    "height": "height_px",
    "longitude": "longitude_deg",
    "latitude": "latitude_deg",
    "truth_longitude": "truth_longitude_deg",
    "truth_latitude": "truth_latitude_deg",
}


def table_rows(table: Table) -> Iterator[dict[str, Any]]:
    """The rows of a table without their missing values (None, NaN, NaT, NA, empty text).

    Raises:
        ValueError: A column is unknown, the columns differ in length, or a time has no UTC offset.
    """
    columns = {ALIASES.get(str(name), str(name)): column_values(column) for name, column in table.items()}
    unknown = sorted(columns.keys() - set(SAMPLE_COLUMNS))
    if unknown:
        raise ValueError(f"unknown columns: {', '.join(unknown)}; known are {', '.join(SAMPLE_COLUMNS)}")
    for values in zip(*columns.values(), strict=True):
        yield {name: value for name, value in zip(columns, values, strict=True) if not is_missing(value)}


def column_values(column: Any) -> list[Any]:
    """The values of a column as plain Python values; `datetime64` of numpy is UTC."""
    if getattr(getattr(column, "dtype", None), "kind", "") == "M" and not hasattr(column, "dt"):
        times = column.astype("datetime64[us]").tolist()
        return [None if time is None else time.replace(tzinfo=UTC) for time in times]
    return list(column.tolist() if hasattr(column, "tolist") else column)


def is_missing(value: Any) -> bool:
    """True if a value is None, NaN, NaT, NA or an empty text."""
    if value is None or value == "":
        return True
    # The NA of pandas has no truth value; NaN and NaT differ from themselves.
    return type(value).__name__ == "NAType" or bool(value != value)  # noqa: PLR0124


def observation_rows(table: Table) -> Iterator[dict[str, Any]]:
    """The rows of a table as JSON values of observations. Columns that only samples have are left out."""
    for row in table_rows(table):
        yield grouped(row, ("time", "target_id", "class"))


def live_items(table: Table) -> Iterator[LiveItem]:
    """The rows of a DataFrame, or of a mapping of column names to arrays, as items of a live stream.

    Columns as in `Samples.import_table`; those of the true position are left out.

    Raises:
        ValueError: A column is unknown, or a time has no UTC offset.
    """
    for row in table_rows(table):
        yield from_json(LiveItem, grouped(row, ("time", "target_id", "class", "score")))


def sample_rows(table: Table) -> Iterator[dict[str, Any]]:
    """The rows of a table as JSON values of samples."""
    for row in table_rows(table):
        sample = grouped(row, ("time", "target_id", "class", "score"))
        truth = {key: row[name] for name, key in TRUTH.items() if name in row}
        if truth:
            sample["truth"] = truth
        yield sample


def grouped(row: Mapping[str, Any], scalars: tuple[str, ...]) -> dict[str, Any]:
    """A row as JSON values: box and fix are objects of their own, present if one of their values is.

    A `sigma_m` without coordinates is no fix.
    """
    values: dict[str, Any] = {name: json_scalar(name, row[name]) for name in scalars if name in row}
    for name, members in (("bounding_box", BOX), ("fix", FIX)):
        group = {member: row[member] for member in members if member in row}
        if group.keys() - {"sigma_m"}:
            values[name] = group
    return values


def json_scalar(name: str, value: Any) -> Any:
    """A time as RFC 3339, an id or class as text; everything else as it is."""
    if isinstance(value, datetime):
        return format_time(value)
    if name in ("target_id", "class"):
        # Ids of numbers alone become numbers in a frame, and floats where some are missing.
        return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
    return value


def sample_columns(samples: Iterable[Sample]) -> dict[str, list[Any]]:
    """Samples by column."""
    columns: dict[str, list[Any]] = {name: [] for name in SAMPLE_COLUMNS}
    for sample in samples:
        append_place(columns, sample)
        columns["class"].append(sample.class_)
        columns["score"].append(sample.score)
        for name, key in TRUTH.items():
            columns[name].append(getattr(sample.truth, key, None))
    return columns


def append_place(columns: dict[str, list[Any]], row: Sample | Observation) -> None:
    """Appends time, target, box and fix of a row."""
    columns["time"].append(row.time)
    columns["target_id"].append(row.target_id)
    for name in BOX:
        columns[name].append(getattr(row.bounding_box, name, None))
    for name in FIX:
        columns[name].append(getattr(row.fix, name, None))


def fusion_columns(fusions: list[FusedFix]) -> dict[str, list[Any]]:
    """Fused positions by column."""
    direct = (
        "confidence_regression",
        "confidence_gnss",
        "e_regression_m2",
        "e_gnss_m2",
        "reconstruction_error",
    )
    return {
        "time": [it.time for it in fusions],
        "target_id": [it.target_id for it in fusions],
        "longitude_deg": [it.fused.longitude_deg for it in fusions],
        "latitude_deg": [it.fused.latitude_deg for it in fusions],
        "r95_m": [it.r95_m for it in fusions],
        **{f"covariance_{name}": [getattr(it.covariance, name) for it in fusions] for name in COVARIANCE},
        "regressed_longitude_deg": [getattr(it.regressed, "longitude_deg", None) for it in fusions],
        "regressed_latitude_deg": [getattr(it.regressed, "latitude_deg", None) for it in fusions],
        **{name: [getattr(it, name) for it in fusions] for name in direct},
        "model_version": [it.model_version for it in fusions],
        # Not `flags`, which a frame has as an attribute of its own.
        "position_flags": [" ".join(it.flags) for it in fusions],
    }


TEXTS = ("target_id", "class", "position_flags", "camera_id", "site_id", "track_id")


def to_arrays(columns: Mapping[str, list[Any]]) -> dict[str, np.ndarray[Any, Any]]:
    """Columns as arrays: times as `datetime64[us]` in UTC, numbers as float64 with NaN, texts as objects."""
    try:
        import numpy as np  # noqa: PLC0415, an optional dependency
    except ImportError as error:
        raise ImportError("arrays need `pip install sightfix[numpy]`") from error
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    for name, values in columns.items():
        if name == "time":
            utc = [time.astimezone(UTC).replace(tzinfo=None) for time in values]
            arrays[name] = np.array(utc, dtype="datetime64[us]")
        elif name in TEXTS:
            arrays[name] = np.array(values, dtype=object)
        else:
            arrays[name] = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return arrays


def to_frame(columns: Mapping[str, list[Any]], index: Any = None) -> pd.DataFrame:
    """Columns as a frame; times have the time zone UTC."""
    try:
        import pandas as pd  # noqa: PLC0415, an optional dependency
    except ImportError as error:
        raise ImportError("frames need `pip install sightfix[pandas]`") from error
    frame = pd.DataFrame(to_arrays(columns), index=index)
    frame["time"] = frame["time"].dt.tz_localize("UTC")
    return frame


HISTORY_NAMES = ("camera_id", "site_id", "track_id", "target_id", "class")
ACCELERATION = (
    "east_mps2",
    "north_mps2",
    "covariance_east_m2_s4",
    "covariance_north_m2_s4",
    "covariance_east_north_m2_s4",
)
INTERVALS = ("speed_interval_mps", "course_interval_deg")


def history_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Positions of finished tracks, as JSON has them, by column."""
    low_and_high = {
        f"{name}_{bound}": [(row.get(name) or (None, None))[at] for row in rows]
        for name in INTERVALS
        for at, bound in enumerate(("low", "high"))
    }
    return {
        "time": [datetime.fromisoformat(row["time"]) for row in rows],
        **{name: [row.get(name) for row in rows] for name in HISTORY_NAMES},
        "longitude_deg": [row["position"]["longitude_deg"] for row in rows],
        "latitude_deg": [row["position"]["latitude_deg"] for row in rows],
        **{f"covariance_{name}": [row["covariance"][name] for row in rows] for name in COVARIANCE},
        "speed_mps": [row["speed_mps"] for row in rows],
        "course_deg": [row.get("course_deg") for row in rows],
        **low_and_high,
        "stationary_probability": [row["stationary_probability"] for row in rows],
        **{
            f"acceleration_{name}": [(row.get("acceleration") or {}).get(name) for row in rows] for name in ACCELERATION
        },
    }


def to_geo_frame(frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with its positions as points (WGS 84) if geopandas is installed, else as it is."""
    try:
        import geopandas as gpd  # noqa: PLC0415, an optional dependency
    except ImportError:
        return frame
    points = gpd.points_from_xy(frame["longitude_deg"], frame["latitude_deg"])
    geo_frame: pd.DataFrame = gpd.GeoDataFrame(frame, geometry=points, crs="EPSG:4326")
    return geo_frame
