"""Studies and simulated participants, on a domain that the study has never seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.people.study.stand_in import FAULTLESS, street_study
from xplain.people.study.bot import Habits, Person
from xplain.people.study.flow import Study


@pytest.fixture(scope="session")
def study() -> Study:
    return street_study()


@pytest.fixture
def person(study: Study) -> Callable[..., Person]:
    def make(number: int = 0, habits: Habits = FAULTLESS) -> Person:
        return Person(study.plan, habits, np.random.default_rng(number))

    return make
