"""The study's commands: each error is one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import Command


@pytest.mark.parametrize(
    ("module", "arguments", "said"),
    [
        ("xplain study", ["port=0"], "port=0: a whole number"),
        ("xplain study", ["port=many"], "port='many'"),
        ("xplain study", ["prot=1"], "did you mean port?"),
        ("xplain study", ["8080"], "key=value"),
        ("xplain study", ["server.entry=[anybody]"], "server.entry.0='anybody'"),
        ("xplain study", ["database=broken.sqlite"], "not a study's database"),
        ("xplain study", ["rules.per_cell=0"], "rules.per_cell=0"),
        ("xplain study", ["trace.start=[99,99]"], "trace.start=[99, 99]"),
        ("xplain study", ["trace.candidates=0"], "trace.candidates=0"),
        ("xplain study export", ["nothing.sqlite", "out"], "nothing.sqlite"),
        ("xplain study replay", ["broken.sqlite"], "not a study's database"),
        ("xplain study analyse", ["nowhere"], "participants.csv"),
        (
            "xplain study bots",
            ["--key", "k", "--url", "http://127.0.0.1:9"],
            "a running study",
        ),
    ],
)
def test_what_is_wrong_is_one_line(
    command: Command, tmp_path: Path, module: str, arguments: list[str], said: str
) -> None:
    (tmp_path / "broken.sqlite").write_text("broken " * 500)
    done = command(module, *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if "preparing" not in line]
    assert len(lines) == 1
    assert not (tmp_path / "outputs" / "study" / "study.sqlite").exists()
