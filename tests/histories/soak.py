"""A soak: the clients of a history without faults, and what the servers hold while they work."""

import dataclasses
import os
import statistics
import time
from pathlib import Path
from typing import Any

from .api import Api
from .cluster import Cluster
from .links import free_port
from .record import Recorder
from .running import Options, clients_at_work, servers, through
from .workloads import STORING, names

#: So small that all are reached in the first third of a soak of a minute, and rows come and go from then on.
SETTINGS = {
    "SIGHTFIX_LIMITS__SAMPLES_PER_CAMERA": "60", "SIGHTFIX_LIMITS__SAMPLE_OVERFLOW": "delete_oldest",
    "SIGHTFIX_LIMITS__AUDIT_ENTRIES": "50", "SIGHTFIX_LIMITS__KEYS": "10",
    "SIGHTFIX_LIMITS__ENDED_RUNS_PER_CAMERA": "3", "SIGHTFIX_LIMITS__MODELS_PER_CAMERA": "8",
    "SIGHTFIX_LIMITS__IDEMPOTENCY_KEYS": "50",
}  # fmt: skip
#: Points of the picture, and every which of them is a line of the table.
POINTS = 60
POINTS_PER_LINE = 5
#: Width and height of a panel of the picture, and its margin.
PANEL_PX = 200
MARGIN_PX = 24
#: What a figure of the last third may be above that of the second one, as a share and in its unit.
GROWTH = {"memory (MB)": (0.10, 8.0), "descriptors": (0.10, 16.0), "rows": (0.02, 20.0), "disk (MB)": (0.10, 8.0)}


@dataclasses.dataclass(frozen=True)
class Figures:
    """What all servers hold together at a time."""

    time_s: float
    values: dict[str, float]


def memory_mb(process: int) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{process}/status").read_text("ascii")
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def stored_rows(api: Api) -> int:
    """Rows of all that the clients change: samples, keys, runs, model versions and entries of the audit log."""
    cameras = [name for name in names() if name.startswith(STORING)]
    counts = [_answer(api, f"/v1/cameras/{camera}/samples/count")["count"] for camera in cameras]
    lists = ["/v1/keys", "/v1/audit", "/v1/cameras/runs/training-runs", "/v1/cameras/runs/models"]
    return int(sum(counts)) + sum(len(_answer(api, f"{path}?limit=1000")["items"]) for path in lists)


def _answer(api: Api, path: str) -> Any:
    read = api.send("soak", path, "GET", path, keep=lambda answer, _: answer)
    if not read.is_done:
        raise RuntimeError(f"{path}: {read.status} {read.answer}")
    return read.answer


def measure(cluster: Cluster, api: Api, began_s: float) -> Figures:
    """The figures of now."""
    processes = [node.process_id for node in cluster.nodes if node.process_id is not None]
    values = {
        "memory (MB)": sum(memory_mb(process) for process in processes),
        "descriptors": float(sum(len(os.listdir(f"/proc/{process}/fd")) for process in processes)),
        "rows": float(stored_rows(api)),
        "disk (MB)": cluster.backend.stored_bytes() / 1e6,
    }
    return Figures(time.monotonic() - began_s, values)


def soak(options: Options, folder: Path, duration_s: float) -> bool:
    """Measures while the clients work, prints the table and draws `soak.svg` as it goes; whether all stay flat."""
    points: list[Figures] = []
    print(f"| time (s) | {' | '.join(GROWTH)} |\n|---:|{'---:|' * len(GROWTH)}", flush=True)
    with servers(options, folder, SETTINGS) as cluster:
        hook_port = free_port()
        api = Api(cluster.url, cluster.admin_key, Recorder(Path(os.devnull), "soak"), timeout_s=30)
        with clients_at_work(options, cluster, through([], cluster, hook_port), folder, hook_port) as clients:
            began_s = time.monotonic()
            for point in range(1, POINTS + 1):
                time.sleep(max(0.0, began_s + point * duration_s / POINTS - time.monotonic()))
                points.append(measure(cluster, api, began_s))
                if point % POINTS_PER_LINE == 0:
                    print(line(points[-1]), flush=True)
                # Who ends a soak early has what was measured until then.
                (folder / "soak.svg").write_text(picture(points), encoding="utf-8")
            clients.end()
    return stays_flat(points)


def picture(points: list[Figures]) -> str:
    """A panel for each figure over the time, from 0 on, as SVG."""
    panels = "".join(panel(name, points, number) for number, name in enumerate(GROWTH))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {len(GROWTH) * PANEL_PX} {PANEL_PX}" '
        f'font-family="sans-serif" font-size="11">\n{panels}</svg>\n'
    )


def panel(name: str, points: list[Figures], number: int) -> str:
    """The panel of one figure: its name, its largest value and the time at the ends of the axes, and a line."""
    size, left, most = PANEL_PX - 2 * MARGIN_PX, number * PANEL_PX + MARGIN_PX, max(one.values[name] for one in points)
    until_s, bottom = points[-1].time_s, PANEL_PX - MARGIN_PX
    path = " ".join(
        f"{left + size * one.time_s / until_s:.1f},{bottom - size * one.values[name] / (most or 1.0):.1f}"
        for one in points
    )
    return (
        f'<rect x="{left}" y="{MARGIN_PX}" width="{size}" height="{size}" fill="#fff" stroke="#888"/>\n'
        f'<polyline points="{path}" fill="none" stroke="#06c" stroke-width="1.5"/>\n'
        f'<g fill="#888"><text x="{left}" y="{MARGIN_PX - 6}">{name}, up to {most:.0f}</text>\n'
        f'<text x="{left}" y="{bottom + 14}">0</text>'
        f'<text x="{left + size}" y="{bottom + 14}" text-anchor="end">{until_s:.0f} s</text></g>\n'
    )


def line(point: Figures) -> str:
    """A line of the table."""
    return f"| {point.time_s:.0f} | {' | '.join(f'{point.values[name]:.0f}' for name in GROWTH)} |"


def stays_flat(points: list[Figures]) -> bool:
    """Prints which figures have grown; whether none has."""
    grown = [name for name in GROWTH if has_grown(name, [point.values[name] for point in points])]
    print(f"grown: {', '.join(grown)}" if grown else "flat: no figure of the last third is above that of the second")
    return not grown


def has_grown(name: str, values: list[float]) -> bool:
    """Whether the median of the last third is above that of the second by more than is allowed."""
    third = len(values) // 3
    before, after = statistics.median(values[third : 2 * third]), statistics.median(values[2 * third :])
    share, amount = GROWTH[name]
    return after > before * (1 + share) + amount
