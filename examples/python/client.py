"""Trains a camera, then tracks targets live, with the Python client of sightfix."""

import argparse
import sys

import pandas
from sightfix import Client, ImageSize, JobFailedError, live_items


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--server", default="http://127.0.0.1:8080")
    arguments.add_argument("--camera", required=True, help="id of the camera to create")
    arguments.add_argument("--image-size", metavar="WIDTHxHEIGHT", required=True)
    arguments.add_argument("training", help="CSV of boxes and fixes for training")
    arguments.add_argument("live", help="CSV of boxes and fixes to track")
    given = arguments.parse_args()
    width_px, height_px = map(int, given.image_size.split("x"))

    # The API key comes from SIGHTFIX_API_KEY: on the command line every user of the machine could read it.
    with Client(given.server) as client:
        image_size = ImageSize(width_px=width_px, height_px=height_px)
        client.cameras.create(id=given.camera, image_size=image_size)
        store_samples(client, given.camera, given.training)
        try:
            run = client.training_runs.wait(client.training_runs.start(given.camera))
        except JobFailedError as error:
            sys.exit(str(error))
        print(f"model {run.model_version} is trained")
        track(client, given.camera, given.live)


def store_samples(client: Client, camera_id: str, file: str) -> None:
    """Streams a recording until the server has acknowledged all of it as samples."""
    rows, refused = 0, []
    items = live_items(pandas.read_csv(file))
    for answer in client.stream_items(camera_id, items, store_samples=True):
        rows += 1
        if answer.HasField("error"):
            refused.append(answer)
    print(f"{rows} rows are acknowledged, {len(refused)} of them refused")
    for answer in refused[:5]:
        print(f"  row {answer.seq}: {answer.error.field}: {answer.error.message}")


def track(client: Client, camera_id: str, file: str) -> None:
    """Streams a recording, and prints the position of each target while it moves and where it was seen last."""
    tracked = 0
    for answer in client.stream_items(camera_id, live_items(pandas.read_csv(file))):
        if answer.HasField("track"):
            tracked += 1
            target, position = answer.track, answer.track.position
            degrees = f"{position.longitude_deg:.7f} {position.latitude_deg:.7f}"
            print(f"{target.time.ToJsonString()} {target.target_id} {degrees} within {target.r95_m:.1f} m")
    tracks = client.tracks.list(camera_id)
    for feature in tracks:
        longitude_deg, latitude_deg = feature.geometry.coordinates
        state = feature.properties
        print(f"last seen: {state.target_id} at {longitude_deg} {latitude_deg}, {state.time.isoformat()}")
    if tracked == 0 or not tracks:
        sys.exit("no target was tracked")


if __name__ == "__main__":
    main()
