"""The domain of examples/domain, with any number of facts."""

import sys
from typing import Any

from tests.conftest import ROOT

sys.path.append(str(ROOT / "examples" / "domain"))

from warehouse import Warehouse


def warehouse(facts: int, **changed: Any) -> Any:
    """Makes the warehouse with this number of facts."""
    return Warehouse(facts, **{"layout": 0, "wet": 2.0, "against": 2.0, "charge": 0.6} | changed)
