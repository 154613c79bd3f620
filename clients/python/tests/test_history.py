"""The history of finished tracks as frames and files."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import geopandas as gpd
import pandas as pd
import pytest
import trackeval

from sightfix import Client, Fix, Observation
from sightfix.models import HistorySettings
from sightfix.trackeval import write_trackeval
from tests.conftest import ServerProcess

SECONDS = 40


@pytest.fixture
def walked(server: ServerProcess) -> Client:
    """A client of a server on whose history one target has walked to the east for 40 s."""
    start = datetime.now(UTC).replace(microsecond=0) - timedelta(minutes=10)
    with Client(server.url) as client:
        client.cameras.create(id="history", history=HistorySettings(keep_days=3))
        client.tracks.follow(
            "history",
            [
                Observation(
                    time=start + timedelta(seconds=second),
                    target_id="ann",
                    fix=Fix(longitude_deg=8.0 + 1.5e-5 * second, latitude_deg=47.0, sigma_m=0.5),
                )
                for second in range(SECONDS)
            ],
        )
    server.stop()
    server.start()
    return Client(server.url)


def test_a_history_is_a_frame_with_points(walked: Client) -> None:
    frame = walked.history.to_frame(camera="history")
    assert list(frame["target_id"].unique()) == ["ann"]
    assert isinstance(frame, gpd.GeoDataFrame)
    assert len(frame) == SECONDS
    assert frame["time"].is_monotonic_increasing
    assert frame["speed_mps"].between(0.9, 1.4).all()


def test_geopandas_reads_exported_files(walked: Client, tmp_path: Path) -> None:
    walked.history.export(tmp_path / "history.parquet", camera="history")
    read = gpd.read_parquet(tmp_path / "history.parquet")
    frame = walked.history.to_frame(camera="history")
    assert read.crs is not None
    assert read.crs.is_geographic
    pd.testing.assert_series_equal(pd.Series(read.geometry.x), frame["longitude_deg"], check_names=False)
    assert read["track_id"].tolist() == frame["track_id"].tolist()
    assert (read["time"] == frame["time"]).all()


def test_geopandas_reads_a_heat_map(walked: Client) -> None:
    cells = gpd.GeoDataFrame.from_features(walked.history.heat_map(camera="history", cell_m=5))
    assert cells["seconds"].sum() == pytest.approx(SECONDS - 1)
    assert (cells["visits"] == 1).all()
    assert cells.geometry.is_valid.all()


def test_trackeval_reads_tracks_and_compares_them(walked: Client, tmp_path: Path) -> None:
    start = walked.history.to_frame(camera="history")["time"].min()
    tracks = tmp_path / "tracks.txt"
    walked.history.export(tracks, camera="history", from_=start, origin=(8.0, 47.0), frame_hz=1)
    lines = tracks.read_text().splitlines()
    assert len(lines) == SECONDS
    truth = tmp_path / "truth.txt"
    # Another target, which nobody followed, stands 10 m to the north.
    standing = [f"{frame},9,-1,-1,-1,-1,1,0,10,0" for frame in range(1, SECONDS + 1)]
    truth.write_text("\n".join([*lines, *standing]))
    write_trackeval(tmp_path, "walk", truth=truth, trackers={"sightfix": tracks})

    config = {
        "GT_FOLDER": str(tmp_path / "gt"),
        "TRACKERS_FOLDER": str(tmp_path / "trackers"),
        "BENCHMARK": "MOT15",
        "PRINT_CONFIG": False,
    }
    dataset = trackeval.datasets.MotChallenge2DBox(config)
    raw = dataset.get_raw_seq_data("sightfix", "walk")
    data = dataset.get_preprocessed_seq_data(raw, "pedestrian")
    assert (data["num_timesteps"], data["num_gt_dets"], data["num_tracker_dets"]) == (SECONDS, 2 * SECONDS, SECONDS)
    figures = trackeval.metrics.CLEAR({"PRINT_CONFIG": False}).eval_sequence(data)
    assert figures["MOTA"] == pytest.approx(0.5)
    assert figures["MOTP"] == pytest.approx(1.0)
