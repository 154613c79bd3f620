"""A service that one would write instead of sightfix: FastAPI, PyTorch on the processor, and SQLite.

The same three endpoints with the same paths and bodies: samples of a camera are stored, a run trains
the camera's auto-encoder, and observations are fused with the weights of the paper's (6) to (8). No
access control, no limits, no tracks; a batch with one bad row is refused as a whole.

    SERVICE_DATA=FOLDER uvicorn service:app --workers 2 --no-access-log
"""

import asyncio
import csv
import io
import math
import os
import sqlite3
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, NotRequired

import torch
from fastapi import FastAPI, HTTPException, Request, Response
from pydantic import AwareDatetime, BaseModel, Field, TypeAdapter, ValidationError
from torch import Tensor, nn
from torch.nn.functional import mse_loss
from typing_extensions import TypedDict

INPUTS, HIDDEN = 4, 32
EPOCHS, BATCH, LEARNING_RATE = 100, 512, 0.005
RECEIVER_SIGMA_M = 2.5  # of fixes that state none
CHI2_95 = 5.991  # two degrees of freedom
EARTH_RADIUS_M = 6_371_008.8
POLL_S = 0.5

# The nets are so small that a second thread costs more than it gives; the other core has its own worker.
torch.set_num_threads(1)

SCHEMA = """
CREATE TABLE IF NOT EXISTS samples (
    camera TEXT NOT NULL, time_us INTEGER NOT NULL, target TEXT NOT NULL,
    left_px REAL NOT NULL, top_px REAL NOT NULL, width_px REAL NOT NULL, height_px REAL NOT NULL,
    longitude_deg REAL NOT NULL, latitude_deg REAL NOT NULL, sigma_m REAL,
    PRIMARY KEY (camera, time_us, target)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS runs (id INTEGER PRIMARY KEY, camera TEXT NOT NULL, state TEXT NOT NULL, error TEXT);
CREATE TABLE IF NOT EXISTS models (number INTEGER PRIMARY KEY, camera TEXT NOT NULL, weights BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS models_by_camera ON models (camera, number);
"""
INSERT = "INSERT INTO samples VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING"
BOXES_AND_FIXES = (
    "SELECT left_px, top_px, width_px, height_px, longitude_deg, latitude_deg, sigma_m FROM samples WHERE camera = ?"
)


def connect() -> sqlite3.Connection:
    path = Path(os.environ.get("SERVICE_DATA", ".")) / "service.db"
    database = sqlite3.connect(path, timeout=30, check_same_thread=False)
    # FULL flushes at every commit, as sightfix does unless told otherwise.
    database.executescript("PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL;")
    return database


# Bodies -----------------------------------------------------------------------------------------------

Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Sigma = Annotated[float, Field(ge=0.001, le=10_000)]


class BoundingBox(BaseModel):
    left_px: Finite
    top_px: Finite
    width_px: Size
    height_px: Size


class Position(BaseModel):
    longitude_deg: Longitude
    latitude_deg: Latitude


class Fix(Position):
    sigma_m: Sigma | None = None


class Observation(BaseModel):
    time: AwareDatetime
    target_id: str | None = None
    bounding_box: BoundingBox
    fix: Fix | None = None


class Batch(BaseModel):
    observations: Annotated[list[Observation], Field(min_length=1, max_length=1000)]


class Fused(BaseModel):
    time: datetime
    target_id: str | None
    fused: Position
    regressed: Position
    confidence_regression: float
    confidence_gnss: float
    e_regression_m2: float
    e_gnss_m2: float | None
    r95_m: float
    reconstruction_error: float
    model_version: int


class FusedBatch(BaseModel):
    items: list[Fused]


# Rows come by thousands, and dictionaries are checked in half the time of models.
class SampleBox(TypedDict):
    left_px: Finite
    top_px: Finite
    width_px: Size
    height_px: Size


class SampleFix(TypedDict):
    longitude_deg: Longitude
    latitude_deg: Latitude
    sigma_m: NotRequired[Sigma | None]


