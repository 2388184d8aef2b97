"""The commands of a study and a collection: each error is one line, and what pages and comments
name is taken."""

import re
from pathlib import Path

import pytest
import yaml

from tests.conftest import Run
from tests.people.collect.test_prepare import TABLE
from xplain.cli.people import load_config, server_of
from xplain.experiment.config import CONF
from xplain.people.plan import LabQuestion, make_typed
from xplain.people.study.flow import ENDS

DOCS = Path(__file__).parents[2] / "docs"
SETTING = re.compile(r"`([a-z][\w.]*=[^`]+)`")
OF_FILES = ("hydra.searchpath", "types", "key")
"""Settings that need a file, or are no key."""


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("study", ["port=0"], "port=0: a whole number"),
        ("study", ["port=many"], "port='many'"),
        ("study", ["prot=1"], "did you mean port?"),
        ("study", ["8080"], "key=value"),
        ("study", ["server.entry=[anybody]"], "server.entry.0='anybody'"),
        ("study", ["database=broken.sqlite"], "not a study's database"),
        ("study", ["rules.per_cell=0"], "rules.per_cell=0"),
        ("study", ["trace.start=[99,99]"], "trace.start=[99, 99]"),
        ("study", ["trace.candidates=0"], "trace.candidates=0"),
        ("study export", ["nothing.sqlite", "out"], "nothing.sqlite"),
        ("study replay", ["nothing.sqlite"], "nothing.sqlite"),
        ("study replay", ["broken.sqlite"], "not a study's database"),
        ("study analyse", ["nowhere"], "participants.csv"),
        ("study bots", ["--key", "k", "--url", "http://127.0.0.1:9"], "a running study"),
        ("collect", ["queries=independent"], "battery or adaptive"),
        ("collect", ["queries=adaptive", "queries.in_turn=true"], "queries.in_turn=True"),
        ("collect", ["briefing=some"], "briefing='some'"),
        ("collect", ["rules.people=1"], "rules.people=1"),
        ("collect", ["points=3"], "rules.repeats=2"),
        ("collect", ["transitions=nowhere.csv"], "nowhere.csv"),
        ("collect", ["facts=f.csv"], "only with transitions"),
        ("collect", ["transitions=own.csv", "briefing=assigned"], "they name no types"),
        ("collect", ["database=broken.sqlite"], "not a study's database"),
        ("collect", ["server.key=secret"], "server.key"),
    ],
)
def test_what_is_wrong_is_one_line(
    tmp_path: Path, run: Run, command: str, arguments: list[str], said: str
) -> None:
    (tmp_path / "broken.sqlite").write_text("broken " * 500)
    (tmp_path / "own.csv").write_text(TABLE.replace("cable.png", ""))
    code, _, error = run(command, *arguments)
    assert code == 2
    (line,) = [line for line in error.splitlines() if "preparing" not in line]
    assert said in line
    assert not [*(tmp_path / "outputs").rglob("*.sqlite")]


def settings() -> list[tuple[str, str]]:
    """Lists every ``key=value`` in the text of a page; placeholders are filled in."""
    found: list[tuple[str, str]] = []
    for kind in ("study", "collect"):
        text = (DOCS / f"{kind}.md").read_text(encoding="utf-8")
        spans = SETTING.findall(re.sub(r"```.*?```", "", text, flags=re.DOTALL))
        found += [
            (kind, span.replace("…", "XYZ"))
            for span in dict.fromkeys(spans)
            if span.split("=")[0] not in OF_FILES and not span.startswith(f"{kind} ")
        ]
    return found


@pytest.mark.parametrize(("kind", "setting"), settings())
def test_a_setting_that_a_page_names_is_taken(kind: str, setting: str) -> None:
    load_config(kind, re.split(r" (?=[\w.@/]+=)", setting))


@pytest.mark.parametrize("kind", ["study", "collect"])
def test_every_ending_can_have_a_code_of_its_own(kind: str) -> None:
    own = {ending: f"OF{number}" for number, ending in enumerate((*ENDS, "full"))}
    given = ", ".join(f"{ending}: {code}" for ending, code in own.items())
    assert server_of(load_config(kind, [f"server.codes={{{given}}}"])).codes == own
    alone = server_of(load_config(kind, ["server.codes={full: ABC}"])).codes
    assert alone == dict.fromkeys(own, "") | {"full": "ABC"}


COMMENTED = ("study.yaml", "collect/texts/en.yaml")
EXAMPLES = [
    (file, found)
    for file in COMMENTED
    for found in re.findall(r"^#\s+- (\{name: .*\})$", (CONF / file).read_text("utf-8"), re.M)
]


@pytest.mark.parametrize(("file", "example"), EXAMPLES)
def test_commented_questions_can_be_asked(file: str, example: str) -> None:
    question = make_typed(LabQuestion, "questions", yaml.safe_load(example))
    assert question.label[0].isupper()
