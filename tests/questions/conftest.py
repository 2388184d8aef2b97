"""A task of two facts, solved by hand elsewhere."""

import pytest

from tests.domains.users.corridor import Corridor


@pytest.fixture(scope="session")
def corridor():
    return Corridor()
