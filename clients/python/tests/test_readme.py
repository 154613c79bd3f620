"""The quick start of the README."""

import re
from pathlib import Path

import pytest

from sightfix import Client
from tests.conftest import ServerProcess

README = Path(__file__).resolve().parents[1] / "README.md"


def test_the_quick_start_runs_as_it_stands(
    server: ServerProcess,
    recording: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert code is not None
    recording[0].with_name("live.csv").write_bytes(recording[1].read_bytes())
    monkeypatch.chdir(recording[0].parent)
    # The server of the test has another port, and training takes a fraction of the time.
    lines = (
        code[1].replace("http://127.0.0.1:8080", server.url).replace('start("square")', 'start("square", epochs=20)')
    )
    exec(compile(lines, README, "exec"), {})  # noqa: S102
    printed = capsys.readouterr().out
    assert printed.startswith("240\n")
    assert "120 rows x 3 columns" in printed
    with Client(server.url) as client:
        assert client.samples.count("square").count == 360
