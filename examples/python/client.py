"""A client of sightfix: trains a camera, then tracks targets live.

REST for single requests (cameras, training runs, tracks), gRPC for the stream.
"""

import argparse
import csv
import importlib.resources
import os
import pathlib
import sys
import tempfile
import threading
import time
import urllib.parse

import grpc
import requests
from grpc_tools import protoc

PROTO = pathlib.Path(__file__).resolve().parents[2] / "proto"
IN_FLIGHT = 64  # unanswered items; the server buffers 256 answers for a slow reader
ATTEMPTS = 8  # consecutive attempts to reconnect


def import_messages(folder):
    """Compiles proto/ into a folder; returns the modules of the messages and of the service."""
    google = importlib.resources.files("grpc_tools") / "_proto"
    files = [str(path.relative_to(PROTO)) for path in sorted(PROTO.rglob("*.proto"))]
    out = [f"--python_out={folder}", f"--grpc_python_out={folder}"]
    if protoc.main(["protoc", f"-I{PROTO}", f"-I{google}", *out, *files]) != 0:
        sys.exit("proto/ cannot be compiled")
    sys.path.insert(0, str(folder))
    from sightfix.v1 import fusion_service_pb2, fusion_service_pb2_grpc, values_pb2

    return fusion_service_pb2, fusion_service_pb2_grpc, values_pb2


class Client:
    """One camera of one server."""

    def __init__(self, server, camera, messages, key=None):
        self.server, self.camera = server.rstrip("/"), camera
        self.messages, services, self.values = messages
        self.headers = {"authorization": f"Bearer {key}"} if key else {}
        channel = grpc.insecure_channel(urllib.parse.urlsplit(server).netloc)
        self.fusion = services.FusionServiceStub(channel)

    # --- REST -----------------------------------------------------------------------------------

    def rest(self, method, path, **arguments):
        """Sends a request; raises an error with the title and detail of a problem (RFC 9457)."""
        answer = requests.request(method, self.server + path, headers=self.headers, timeout=30, **arguments)
        if not answer.ok:
            problem = answer.json()
            raise RuntimeError(f"{method} {path}: {problem['title']}: {problem.get('detail', '')}")
        return answer

    def create_camera(self, image_size):
        profile = {"id": self.camera}
        if image_size:
            width, height = image_size.split("x")
            profile["image_size"] = {"width_px": int(width), "height_px": int(height)}
        self.rest("POST", "/v1/cameras", json=profile)

    def train(self):
        """Starts a training run and waits for its end; returns the run."""
        path = self.rest("POST", f"/v1/cameras/{self.camera}/training-runs", json={}).headers["location"]
        while True:
            run = self.rest("GET", path).json()
            if run["state"] not in ("queued", "running"):
                return run
            time.sleep(0.5)

    def tracks(self):
        """The latest positions of the tracks, as GeoJSON."""
        return self.rest("GET", f"/v1/cameras/{self.camera}/tracks").json()["features"]

    # --- gRPC -----------------------------------------------------------------------------------

    def item(self, seq, row):
        """A row of a file as an item of the stream; empty fields are omitted."""
        item = self.messages.StreamItem(seq=seq, target_id=row["target_id"])
        item.time.FromJsonString(row["time"])
        if row["left"]:
            sides = {f"{side}_px": float(row[side]) for side in ("left", "top", "width", "height")}
            item.bounding_box.CopyFrom(self.values.BoundingBox(**sides))
        if row["longitude"]:
            degrees = {f"{angle}_deg": float(row[angle]) for angle in ("longitude", "latitude")}
            item.fix.CopyFrom(self.values.Fix(**degrees))
        return item

    def stream_items(self, rows, store_samples):
        """Streams rows; yields the answers. Returns once all rows are answered and, with store_samples,
        acknowledged. The seq of a row is its number from 1. After a broken connection another stream
        resumes after the last completed item; sending an item twice is harmless.
        """
        done, failed = 0, 0
        while done < len(rows):
            try:
                for event in self.one_stream(rows, done, store_samples):
                    kind = event.WhichOneof("kind")
                    if kind == "answer":
                        yield event.answer
                        failed = 0
                    if kind == "acknowledgement" and store_samples:
                        done = event.acknowledgement.seq
                    elif kind == "answer" and not store_samples:
                        done = event.answer.seq
            except grpc.RpcError as error:
                failed += 1
                if error.code() != grpc.StatusCode.UNAVAILABLE or failed > ATTEMPTS:
                    raise
                print(f"the connection broke after {done}: {error.details()}", file=sys.stderr)
                time.sleep(min(0.1 * 2**failed, 5.0))

    def one_stream(self, rows, done, store_samples):
        """One stream from its opening to its end; yields the messages of the server."""
        window = threading.Semaphore(IN_FLIGHT)
        ending = threading.Event()

        def requests_of_client():
            opening = self.messages.StreamOpening(
                camera_id=self.camera,
                client_name="python-example",
                resume_after_seq=done,
                store_samples=store_samples,
            )
            yield self.messages.StreamRequest(opening=opening)
            for seq in range(done + 1, len(rows) + 1):
                window.acquire()
                if ending.is_set():
                    return  # half-close: the server sends its last acknowledgement, then closes
                yield self.messages.StreamRequest(item=self.item(seq, rows[seq - 1]))

        lost = 0
        try:
            for event in self.fusion.Stream(requests_of_client(), metadata=list(self.headers.items())):
                kind = event.WhichOneof("kind")
                if kind == "answer":
                    # A dropped answer frees its place in the window, too.
                    window.release(1 + event.answer.lost_answers - lost)
                    lost = event.answer.lost_answers
                elif kind == "reconnect":
                    ending.set()
                    window.release()
                elif kind == "camera_moved":
                    print("the camera has moved: train it again", file=sys.stderr)
                yield event
        finally:
            ending.set()
            window.release()


