"""`python -m codegen` writes the generated modules into `src`."""

from pathlib import Path

from codegen import write_modules

write_modules(Path(__file__).resolve().parents[1])
