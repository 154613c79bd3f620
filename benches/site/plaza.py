"""The gain of training the cameras of a real site together, on people whose phones no camera was trained on.

Usage: python3 benches/site/plaza.py FOLDER [SEED]

FOLDER is `../shared/data/plaza`; a release build is needed (SIGHTFIX, by default target/release/sightfix). The carriers of the
phones are known (identity.csv). Starts a server on a folder of its own, imports each camera's pairs and boxes without a fix,
trains every camera alone and then all together, and prints what the run reports. Its figures are of held-out phones;
the distances to the truth are of the boxes of people without a phone.
"""

import csv
import io
import json
import math
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

BINARY = os.environ.get("SIGHTFIX", "target/release/sightfix")
ADDRESS = "127.0.0.1:18088"
CAMERAS = ["c1", "c2", "c3"]
CSV = "text/csv"
ROWS_PER_REQUEST = 500


def ask(method: str, path: str, body: object = None, kind: str = "application/json") -> dict:
    data = body.encode() if isinstance(body, str) else json.dumps(body).encode() if body is not None else None
    request = urllib.request.Request(f"http://{ADDRESS}{path}", data, {"content-type": kind}, method=method)
    with urllib.request.urlopen(request, timeout=120) as answer:
        text = answer.read()
        return json.loads(text) if text[:1] == b"{" else {}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def written(table: list[dict[str, str]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]))
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()


def pairs(folder: Path, work: Path, camera: str, persons: dict[tuple[str, str], str]) -> str:
    """The camera's samples: boxes of carriers have the phone's id; boxes of others have no fix."""
    phones = {row["receiver_id"] for row in rows(folder / "fixes.csv")}

    def named(row: dict[str, str]) -> dict[str, str]:
        phone = persons.get((camera, row["target_id"]), "").replace("person", "phone")
        return row | {"target_id": phone if phone in phones else row["target_id"]}

    boxes, samples = work / f"{camera}.csv", work / f"{camera}_samples.csv"
    boxes.write_text(written([named(row) for row in rows(folder / f"detections_{camera}.csv")]))
    subprocess.run(
        [BINARY, "-q", "pair", "--detections", boxes, "--fixes", folder / "fixes.csv", "--out", samples]
        + ["--method", "interpolate", "--keep-unpaired"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return samples.read_text()


def ended(path: str) -> dict:
    while True:
        run = ask("GET", path)
        if run["state"] not in ("queued", "running", "cancelling"):
            assert run["state"] == "succeeded", run
            return run
        time.sleep(0.5)


def judged(folder: Path, camera: str, persons: dict[tuple[str, str], str]) -> tuple[float, float]:
    """Mean distance to the truth, m, and share of it inside the 95 % radius: boxes of people without a phone."""
    phones = {row["receiver_id"].replace("phone", "person") for row in rows(folder / "fixes.csv")}
    truth = {(row["time"], row["person"]): row for row in rows(folder / "truth.csv")}
    boxes = []
    for row in rows(folder / f"detections_{camera}.csv"):
        person = persons.get((camera, row["target_id"]))
        place = truth.get((row["time"], person)) if person not in phones else None
        if place:
            boxes.append((row, float(place["longitude"]), float(place["latitude"])))
    distances, inside = [], 0
    for first in range(0, len(boxes), ROWS_PER_REQUEST):
        some = boxes[first : first + ROWS_PER_REQUEST]
        observations = [
            {
                "time": row["time"],
                "bounding_box": {f"{side}_px": float(row[side]) for side in ("left", "top", "width", "height")},
            }
            for row, _, _ in some
        ]
        answers = ask("POST", f"/v1/cameras/{camera}/fusions", {"observations": observations})["items"]
        for answer, (_, longitude, latitude) in zip(answers, some):
            north_m = (answer["fused"]["latitude_deg"] - latitude) * 111_200
            east_m = (answer["fused"]["longitude_deg"] - longitude) * 111_200 * math.cos(math.radians(latitude))
            distances.append(math.hypot(east_m, north_m))
            inside += distances[-1] <= answer["r95_m"]
    return sum(distances) / len(distances), inside / len(distances)


def main() -> None:
    folder, seed = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    persons = {(row["camera"], row["target_id"]): row["person"] for row in rows(folder / "identity.csv")}
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        server = subprocess.Popen(
            [BINARY, "-q", "serve", "--listen", ADDRESS, "--data", work / "data"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            while True:
                try:
                    ask("GET", "/readyz")
                    break
                except OSError:
                    time.sleep(0.1)
            ask("POST", "/v1/sites", {"id": "plaza"})
            for camera in CAMERAS:
                ask("POST", "/v1/cameras", {"id": camera, "site": "plaza", "image_size": {"width_px": 1920, "height_px": 1080}})
                ask("POST", f"/v1/cameras/{camera}/samples", pairs(folder, work, camera, persons), CSV)
            alone = {}
            for camera in CAMERAS:
                run = ask("POST", f"/v1/cameras/{camera}/training-runs", {"seed": seed, "recipe": "gaussian_process"})
                ended(f"/v1/cameras/{camera}/training-runs/{run['id']}")
                alone[camera] = judged(folder, camera, persons)
            run = ended("/v1/sites/plaza/training-runs/" + ask("POST", "/v1/sites/plaza/training-runs", {"seed": seed})["id"])
            report = run["report"]
            print(f"{report['receivers']} receivers, {report['pairs']} pairs; versions active: {report['is_activated']}")
            print(f"cameras disagree by {report['disagreement_apart_m']:.2f} m apart, {report['disagreement_m']:.2f} m together\n")
            print("| camera | held-out phones, apart m | together m | truth, `gaussian_process` alone m | together m |")
            print("|---|---:|---:|---:|---:|")
            for finding in report["cameras"]:
                camera = finding["camera_id"]
                if not report["is_activated"]:
                    ask("PUT", f"/v1/cameras/{camera}/active-model", {"number": finding["model_version"]})
                together = judged(folder, camera, persons)
                figures = [f"{mean:.2f} ({100 * share:.0f} %)" for mean, share in (alone[camera], together)]
                print(
                    f"| {camera} | {finding['held_out_apart_m']:.2f} | {finding['held_out_m']:.2f} "
                    f"| {figures[0]} | {figures[1]} |"
                )
        finally:
            server.terminate()
            server.wait(30)


main()
