"""What the suites share: the component that they test."""

from __future__ import annotations

from typing import Any

import pytest

from xplain.testing.chosen import Chosen


class Conformance:
    """A suite; its subclasses state the properties, and theirs say what is tested.

    Attributes:
        chosen: the choice to test. Whoever tests something else, or many choices, overrides the
            fixture :meth:`component` instead.
    """

    chosen: Chosen

    @pytest.fixture
    def component(self) -> Any:
        """What every test of the suite is given."""
        return self.chosen.component
