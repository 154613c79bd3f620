"""Joins the PNG files of a folder, in the order of their names, to an animated WebP: FOLDER OUT FRAME_MS."""

import sys
from pathlib import Path

from PIL import Image

folder, out, frame_ms = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
first, *others = [Image.open(path).convert("RGB") for path in sorted(folder.glob("*.png"))]
first.save(out, save_all=True, append_images=others, duration=frame_ms, loop=0, quality=60, method=6)
print(f"{out}: {1 + len(others)} frames, {out.stat().st_size} bytes")
