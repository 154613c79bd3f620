"""Processes of a run: started, ended, stopped, and what was on their way when they ended."""

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

#: A process that has not come up by then is at fault, s.
START_S = 180.0
PAUSE_S = 0.05


class HarnessError(Exception):
    """What the harness itself needs is missing or does not work."""


def is_superuser() -> bool:
    """Whether this process may mount and change users."""
    return os.geteuid() == 0


def checked(*command: str | Path) -> str:
    """Runs a command and gives its output.

    Raises:
        HarnessError: It failed.
    """
    ended = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        raise HarnessError(f"{' '.join(map(str, command))}: {ended.stderr.strip() or ended.stdout.strip()}")
    return ended.stdout.strip()


def until(condition: Callable[[], bool], what: str, within_s: float = START_S) -> None:
    """Waits for a condition.

    Raises:
        HarnessError: It did not hold in time.
    """
    end = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > end:
            raise HarnessError(f"{what}: not within {within_s:.0f} s")
        time.sleep(PAUSE_S)


class Process:
    """A process in a session of its own, so that a signal reaches all that it has started."""

    def __init__(self, command: list[str], log: Path, environment: dict[str, str], folder: Path) -> None:
        with log.open("ab") as output:
            self._child = subprocess.Popen(
                command, stdout=output, stderr=output, stdin=subprocess.DEVNULL, env=environment, cwd=folder,
                start_new_session=True,
            )  # fmt: skip

    @property
    def id(self) -> int:
        """The process id."""
        return self._child.pid

    def exit_code(self) -> int | None:
        """The exit code, none while it runs."""
        return self._child.poll()

    def signal(self, number: signal.Signals) -> None:
        """Sends a signal to it and all that it has started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._child.pid, number)

    def slow_flushes(self, delay_s: float, duration_s: float) -> None:
        """Makes each of its flushes to the disk take so much longer, and those of its children, for a while.

        Raises:
            HarnessError: It cannot be traced.
        """
        children = subprocess.run(["pgrep", "-P", str(self.id)], capture_output=True, text=True, check=False)
        traced = [part for number in [str(self.id), *children.stdout.split()] for part in ("-p", number)]
        delay = f"inject=fsync,fdatasync:delay_enter={round(delay_s * 1e6)}"
        command = ["strace", "-qq", "-f", "-o", "/dev/null", "-e", "trace=fsync,fdatasync", "-e", delay, *traced]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as tracer:
            try:
                _, reason = tracer.communicate(timeout=duration_s)
            except subprocess.TimeoutExpired:
                tracer.terminate()
                tracer.communicate()
            else:
                # It has ended before, with the process or for want of a right.
                if self.exit_code() is None:
                    raise HarnessError(f"strace cannot follow process {self.id}: {reason.strip()}")

    def kill(self) -> None:
        """Ends it at once."""
        self.signal(signal.SIGKILL)
        self._child.wait()

    def terminate(self, within_s: float) -> int:
        """Asks it to end and gives the exit code; kills it where it does not."""
        self.signal(signal.SIGTERM)
        try:
            return self._child.wait(within_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return -signal.SIGKILL


class Disk:
    """A folder that is a file system of its own and may be filled, where this process may mount one."""

    def __init__(self, folder: Path, megabytes: int) -> None:
        self.folder = folder
        self.is_own = is_superuser()
        folder.mkdir(parents=True)
        if self.is_own:
            image = folder.with_suffix(".image")
            checked("truncate", "-s", f"{megabytes}M", image)
            checked("mkfs.ext4", "-q", "-m", "0", image)
            checked("mount", "-o", "loop", image, folder)

    def fill(self) -> None:
        """Leaves no byte free."""
        subprocess.run(
            ["dd", "if=/dev/zero", f"of={self.folder / 'ballast'}", "bs=4096", "status=none"],
            stderr=subprocess.DEVNULL, check=False,
        )  # fmt: skip

    def free(self) -> None:
        """Gives the space back."""
        (self.folder / "ballast").unlink(missing_ok=True)

    def used_bytes(self) -> int:
        """Bytes of the files in it."""
        return sum(file.stat().st_blocks * 512 for file in self.folder.rglob("*") if file.is_file())

    def remove(self) -> None:
        """Unmounts it and deletes what is in it."""
        if self.is_own:
            checked("umount", "--lazy", self.folder)
            self.folder.with_suffix(".image").unlink()
        shutil.rmtree(self.folder, ignore_errors=True)
