"""The base of the suites, with the tested component."""

from __future__ import annotations

from typing import Any

import pytest

from xplain.testing.chosen import Chosen


class Conformance:
    """A suite. Its subclasses state properties; their subclasses choose what is tested.

    Attributes:
        chosen: the choice to test. To test something else, or many choices, override the fixture
            :meth:`component` instead.
    """

    chosen: Chosen

    @pytest.fixture
    def component(self) -> Any:
        """The component, for every test of the suite."""
        return self.chosen.component
