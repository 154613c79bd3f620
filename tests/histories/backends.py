"""Where servers store: a data folder, or PostgreSQL with fsync on and, where it is wanted, a standby."""

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from signal import SIGCONT, SIGSTOP

from .links import free_port
from .processes import Disk, HarnessError, Process, checked, is_superuser, until

DISK_MB = 512
REPLICATIONS = ("none", "asynchronous", "synchronous")
END_CONNECTIONS = (
    "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity "
    "WHERE datname = current_database() AND pid <> pg_backend_pid()"
)
#: Write-ahead log that a primary keeps for a standby which is late.
KEPT_LOG = "64MB"


class DataFolder:
    """A folder with a database of SQLite."""

    name = "folder"
    most_nodes = 1

    def __init__(self, folder: Path) -> None:
        self.disk = Disk(folder / "disk", DISK_MB)
        self._data = self.disk.folder / "data"

    def arguments(self, _port: int) -> list[str]:
        """Flags of a server that stores here."""
        return ["--data", str(self._data)]

    def stored_bytes(self) -> int:
        """Bytes of the database and its log."""
        return sum(file.stat().st_size for file in self._data.glob("sightfix.db*"))

    def stop(self) -> None:
        """Removes it."""
        self.disk.remove()


class Instance:
    """A running server of PostgreSQL on a disk of its own."""

    def __init__(self, folder: Path, name: str, make: Callable[["Instance"], list[str]]) -> None:
        self.port = free_port()
        self.disk = Disk(folder / name, DISK_MB)
        self.data = self.disk.folder / "data"
        self._log = folder / f"{name}.log"
        self._binaries = binaries()
        if is_superuser():
            checked("chown", "nobody", self.disk.folder)
        checked(*self._as_owner(), *make(self))
        self.process = self._run()
        self.keep_running()

    def program(self, name: str) -> str:
        """Path of one of PostgreSQL's programs."""
        return str(self._binaries / name)

    def _as_owner(self) -> list[str]:
        """The server refuses to run as the superuser."""
        return ["setpriv", "--reuid", "nobody", "--regid", "nogroup", "--clear-groups"] if is_superuser() else []

    def _run(self) -> Process:
        settings = {
            "listen_addresses": "127.0.0.1", "unix_socket_directories": "", "fsync": "on", "max_connections": "200",
            "max_wal_size": KEPT_LOG, "wal_keep_size": KEPT_LOG, "wal_receiver_timeout": "5s",
            "wal_retrieve_retry_interval": "200ms",
        }  # fmt: skip
        flags = [part for name, value in settings.items() for part in ("-c", f"{name}={value}")]
        command = [*self._as_owner(), self.program("postgres"), "-D", str(self.data), "-p", str(self.port), *flags]
        return Process(command, self._log, {"PATH": "/usr/bin:/bin"}, Path("/"))

    def sql(self, statement: str) -> str | None:
        """What a statement gives; none if the server does not answer."""
        url = f"postgres://postgres@127.0.0.1:{self.port}/postgres?connect_timeout=2"
        asked = subprocess.run([self.program("psql"), url, "-Atqc", statement], capture_output=True, text=True,
                               timeout=60, check=False)  # fmt: skip
        return asked.stdout.strip() if asked.returncode == 0 else None

    def keep_running(self) -> None:
        """Waits until the server answers; starts it again if it has ended."""

        def answers() -> bool:
            if self.process.exit_code() is not None:
                # Refused as long as a process of the one before is alive.
                self.process = self._run()
            return self.sql("SELECT 1") == "1"

        until(answers, f"PostgreSQL in {self.data} answers")

    def remove(self) -> None:
        """Kills it and deletes its files."""
        self.process.signal(SIGCONT)
        self.process.kill()
        self.disk.remove()


