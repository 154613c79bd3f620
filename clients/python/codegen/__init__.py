"""Generates the modules of the package that follow from other sources.

- `sightfix.models` from docs/openapi.json,
- `sightfix.v1` (protobuf messages and gRPC stubs) from proto/,
- `sightfix._sync` from `sightfix._async`.

`python -m codegen` writes all of them into `src`.
"""

from pathlib import Path

from codegen.models import write_models
from codegen.stubs import write_stubs
from codegen.synchronous import write_synchronous


def write_modules(root: Path) -> None:
    """Writes the generated modules of the package whose pyproject.toml stands in `root`."""
    package = root / "src" / "sightfix"
    write_models(source(root, "docs/openapi.json", "openapi.json"), package / "models.py")
    write_stubs(source(root, "proto", "proto"), package)
    write_synchronous(package / "_async", package / "_sync")


def source(root: Path, in_repository: str, in_sdist: str) -> Path:
    """The path of an interface description: in the repository, or in an unpacked sdist."""
    paths = [root / in_sdist, root.parents[1] / in_repository]
    for path in paths:
        if path.exists():
            return path
    raise FileNotFoundError(f"none of {', '.join(map(str, paths))} exists")
