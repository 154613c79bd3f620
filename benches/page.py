"""Writes the tables of a run of `cargo bench`, which are in target/bench.json, into docs/explanation/performance.md.

benches/page.py RUN.json

Each table replaces the one below the heading with its title, and the machine the line that begins with "Machine:".
Fails if the page has no place for a table.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent.parent / "docs/explanation/performance.md"
#: A heading and the table below it, with what is between them.
TABLE = r"(?m)^### {}\n\n((?:(?!\||#).*\n)*)((?:\|.*\n)+)"


def shown(number: float) -> str:
    """Three digits of small numbers, and all before the point."""
    if abs(number) >= 1_000:
        return f"{number:,.0f}"
    return f"{number:.2f}" if abs(number) < 10 else f"{number:.3g}"


def markdown(table: dict[str, Any]) -> str:
    """The table as Markdown."""
    lines = ["| " + " | ".join(table["columns"]) + " |", "|---|" + "---:|" * (len(table["columns"]) - 1)]
    lines += [f"| {row['name']} | {' | '.join(map(shown, row['numbers']))} |" for row in table["rows"]]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Writes the page; 1 if it has no place for a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    run = json.loads(parser.parse_args().run.read_text("utf-8"))
    page, missing = PAGE.read_text("utf-8"), []
    for table in run["tables"]:
        places = list(re.finditer(TABLE.format(re.escape(table["title"])), page))
        if len(places) != 1:
            missing.append(table["title"])
            continue
        page = page[: places[0].start(2)] + markdown(table) + page[places[0].end(2) :]
    machine = f"Machine: {run['processor']}, {run['cores']} cores; version {run['version']}."
    page, found = re.subn(r"(?m)^Machine: .*$", machine, page)
    if found != 1:
        missing.append("Machine:")
    if missing:
        print("the page has no single place for: " + "; ".join(missing), file=sys.stderr)
        return 1
    PAGE.write_text(page, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
