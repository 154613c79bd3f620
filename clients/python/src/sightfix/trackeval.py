"""Folders that TrackEval (https://github.com/JonathonLuiten/TrackEval) reads, of tracks on the ground.

TrackEval compares boxes by their overlap. Each position becomes a square on the ground about it, in metres where
TrackEval expects pixels, so that its figures (HOTA, CLEAR, Identity) are those of positions in the world.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

# The benchmark that TrackEval reads without rules of its own for classes and distractors.
SPLIT = "MOT15-train"


def write_trackeval(
    folder: str | Path,
    sequence: str,
    *,
    truth: str | Path,
    trackers: Mapping[str, str | Path],
    side_m: float = 3.0,
) -> None:
    """Writes `gt` and `trackers` below a folder, as TrackEval's `MotChallenge2DBox` of the benchmark MOT15 reads them.

    Args:
        folder: Where they are written.
        sequence: Name of the recording.
        truth: Lines `frame,id,-1,-1,-1,-1,confidence,x,y,z` of true positions, metres in the plane of the trackers.
        trackers: Files of the same form by name, as `History.export` writes them (`.txt`).
        side_m: Side of the squares. Two of them overlap by half or more where their centres are `side_m / 3` apart at
            most along a side, and 0.26 `side_m` along a diagonal.
    """
    folder = Path(folder)
    lines = {name: boxes(file, side_m) for name, file in trackers.items()}
    true_lines = boxes(truth, side_m)
    frames = max((frame for part in (true_lines, *lines.values()) for frame, _ in part), default=0)
    sequence_folder = folder / "gt" / SPLIT / sequence
    # Confidence, class and visibility of true boxes.
    write(sequence_folder / "gt" / "gt.txt", (f"{line},1,1" for _, line in true_lines))
    write(sequence_folder / "seqinfo.ini", ["[Sequence]", f"name={sequence}", f"seqLength={frames}"])
    write(folder / "gt" / "seqmaps" / f"{SPLIT}.txt", ["name", sequence])
    for name, part in lines.items():
        write(folder / "trackers" / SPLIT / name / "data" / f"{sequence}.txt", (line for _, line in part))


def boxes(file: str | Path, side_m: float) -> list[tuple[int, str]]:
    """Frames and lines `frame,id,left,top,width,height,confidence` of squares about the positions of a file."""
    rows = (line.split(",") for line in Path(file).read_text().splitlines() if line)
    return [(int(row[0]), square(row, side_m)) for row in rows]


def square(row: list[str], side_m: float) -> str:
    """The line of a square about the position of a row."""
    frame, number, *_, confidence, east_m, north_m, _height_m = row
    left_m, top_m = (float(centre) - side_m / 2 for centre in (east_m, north_m))
    return f"{frame},{number},{left_m:.3f},{top_m:.3f},{side_m},{side_m},{confidence}"


def write(file: Path, lines: Iterable[str]) -> None:
    """Writes lines to a file, and makes its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(f"{line}\n" for line in lines))
