"""Joins the PNG files of a folder, which are named by their times in milliseconds, to an animated WebP: FOLDER OUT."""

import sys
from pathlib import Path

from PIL import Image

folder, out = Path(sys.argv[1]), Path(sys.argv[2])
times_ms = sorted(int(path.stem) for path in folder.glob("*.png"))
durations_ms = [later - time for time, later in zip(times_ms, times_ms[1:])]
# The last frame has no end of its own.
first, *others = [Image.open(folder / f"{time}.png").convert("RGB") for time in times_ms[:-1]]
first.save(out, save_all=True, append_images=others, duration=durations_ms, loop=0, quality=60, method=6)
print(f"{out}: {1 + len(others)} frames, {out.stat().st_size} bytes")
