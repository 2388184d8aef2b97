"""The domain of examples/domain: a third one, with as many facts as a test wants."""

from __future__ import annotations

import sys
from typing import Any

from tests.conftest import ROOT

sys.path.append(str(ROOT / "examples" / "domain"))

from warehouse import Warehouse


def warehouse(facts: int, **changed: Any) -> Any:
    """With this many facts that people may believe incorrectly."""
    return Warehouse(facts, **{"layout": 0, "wet": 2.0, "against": 2.0, "charge": 0.6} | changed)