class PostgreSQL:
    """A primary, and a standby where there is replication."""

    name = "postgres"
    most_nodes = 5

    def __init__(self, folder: Path, replication: str) -> None:
        self._folder = folder
        self._count = 0
        self.replication = replication
        self.primary = self._instance(self._fresh)
        self.standby = self._new_standby() if replication != "none" else None

    def _instance(self, make: Callable[[Instance], list[str]]) -> Instance:
        self._count += 1
        return Instance(self._folder, f"database-{self._count}", make)

    @staticmethod
    def _fresh(new: Instance) -> list[str]:
        return [new.program("initdb"), "-D", str(new.data), "-U", "postgres", "-E", "UTF8", "--locale=C.UTF-8",
                "-A", "trust", "--wal-segsize=4"]  # fmt: skip

    def _copy(self, new: Instance) -> list[str]:
        source = f"host=127.0.0.1 port={self.primary.port} user=postgres application_name=standby"
        return [new.program("pg_basebackup"), "-D", str(new.data), "-d", source, "-R", "-X", "stream", "-c", "fast"]

    def _new_standby(self) -> Instance:
        """A copy of the primary that follows it; changes of a synchronous one wait for it from then on."""
        standby = self._instance(self._copy)
        until(lambda: self._standbys() == "1", "the standby follows")
        if self.replication == "synchronous":
            self.primary.sql("ALTER SYSTEM SET synchronous_standby_names = 'standby'")
            self.primary.sql("SELECT pg_reload_conf()")
            until(lambda: self._standbys("sync_state = 'sync'") == "1", "the standby is synchronous")
        return standby

    def _standbys(self, condition: str = "state = 'streaming'") -> str | None:
        return self.primary.sql(f"SELECT count(*) FROM pg_stat_replication WHERE {condition}")  # noqa: S608

    @property
    def disk(self) -> Disk:
        """The disk of the primary."""
        return self.primary.disk

    def port(self) -> int:
        """Where the primary answers."""
        return self.primary.port

    def arguments(self, port: int) -> list[str]:
        """Flags of a server that reaches the primary at a port."""
        return ["--database", f"postgres://postgres@127.0.0.1:{port}/postgres"]

    def kill(self) -> None:
        """Kills all processes of the primary."""
        self.primary.process.kill()

    def pause(self) -> None:
        """Stops the processes of the primary without ending them."""
        self.primary.process.signal(SIGSTOP)

    def resume(self) -> None:
        """Lets them go on."""
        self.primary.process.signal(SIGCONT)

    def end_connections(self) -> None:
        """Ends all connections of the primary."""
        self.primary.sql(END_CONNECTIONS)

    def stop_replication(self) -> None:
        """Has the standby receive nothing more, so that a fail-over loses what follows."""
        if self.standby is not None:
            self.standby.sql("ALTER SYSTEM SET primary_conninfo = ''")
            self.standby.sql("SELECT pg_reload_conf()")

    def fail_over(self) -> None:
        """Kills the primary and has the standby take its place, with a new standby.

        Raises:
            HarnessError: There is no standby.
        """
        if self.standby is None:
            raise HarnessError("there is no standby")
        old, new = self.primary, self.standby
        old.process.kill()
        new.sql("ALTER SYSTEM RESET synchronous_standby_names")
        new.sql("SELECT pg_reload_conf()")
        if new.sql("SELECT pg_promote()") != "t":
            raise HarnessError("the standby is not promoted")
        self.primary = new
        old.remove()

    def replace_standby(self) -> None:
        """Makes a standby of the primary of now."""
        self.standby = self._new_standby()

    def keep_running(self) -> None:
        """Waits until the primary answers."""
        self.primary.keep_running()

    def stored_bytes(self) -> int:
        """Bytes of the database."""
        return int(self.primary.sql("SELECT pg_database_size(current_database())") or 0)

    def stop(self) -> None:
        """Ends and removes all of it."""
        for instance in filter(None, [self.standby, self.primary]):
            instance.remove()


def binaries() -> Path:
    """The folder of PostgreSQL's programs, of the newest version that is installed.

    Raises:
        HarnessError: There is none.
    """
    found = [file.parent for file in Path("/usr/lib/postgresql").glob("*/bin/initdb")]
    if not found:
        raise HarnessError("PostgreSQL is not installed: apt-get install postgresql")
    return max(found, key=lambda folder: [int(part) for part in re.findall(r"\d+", folder.parent.name)])
