"""Tables of numpy and pandas."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sightfix import Client, ImageSize, Observation, live_items
from sightfix._tables import Table
from tests.conftest import ServerProcess


def test_a_frame_is_fused_as_its_rows_are(trained: ServerProcess, recording: tuple[Path, Path]) -> None:
    frame = pd.read_csv(recording[1]).set_index(pd.RangeIndex(1000, 1120))
    frame.loc[1003, ["longitude", "latitude"]] = np.nan
    with Client(trained.url) as client:
        fused = client.fusions.fuse_frame("square", frame)
        items = [
            Observation(time=it.time, target_id=it.target_id, bounding_box=it.bounding_box, fix=it.fix)
            for it in live_items(frame)
        ]
        expected = client.fusions.fuse_batch("square", items)
        columns = {name: frame[name].to_numpy() for name in frame.columns}
        arrays = client.fusions.fuse_arrays("square", columns)
    assert list(fused.index) == list(frame.index)
    assert list(fused["longitude_deg"]) == [it.fused.longitude_deg for it in expected]
    assert fused.position_flags.loc[1003] == " ".join(expected[3].flags)
    assert fused.covariance_east_north_m2.loc[1003] == expected[3].covariance.east_north_m2
    assert "gnss_denied" in expected[3].flags
    assert np.isnan(arrays["e_gnss_m2"][3])
    np.testing.assert_array_equal(arrays["latitude_deg"], fused["latitude_deg"].to_numpy())
    assert arrays["time"][0] == np.datetime64(str(frame["time"].iloc[0]).rstrip("Z"))


def test_frames_and_arrays_are_imported_and_read_back(client: Client, recording: tuple[Path, Path]) -> None:
    frame = pd.read_csv(recording[0])
    frame["time"] = pd.to_datetime(frame["time"])
    client.cameras.create(id="square", image_size=ImageSize(width_px=1280, height_px=720))
    assert client.samples.import_table("square", frame).accepted == 240
    columns = {name: frame[name].to_numpy() for name in frame.columns}
    columns["time"] = np.array(frame["time"].dt.tz_localize(None), dtype="datetime64[us]")
    assert client.samples.import_table("square", columns).duplicate == 240

    stored = client.samples.to_frame("square")
    assert len(stored) == 240
    assert str(stored["time"].dtype) == "datetime64[us, UTC]"
    np.testing.assert_array_equal(stored["left_px"], frame["left"])
    np.testing.assert_array_equal(stored["truth_latitude_deg"], frame["truth_latitude"])
    assert list(client.samples.to_arrays("square", has_fix=False)["time"]) == []
    # What was read can be imported again.
    assert client.samples.import_table("square", stored).duplicate == 240


def test_a_bad_row_of_a_table_is_rejected_by_its_number(client: Client) -> None:
    client.cameras.create(id="yard")
    frame = pd.DataFrame(
        {
            "time": [pd.Timestamp("2026-01-01T12:00:00Z"), pd.Timestamp("2026-01-01T12:00:01Z"), pd.NaT],
            "target_id": ["a", "b", "c"],
            "left": [1.0, 2.0, 3.0],
            "top": [1.0, 2.0, 3.0],
            "width": [10.0, np.nan, 10.0],
            "height": [20.0, 20.0, 20.0],
        }
    )
    imported = client.samples.import_table("yard", frame)
    assert (imported.accepted, imported.accepted_without_fix) == (1, 1)
    assert [row.line for row in imported.rejected_rows] == [2, 3]


def test_ids_of_numbers_stay_texts(client: Client) -> None:
    client.cameras.create(id="yard")
    box = {"left": [1, 1], "top": [1, 1], "width": [10, 10], "height": [20, 20]}
    times = ["2026-01-01T12:00:00Z", "2026-01-01T12:00:01Z"]
    for ids in (pd.Series([7, 8]), pd.Series([7.0, 8.0])):
        client.samples.import_table("yard", {"time": times, "target_id": ids, **box})
    assert [it.target_id for it in client.samples.list("yard")] == ["7", "8"]
    assert [it.target_id for it in live_items({"time": times, "target_id": np.array([7, 8])})] == ["7", "8"]


def test_tables_that_would_be_misread_are_refused(client: Client) -> None:
    naive = datetime(2026, 1, 1, 12)
    box = {"left": [1], "top": [1], "width": [1], "height": [1]}
    refused: list[tuple[Table, str]] = [
        ({"time": [naive], "target_id": ["a"], **box}, "UTC offset"),
        ({"time": pd.Series([pd.Timestamp(naive)]), "target_id": ["a"], **box}, "UTC offset"),
        ({"time": [naive.replace(tzinfo=UTC)], "x": [1]}, "unknown columns: x"),
        ({"time": [naive.replace(tzinfo=UTC)], "target_id": []}, "shorter"),
    ]
    for table, reason in refused:
        with pytest.raises(ValueError, match=reason):
            client.samples.import_table("yard", table)
