"""The commands accept all that pages and comments on a study and a collection name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from xplain.cli.people import load_config, server_of
from xplain.experiment.config import CONF
from xplain.people.plan import LabQuestion, make_typed
from xplain.people.study.flow import ENDS

DOCS = Path(__file__).parents[2] / "docs"
SETTING = re.compile(r"`([a-z][\w.]*=[^`]+)`")
OF_FILES = ("hydra.searchpath", "types", "key")
"""Settings that need a file, or are no key."""


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
    for ending in (*ENDS, "full"):
        codes = server_of(load_config(kind, [f"server.codes={{{ending}: ABC}}"])).codes
        assert codes[ending] == "ABC"
        assert codes == dict.fromkeys((*ENDS, "full"), "") | {ending: "ABC"}


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
