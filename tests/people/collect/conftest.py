"""A collection that nobody has answered yet."""

from __future__ import annotations

import pytest

from tests.people.collect.stand_in import street_collection
from xplain.people.collect.flow import Collection


@pytest.fixture(scope="session")
def collection() -> Collection:
    return street_collection()
