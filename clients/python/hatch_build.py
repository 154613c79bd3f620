"""Writes the generated modules before a wheel is built or the package is installed for development.

With `WHEEL_BINARY` the wheel also brings that program, as the command `sightfix`; it is then for one platform, whose
tag is `WHEEL_PLATFORM` or, if that is not set, the one of this machine.
"""

import os
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class GenerateModules(BuildHookInterface[Any]):
    """Runs codegen on the descriptions of the server's interfaces."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Generates `sightfix.models`, `sightfix.v1` and `sightfix._sync`; adds the program."""
        root = Path(self.root)
        sys.path.insert(0, str(root))
        from codegen import write_modules  # noqa: PLC0415, only importable from here

        write_modules(root)
        binary = os.environ.get("WHEEL_BINARY")
        if binary:
            machine = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["shared_scripts"][binary] = "sightfix"
            build_data["tag"] = f"py3-none-{os.environ.get('WHEEL_PLATFORM', machine)}"
            build_data["pure_python"] = False
