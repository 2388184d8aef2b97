"""The base class of all test suites."""

from typing import Any

import pytest

from xplain.domains.base import Domain
from xplain.testing.chosen import Chosen


class Conformance:
    """A test suite. Each subclass tests one kind of component; its own subclasses choose the
    component.

    Attributes:
        chosen: the choice to test. To test something else, or many choices, override the fixture
            :meth:`component` instead.
        seed: seed of the component and of the data. Some tests also use the next seeds.
    """

    chosen: Chosen
    seed = 0

    @pytest.fixture
    def component(self) -> Any:
        """The component, for every test of the suite."""
        return self.chosen.component


class DomainUser(Conformance):
    """A suite for components that need a domain."""

    @pytest.fixture(scope="class")
    def domain(self) -> Domain:
        """The domain, rescue by default; override it for components of another domain."""
        return Chosen("domain", "rescue").component
