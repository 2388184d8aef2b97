"""Tables of measured figures are marked if they are older than their configuration or code."""

import json
import shutil
from pathlib import Path
from typing import ClassVar

import pytest

from tests.test_docs import module
from xplain.experiment.config import CONF

tables = module("tables")

ENTRIES = """
[solvers]
command = "python benchmarks/solvers.py"
configurations = ["domain=rescue solver=pomcp,qmdp"]
keys = ["solver"]
runs = ["rescue/qmdp*/cost"]

[swept]
command = "python -m xplain sweeps=two"
"""
BASE = """
traces: 30
hydra:
  sweeper:
    params: {solver: lookahead, lambda: "0.5,1", seed: range(10)}
    settings: [{domain: rescue}, {domain: four_rooms, users.count: 2}]
"""
SWEEP = """
defaults: [one, _self_]
hydra:
  sweeper:
    params: {solver: "qmdp,pomcp", clusterer: kmeans}
"""
PAGE = """# Figures

`python benchmarks/solvers.py`, then `python -m xplain sweeps=two`:

<!-- table: solvers -->
| solver | cost |
|---|---|
| pomcp | 1.40 ± .03 |

<!-- table: swept -->
| | λ = 1 |
|---|---|
| QMDP | .54 (.62) |

| key | meaning |
|---|---|
| lambda | 1 message costs so many labels |
| traces | how many |
"""

FIXED = "tests/fixed/rescue.json"


class Repository:
    """A page with two new tables, and a configuration that can be changed."""

    STAMPS: ClassVar[list[str]] = []
    """Digests before any change, because composing takes long."""

    def __init__(self, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.root, self.page, self._capsys = root, root / "docs" / "page.md", capsys
        for file, text in (
            (tables.ENTRIES, ENTRIES),
            (tables.STAMPS, "{}"),
            ("docs/page.md", PAGE),
            ("sweeps/one.yaml", BASE),
            ("sweeps/two.yaml", SWEEP),
            (FIXED, '{"qmdp λ=1": {"cost": 3.5, "bounds": 2}, "pomcp λ=1": {"cost": 3}}'),
        ):
            (root / file).parent.mkdir(parents=True, exist_ok=True)
            (root / file).write_text(text, encoding="utf-8")
        shutil.copytree(CONF, root / "conf", dirs_exist_ok=True)
        if not self.STAMPS:
            assert self.main("--stamp", "solvers", "swept") == 0
            self.STAMPS.append((root / tables.STAMPS).read_text(encoding="utf-8"))
        (root / tables.STAMPS).write_text(self.STAMPS[0], encoding="utf-8")

    def main(self, *arguments: str) -> int:
        """Returns the exit code; ``listed`` and ``wrong`` are the printed lines."""
        self._capsys.readouterr()
        code = tables.main(arguments, self.root)
        self.listed, self.wrong = self._capsys.readouterr()
        return code

    def change(self, file: str, old: str, new: str) -> None:
        path = self.root / file
        text = path.read_text(encoding="utf-8")
        assert old in text, file
        path.write_text(text.replace(old, new), encoding="utf-8")
        tables.composed.cache_clear()


@pytest.fixture
def repository(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Repository:
    return Repository(tmp_path, capsys)


def test_every_page_says_which_of_its_tables_are_older(capsys: pytest.CaptureFixture[str]) -> None:
    assert tables.main([]) == 0, capsys.readouterr().err


def test_a_table_is_older_than_a_default_a_map_or_a_run_that_changed(
    repository: Repository,
) -> None:
    repository.change("conf/solver/pomcp.yaml", "simulations: 6000", "simulations: 60")
    assert repository.main() == 1
    assert repository.listed == (
        "solvers: older: solver.simulations\nswept: older: solver.simulations\n"
    )
    repository.change("conf/solver/pomcp.yaml", "simulations: 60", "simulations: 6000")
    repository.change("conf/config.yaml", "labeler: practice", "labeler: tree")
    repository.change("conf/config.yaml", "discount: 0.95", "discount: 0.9")
    repository.change("conf/domain/four_rooms.yaml", "reward: 10.0", "reward: 9.0")
    repository.change("sweeps/one.yaml", "0.5,1", "0.5,1,2")
    repository.change(FIXED, "3.5", "3.25")
    assert repository.main() == 1
    assert repository.listed == (
        "solvers: older: tests/fixed/rescue/qmdp*/cost\n"
        "swept: older: discount, domain.parameters, labeler.classifier, labeler.confidence, "
        "lambda\n"
    )


def test_what_changes_no_figure_makes_no_table_older(repository: Repository) -> None:
    for file, old, new in (
        ("conf/config.yaml", "seed: 0 ", "seed: 7 "),
        ("conf/config.yaml", "traces: 20 ", "traces: 21 "),  # the sweep has its own
        ("conf/config.yaml", "# λ, the cost of", "# λ, the price of"),
        ("conf/domain/rescue.yaml", "message: ", "message: By the way, "),
        ("conf/solver/lookahead.yaml", "candidates: 16", "candidates: 17"),  # not in this sweep
        ("conf/clusterer/dirichlet.yaml", "chains: ", "chains: 1"),  # the default is not taken
        ("conf/solver/qmdp.yaml", "xplain.solvers.greedy.QMDP", "xplain.plans.QMDP"),
        (FIXED, '{"cost": 3.5, "bounds": 2}', '{\n  "bounds": 3,\n  "cost": 3.50}'),
    ):
        repository.change(file, old, new)
    assert repository.main() == 0
    assert repository.listed == "solvers: current\nswept: current\n"


def test_a_page_says_what_is_older_until_it_is_made_anew(repository: Repository) -> None:
    repository.change("conf/config.yaml", "discount: 0.95", "discount: 0.9")
    assert repository.main() == 1
    assert repository.main("--write") == 0
    assert repository.page.read_text(encoding="utf-8") == PAGE.replace(
        "<!-- table: swept -->\n", f"<!-- table: swept -->\n{tables.OLDER}\n\n"
    )
    assert repository.main() == 0
    assert repository.main("--stamp", "swept") == 1  # says older, and is current
    assert repository.main("--write") == 0
    assert repository.page.read_text(encoding="utf-8") == PAGE
    stamps = json.loads((repository.root / tables.STAMPS).read_text(encoding="utf-8"))
    assert stamps.keys() == {"solvers", "swept"}


def test_a_table_without_name_or_command_is_an_error(repository: Repository) -> None:
    for old, new, said in (
        ("<!-- table: swept -->", "", "no name above it"),
        ("<!-- table: swept -->", "<!-- table: sweep -->", "no name above it"),
        ("| traces | how many |", "| traces | 20 |", "no name above it"),
        ("xplain sweeps=", "xplain lambda=", "does not name its command"),
        ("| QMDP | .54 (.62) |", "| QMDP | about one half |", "no page has the table swept"),
    ):
        assert old in PAGE
        repository.page.write_text(PAGE.replace(old, new), encoding="utf-8")
        assert repository.main() == 1
        assert said in repository.wrong


def test_a_reference_run_that_there_is_not_is_named(repository: Repository) -> None:
    (repository.root / FIXED).unlink()
    with pytest.raises(FileNotFoundError, match="rescue"):
        repository.main()


def test_output_that_is_shown_is_no_table() -> None:
    assert list(tables.measured("```text\n| a | b |\n|---|---|\n| 1 | 2 |\n```\n")) == []