def read_rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--server", default="http://127.0.0.1:8080")
    arguments.add_argument("--camera", required=True, help="id of the camera to create")
    arguments.add_argument("--image-size", metavar="WIDTHxHEIGHT")
    arguments.add_argument("training", help="CSV of boxes and fixes for training")
    arguments.add_argument("live", help="CSV of boxes and fixes to track")
    given = arguments.parse_args()

    with tempfile.TemporaryDirectory() as folder:
        # A key on the command line could be read by every user of the machine.
        key = os.environ.get("SIGHTFIX_API_KEY")
        client = Client(given.server, given.camera, import_messages(folder), key)
        client.create_camera(given.image_size)

        rows = read_rows(given.training)
        refused = [answer for answer in client.stream_items(rows, True) if answer.HasField("error")]
        print(f"{len(rows)} rows are acknowledged, {len(refused)} of them refused")
        for answer in refused[:5]:
            print(f"  row {answer.seq}: {answer.error.field}: {answer.error.message}")

        run = client.train()
        if run["state"] != "succeeded":
            sys.exit(f"the run has {run['state']}: {run.get('outcome')}")
        print(f"model {run['model_version']} is trained")

        rows, tracked = read_rows(given.live), 0
        for answer in client.stream_items(rows, False):
            if answer.HasField("track"):
                tracked += 1
                track, position = answer.track, answer.track.position
                degrees = f"{position.longitude_deg:.7f} {position.latitude_deg:.7f}"
                print(f"{track.time.ToJsonString()} {track.target_id} {degrees} within {track.r95_m:.1f} m")
        if tracked == 0:
            sys.exit("no target was tracked")

        features = client.tracks()
        for feature in features:
            about, (longitude, latitude) = feature["properties"], feature["geometry"]["coordinates"]
            print(f"last seen: {about['target_id']} at {longitude} {latitude}, {about['time']}")
        if not features:
            sys.exit("the server has no tracks")


if __name__ == "__main__":
    main()