class Sample(TypedDict):
    time: AwareDatetime
    target_id: str
    bounding_box: SampleBox
    fix: SampleFix


class CsvRow(TypedDict):
    time: AwareDatetime
    target_id: str
    left: Finite
    top: Finite
    width: Size
    height: Size
    longitude: Longitude
    latitude: Latitude
    sigma_m: NotRequired[Sigma | None]


class Imported(BaseModel):
    accepted: int
    duplicate: int


class Run(BaseModel):
    id: int
    camera_id: str
    state: str
    error: str | None = None


SAMPLES = TypeAdapter(list[Sample])
CSV_ROWS = TypeAdapter(list[CsvRow])
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def microseconds(time: datetime) -> int:
    since = time - EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds


def rows_of_json(camera: str, body: bytes) -> list[tuple[Any, ...]]:
    return [
        (camera, microseconds(sample["time"]), sample["target_id"], box["left_px"], box["top_px"], box["width_px"],
         box["height_px"], fix["longitude_deg"], fix["latitude_deg"], fix.get("sigma_m"))
        for sample in SAMPLES.validate_json(body)
        for box, fix in [(sample["bounding_box"], sample["fix"])]
    ]  # fmt: skip


def rows_of_csv(camera: str, body: bytes) -> list[tuple[Any, ...]]:
    reader = csv.reader(io.StringIO(body.decode()))
    names = next(reader, [])
    # Empty cells are left out, so that optional ones need no case of their own.
    cells = ({name: cell for name, cell in zip(names, line, strict=True) if cell} for line in reader if line)
    return [
        (camera, microseconds(row["time"]), row["target_id"], row["left"], row["top"], row["width"], row["height"],
         row["longitude"], row["latitude"], row.get("sigma_m"))
        for row in CSV_ROWS.validate_python(list(cells))
    ]  # fmt: skip


# The model --------------------------------------------------------------------------------------------


def features(left: float, top: float, width: float, height: float) -> tuple[float, float, float, float]:
    """Foot point, width and height of a box, px."""
    return left + width / 2, top + height, width, height


