"""Every commented example in the configuration works as written."""

from __future__ import annotations

import re

import pytest
import yaml

from xplain.experiment.config import CONF
from xplain.people.plan import LabQuestion, make_typed

FILES = ("study.yaml", "collect/texts/en.yaml")
EXAMPLES = [
    (file, found)
    for file in FILES
    for found in re.findall(r"^#\s+- (\{name: .*\})$", (CONF / file).read_text("utf-8"), re.M)
]


@pytest.mark.parametrize(("file", "example"), EXAMPLES)
def test_commented_questions_can_be_asked(file: str, example: str) -> None:
    question = make_typed(LabQuestion, "questions", yaml.safe_load(example))
    assert question.label[0].isupper()
