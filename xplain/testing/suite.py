"""The base class of all test suites."""

from typing import Any

import pytest

from xplain.testing.chosen import Chosen


class Conformance:
    """A test suite. Each subclass tests one kind of component; its own subclasses choose the
    component.

    Attributes:
        chosen: the choice to test. To test something else, or many choices, override the fixture
            :meth:`component` instead.
    """

    chosen: Chosen

    @pytest.fixture
    def component(self) -> Any:
        """The component, for every test of the suite."""
        return self.chosen.component
