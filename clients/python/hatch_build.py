"""Writes the generated modules before a wheel is built or the package is installed for development."""

import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class GenerateModules(BuildHookInterface[Any]):
    """Runs codegen on the descriptions of the server's interfaces."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Generates `sightfix.models`, `sightfix.v1` and `sightfix._sync`."""
        root = Path(self.root)
        sys.path.insert(0, str(root))
        from codegen import write_modules  # noqa: PLC0415, only importable from here

        write_modules(root)