class AutoEncoder(nn.Module):
    """Net of one camera, whose bottleneck is the standardised position in the plane about the origin."""

    input_mean: Tensor
    input_std: Tensor
    position_mean_m: Tensor
    position_std_m: Tensor
    origin_deg: Tensor
    error_scale_m2: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(INPUTS, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, 2))
        self.decoder = nn.Sequential(nn.Linear(2, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, INPUTS))
        self.register_buffer("input_mean", torch.zeros(INPUTS))
        self.register_buffer("input_std", torch.ones(INPUTS))
        self.register_buffer("position_mean_m", torch.zeros(2))
        self.register_buffer("position_std_m", torch.ones(2))
        self.register_buffer("origin_deg", torch.zeros(2, dtype=torch.float64))
        self.register_buffer("error_scale_m2", torch.ones(()))

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (east, north) in m and reconstruction errors of boxes, given by their features."""
        inputs = (inputs - self.input_mean) / self.input_std
        positions = self.encoder(inputs)
        errors = (self.decoder(positions) - inputs).square().mean(1)
        return positions * self.position_std_m + self.position_mean_m, errors


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    metres = math.radians(EARTH_RADIUS_M)
    return metres * math.cos(math.radians(latitude_deg)), metres


def fit(rows: list[tuple[Any, ...]]) -> AutoEncoder:
    """Trains a net on rows of BOXES_AND_FIXES: loss (1), Adam, and Es by the ratio of the means of (4)."""
    if len(rows) < 2 * BATCH // 10:
        raise ValueError(f"{len(rows)} samples are too few")
    torch.manual_seed(1)
    # Degrees in f64: f32 has steps of metres there.
    table = torch.tensor(
        [[*features(*row[:4]), *row[4:6], row[6] or RECEIVER_SIGMA_M] for row in rows], dtype=torch.float64
    )
    degrees = table[:, 4:6]
    net = AutoEncoder()
    net.origin_deg.copy_(degrees.mean(0))
    scale = torch.tensor(metres_per_degree(net.origin_deg[1].item()), dtype=torch.float64)
    places = ((degrees - net.origin_deg) * scale).float()
    boxes = table[:, :4].float()
    net.input_mean.copy_(boxes.mean(0))
    net.input_std.copy_(boxes.std(0))
    net.position_mean_m.copy_(places.mean(0))
    net.position_std_m.copy_(places.std(0))
    inputs = (boxes - net.input_mean) / net.input_std
    targets = (places - net.position_mean_m) / net.position_std_m
    optimiser = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(rows)).split(BATCH):
            x, z = inputs[batch], targets[batch]
            regressed = net.encoder(x)
            loss = mse_loss(net.decoder(regressed), x) + mse_loss(regressed, z)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
        schedule.step()
    with torch.inference_mode():
        positions, errors = net(boxes)
        # The residuals hold the error of the fixes, too.
        variance = (positions - places).square().mean() - table[:, 6].square().mean()
        net.error_scale_m2.copy_(variance.clamp(min=0.01) / errors.mean())
    return net.eval()


class Served:
    """A net with its constants as Python numbers, which cost less per observation than tensors."""

    def __init__(self, number: int, net: AutoEncoder) -> None:
        self.number, self.net = number, net
        self.longitude, self.latitude = net.origin_deg.tolist()
        self.east_m, self.north_m = metres_per_degree(self.latitude)
        self.error_scale_m2 = net.error_scale_m2.item()

    def position(self, east_m: float, north_m: float) -> Position:
        return Position(
            longitude_deg=self.longitude + east_m / self.east_m, latitude_deg=self.latitude + north_m / self.north_m
        )

    def fuse(self, observations: list[Observation]) -> list[Fused]:
        boxes = [
            features(box.left_px, box.top_px, box.width_px, box.height_px)
            for box in (observation.bounding_box for observation in observations)
        ]
        with torch.inference_mode():
            positions, errors = self.net(torch.tensor(boxes))
        return [
            self.weigh(observation, east_m, north_m, error)
            for observation, (east_m, north_m), error in zip(
                observations, positions.tolist(), errors.tolist(), strict=True
            )
        ]

    def weigh(self, observation: Observation, east_m: float, north_m: float, error: float) -> Fused:
        variance = max(error * self.error_scale_m2, 0.01)
        fix, of_fix, confidence = observation.fix, None, 1.0
        fused_east_m, fused_north_m, fused_variance = east_m, north_m, variance
        if fix is not None:
            of_fix = (fix.sigma_m or RECEIVER_SIGMA_M) ** 2
            confidence = of_fix / (of_fix + variance)
            fix_east_m = (fix.longitude_deg - self.longitude) * self.east_m
            fix_north_m = (fix.latitude_deg - self.latitude) * self.north_m
            fused_east_m = confidence * east_m + (1 - confidence) * fix_east_m
            fused_north_m = confidence * north_m + (1 - confidence) * fix_north_m
            fused_variance = confidence * variance
        return Fused(
            time=observation.time,
            target_id=observation.target_id,
            fused=self.position(fused_east_m, fused_north_m),
            regressed=self.position(east_m, north_m),
            confidence_regression=confidence,
            confidence_gnss=1 - confidence,
            e_regression_m2=variance,
            e_gnss_m2=of_fix,
            r95_m=math.sqrt(CHI2_95 * fused_variance),
            reconstruction_error=error,
            model_version=self.number,
        )


# The service ------------------------------------------------------------------------------------------

MODELS: dict[str, Served] = {}
DATABASE: sqlite3.Connection
# A connection is used by one thread at a time.
DATABASE_LOCK = threading.Lock()


def load_models() -> None:
    """Takes over the newest model of each camera, whichever process trained it."""
    with DATABASE_LOCK:
        newest = dict(DATABASE.execute("SELECT camera, max(number) FROM models GROUP BY camera").fetchall())
        stale = [number for camera, number in newest.items() if camera not in MODELS or MODELS[camera].number != number]
        weights = [
            DATABASE.execute("SELECT camera, number, weights FROM models WHERE number = ?", [number]).fetchone()
            for number in stale
        ]
    for camera, number, blob in weights:
        net = AutoEncoder()
        net.load_state_dict(torch.load(io.BytesIO(blob), weights_only=True))
        MODELS[camera] = Served(number, net.eval())


async def follow_models() -> None:
    while True:
        await asyncio.sleep(POLL_S)
        await asyncio.to_thread(load_models)


@asynccontextmanager
async def lifespan(_: FastAPI) -> AsyncIterator[None]:
    global DATABASE
    DATABASE = connect()
    DATABASE.executescript(SCHEMA)
    load_models()
    following = asyncio.create_task(follow_models())
    yield
    following.cancel()
    DATABASE.close()


app = FastAPI(lifespan=lifespan)


@app.get("/readyz")
async def ready() -> dict[str, int]:
    return {"pid": os.getpid()}


def store(camera: str, content_type: str, body: bytes) -> Imported:
    parse = rows_of_csv if content_type.startswith("text/csv") else rows_of_json
    try:
        rows = parse(camera, body)
    except (ValidationError, ValueError) as error:
        raise HTTPException(422, str(error)[:2000]) from error
    with DATABASE_LOCK, DATABASE:
        accepted = DATABASE.executemany(INSERT, rows).rowcount
    return Imported(accepted=accepted, duplicate=len(rows) - accepted)


@app.post("/v1/cameras/{camera}/samples")
async def import_samples(camera: str, request: Request) -> Imported:
    content_type, body = request.headers.get("content-type", ""), await request.body()
    return await asyncio.to_thread(store, camera, content_type, body)


def train(run: int, camera: str) -> None:
    with closing(connect()) as database:
        try:
            net = fit(database.execute(BOXES_AND_FIXES, [camera]).fetchall())
            weights = io.BytesIO()
            torch.save(net.state_dict(), weights)
        except Exception as error:
            with database:
                database.execute("UPDATE runs SET state = 'failed', error = ? WHERE id = ?", [str(error), run])
            raise
        with database:
            database.execute("INSERT INTO models (camera, weights) VALUES (?, ?)", [camera, weights.getvalue()])
            database.execute("UPDATE runs SET state = 'succeeded' WHERE id = ?", [run])


def begin(camera: str) -> int:
    with DATABASE_LOCK, DATABASE:
        run = DATABASE.execute("INSERT INTO runs (camera, state) VALUES (?, 'running')", [camera]).lastrowid
    assert run is not None
    return run


@app.post("/v1/cameras/{camera}/training-runs", status_code=202)
async def start_training(camera: str, response: Response) -> Run:
    run = await asyncio.to_thread(begin, camera)
    threading.Thread(target=train, args=(run, camera), daemon=True).start()
    response.headers["location"] = f"/v1/cameras/{camera}/training-runs/{run}"
    return Run(id=run, camera_id=camera, state="running")


def look_up(camera: str, run: int) -> tuple[str, str | None] | None:
    with DATABASE_LOCK:
        return DATABASE.execute("SELECT state, error FROM runs WHERE camera = ? AND id = ?", [camera, run]).fetchone()


@app.get("/v1/cameras/{camera}/training-runs/{run}")
async def training_run(camera: str, run: int) -> Run:
    found = await asyncio.to_thread(look_up, camera, run)
    if found is None:
        raise HTTPException(404, "there is no such run")
    return Run(id=run, camera_id=camera, state=found[0], error=found[1])


# Less than a thread's hand-over per observation: fusing runs in the event loop.
@app.post("/v1/cameras/{camera}/fusions")
async def fuse(
    camera: str, request: Annotated[Observation | Batch, Field(union_mode="left_to_right")]
) -> FusedBatch:
    model = MODELS.get(camera)
    if model is None:
        raise HTTPException(409, "the camera has no model")
    observations = request.observations if isinstance(request, Batch) else [request]
    return FusedBatch(items=model.fuse(observations))
