"""The command: a run with faults, one with planted violations, or the check of a history that is there."""

import argparse
import dataclasses
import json
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from .backends import REPLICATIONS, DataFolder, PostgreSQL
from .checks import History, check
from .nemesis import read_intervals
from .planted import Plant, in_groups, plants
from .processes import HarnessError
from .record import read_operations
from .running import ROOT, Options, make_history
from .soak import soak

#: Without faults at the end of a run, and for all of one with plants, s.
SETTLE_S = 6.0
PLANTED_S = 15.0
#: Findings of a check that are printed; the report has more.
MOST_PRINTED = 3
PROCESSES = "processes_end_as_they_should"


def arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(
        prog="tests/histories/run", description="Checks histories of sightfix under faults."
    )
    parser.add_argument("--seed", type=int, default=1, help="everything random of clients and faults comes from it")
    parser.add_argument("--faults", type=int, default=20, help="number of faults")
    parser.add_argument("--backend", choices=("folder", "postgres"), default="folder")
    parser.add_argument("--nodes", type=int, default=3, help="server processes on postgres, 1 to 5; a folder has one")
    parser.add_argument("--replication", choices=REPLICATIONS, default="none", help="of postgres, with fail-overs")
    parser.add_argument("--kinds", nargs="*", default=[], help="only these kinds of faults")
    parser.add_argument("--next", type=Path, metavar="BINARY", help="upgrade: rolling restarts start this one")
    parser.add_argument("--out", type=Path, help="folder of the history; must not exist")
    parser.add_argument("--check", type=Path, metavar="FOLDER", help="only check the history of a folder again")
    parser.add_argument("--planted", action="store_true", help="no faults: break promises on purpose, and find that")
    parser.add_argument("--soak", type=float, metavar="SECONDS", help="no faults: measure what the servers hold")
    parser.add_argument("--pause-factor", type=float, default=1.0, help="clients pause so many times as long")
    return parser.parse_args()


def checked(folder: Path, options: Options, of_processes: list[str]) -> dict[str, list[str]]:
    """Checks the history of a folder, and writes and prints what was found."""
    operations, intervals = read_operations(folder / "history"), read_intervals(folder / "faults.ndjson")
    history = History(operations, intervals, options.replication, options.backend == "folder")
    found = check(history) | {PROCESSES: of_processes}
    counts = {
        "faults": len(intervals), "operations": len(operations), "unknown": sum(one.is_unknown for one in operations),
        "refused": sum(one.is_refused for one in operations),
    }  # fmt: skip
    done = Counter(one.action for one in operations if one.is_done)
    write_report(folder, options, {**counts, "done": done, "findings": found})
    print(", ".join(f"{name} {count}" for name, count in counts.items()), f"of seed {options.seed}: {folder}")
    for name, findings in found.items():
        print(f"  {'FOUND' if findings else 'holds'}  {name.replace('_', ' ')}")
        for finding in findings[:MOST_PRINTED]:
            print(f"         {finding}")
    return found


def write_report(folder: Path, options: Options, content: dict[str, Any]) -> None:
    """Writes what is known of a run, and with which options it was made."""
    report = {"options": dataclasses.asdict(options), **content}
    (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def check_again(folder: Path) -> bool:
    """Checks a history that is there; whether nothing was found."""
    report = json.loads((folder / "report.json").read_text("utf-8"))
    return not any(checked(folder, Options(**report["options"]), report["findings"][PROCESSES]).values())


def find_planted(options: Options, folder: Path) -> bool:
    """Runs with all plants, a group at a time; whether each was found, and nothing else."""
    as_planted = True
    for number, group in enumerate(in_groups(plants())):
        of_group = folder / f"group-{number}"
        found = checked(of_group, options, make_history(options, of_group, group))
        as_planted &= judge(group, found)
    return as_planted


def judge(group: list[Plant], found: dict[str, list[str]]) -> bool:
    """Says of each plant whether it was found; whether the findings are those of the plants."""
    for plant in group:
        print(f"planted {plant.name}: {'found' if found[plant.check] else 'NOT FOUND'}")
    others = set(found) - {plant.check for plant in group}
    for name in others:
        if found[name]:
            print(f"not planted: {name}")
    return all(found[plant.check] for plant in group) and not any(found[name] for name in others)


def main() -> int:
    """Runs the command; 1 if a check has found something, 2 if the run could not be made."""
    given = arguments()
    # Servers and disks are removed at an end by a signal, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(2))
    try:
        if given.check is not None:
            return 0 if check_again(given.check) else 1
        most = DataFolder.most_nodes if given.backend == "folder" else PostgreSQL.most_nodes
        options = Options(
            given.seed, given.faults, given.backend, min(given.nodes, most), given.replication, given.kinds, SETTLE_S,
            str(given.next.resolve()) if given.next else None, given.pause_factor,
        )  # fmt: skip
        new = ROOT / "target" / "histories" / f"{given.backend}-{given.seed}-{int(time.time())}"
        folder = (given.out or new).resolve()
        if given.soak is not None:
            return 0 if soak(options, folder, given.soak) else 1
        if given.planted:
            return 0 if find_planted(dataclasses.replace(options, faults=0, settle_s=PLANTED_S), folder) else 1
        # What clients of a run saw that is ended early can be checked, too.
        folder.mkdir(parents=True)
        write_report(folder, options, {"findings": {PROCESSES: []}})
        return 1 if any(checked(folder, options, make_history(options, folder, [])).values()) else 0
    except HarnessError as error:
        print(f"the run could not be made: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
