"""What all clients have: where the servers are, an interface that records, choices from a seed, and a wish to end."""

import dataclasses
import datetime
import itertools
import random
from collections.abc import Iterator
from multiprocessing.synchronize import Event
from pathlib import Path

from .api import Api
from .record import Recorder

START = datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC)
FIX = {"longitude_deg": 103.98678, "latitude_deg": 30.628, "sigma_m": 1.5}
BOX = {"left_px": 475, "top_px": 11, "width_px": 28, "height_px": 77}


@dataclasses.dataclass(frozen=True)
class Ways:
    """Where clients reach the servers, and where the servers reach the receiver of webhooks."""

    url: str
    #: For streams over gRPC.
    stream_url: str
    node_urls: list[str]
    hook_port: int


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a client knows: where the servers are, its key, and the seed of its choices."""

    client: str
    ways: Ways
    key: str
    seed: int
    history: Path
    epochs: int
    #: Where webhooks are received.
    hook_port: int
    #: All pauses are so many times as long.
    pause_factor: float


class Client:
    """What all clients have: an interface that records, choices, and a wish to end."""

    def __init__(self, setting: Setting, ending: Event) -> None:
        self.setting = setting
        self.chance = random.Random(f"{setting.seed} {setting.client}")  # noqa: S311
        self.recorder = Recorder(setting.history / f"{setting.client}.ndjson", setting.client)
        self.api = Api(setting.ways.url, setting.key, self.recorder)
        self._ending = ending

    def steps(self, pause_s: float) -> Iterator[int]:
        """Counts from 1, with pauses of about `pause_s` seconds, until the client is to end."""
        for step in itertools.count(1):
            if self._ending.wait(self.chance.uniform(0.5, 1.5) * pause_s * self.setting.pause_factor):
                return
            yield step

    @property
    def is_ending(self) -> bool:
        """Whether it is to end."""
        return self._ending.is_set()


def at(seconds: float) -> str:
    """A time of the past, which no wrong clock takes for the future, as the server writes it."""
    text, _, fraction = (START + datetime.timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%S.%f").partition(".")
    return text + f".{fraction}".rstrip("0").rstrip(".") + "Z"
