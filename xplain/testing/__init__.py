"""Suites that a component of your own inherits. Three lines test a package::

    from xplain.testing import Chosen, SolverConformance
    class TestMine(SolverConformance):
        component = Chosen("solver", "mine", conf="conf")

``component`` is the object itself, or :class:`Chosen` for what a YAML file makes, as the command
line would. Run them with pytest. Each test states a property that the rest of xplain relies on.
"""

from xplain.testing.chosen import Chosen
from xplain.testing.clusterer import ClustererConformance, PartitionConformance
from xplain.testing.domain import DomainConformance
from xplain.testing.labeler import LabelerConformance
from xplain.testing.solver import SolverConformance
from xplain.testing.types import TypeSourceConformance

__all__ = [
    "Chosen",
    "ClustererConformance",
    "DomainConformance",
    "LabelerConformance",
    "PartitionConformance",
    "SolverConformance",
    "TypeSourceConformance",
]
