"""`sightfix.v1`: protobuf messages and gRPC stubs, with type stubs."""

import importlib.resources
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

PLUGINS = ("protoc-gen-mypy", "protoc-gen-mypy_grpc")


def write_stubs(proto: Path, package: Path) -> None:
    """Compiles the files under `proto` into `package`/v1.

    The proto package `sightfix.v1` has the name of the Python package, so the generated imports hold as
    they are.

    Raises:
        subprocess.CalledProcessError: A file cannot be compiled; protoc has printed why.
    """
    outputs = [f"--{kind}_out={package.parent}" for kind in ("python", "grpc_python", "mypy", "mypy_grpc")]
    run_protoc(proto, *(f"--plugin={name}={plugin_path(name)}" for name in PLUGINS), *outputs)
    (package / "v1" / "__init__.py").write_text('"""Messages and services of the gRPC interface."""\n')


def run_protoc(proto: Path, *options: str) -> None:
    """Compiles the files of `sightfix.v1` under `proto`."""
    google = importlib.resources.files("grpc_tools") / "_proto"
    files = sorted(str(path.relative_to(proto)) for path in (proto / "sightfix").rglob("*.proto"))
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{proto}", f"-I{google}", *options, *files]
    subprocess.run(command, check=True)  # noqa: S603, fixed arguments


def plugin_path(name: str) -> str:
    """A plugin of protoc: on the path, as in an isolated build, or beside the interpreter."""
    return shutil.which(name) or f"{sysconfig.get_path('scripts')}/{name}"
