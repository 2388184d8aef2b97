"""Studies and simulated participants, on a domain that the study has never seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.people.study.stand_in import FAULTLESS, street_study
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study


@pytest.fixture(scope="session")
def study() -> Study:
    return street_study()


@pytest.fixture
def person(study: Study) -> Callable[..., StudyBot]:
    def make(number: int = 0, habits: Habits = FAULTLESS) -> StudyBot:
        return StudyBot(study.plan, habits, np.random.default_rng(number))

    return make


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Keeps figures instead of writing them."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures
