"""Compares two runs of `cargo bench`, which writes target/bench.json: copy that of before away first.

benches/compare.py BEFORE.json AFTER.json prints every number of rows that both runs have, before, after, and the
quotient. With --least 0.9 it fails if a ratio to a peer fell below that share of the one before.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

#: The column whose numbers are comparable between machines.
RATIO = "ratio"

Numbers = dict[tuple[str, str, str], float]


def numbers_of(run: dict[str, Any]) -> Numbers:
    """The numbers of a run by table, row and column."""
    return {
        (table["title"], row["name"], column): number
        for table in run["tables"]
        for row in table["rows"]
        for column, number in zip(table["columns"][1:], row["numbers"], strict=True)
    }


def main() -> int:
    """Prints the comparison; 1 if a ratio has fallen too far."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--least", type=float, default=0.0, help="smallest quotient of two ratios that passes")
    given = parser.parse_args()
    runs = [json.loads(file.read_text("utf-8")) for file in (given.before, given.after)]
    for name, run in zip(("before", "after"), runs, strict=True):
        print(f"{name}: version {run['version']}, {run['processor']}, {run['cores']} cores")
    before, after = map(numbers_of, runs)
    fallen = 0
    title = None
    for key in (key for key in before if key in after):
        if key[0] != title:
            title = key[0]
            print(f"\n### {title}\n\n| case | column | before | after | after / before |\n|---|---|---:|---:|---:|")
        quotient = after[key] / before[key] if before[key] else float("nan")
        has_fallen = key[2] == RATIO and quotient < given.least
        fallen += has_fallen
        print(f"| {key[1]} | {key[2]} | {before[key]:.6g} | {after[key]:.6g} | {quotient:.2f}{' FELL' * has_fallen} |")
    for name, missing in (("after", before.keys() - after.keys()), ("before", after.keys() - before.keys())):
        if missing:
            print(f"\nnot in the run {name}: {', '.join(sorted({title for title, _, _ in missing}))}")
    return 1 if fallen else 0


if __name__ == "__main__":
    sys.exit(main())
