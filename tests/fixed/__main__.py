"""Writes the reference runs again: ``python -m tests.fixed [NAME ...]``."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from tests.fixed.commands import RUNS

for name in sys.argv[1:] or RUNS:
    with tempfile.TemporaryDirectory() as folder:
        kept = RUNS[name](Path(folder))
    text = json.dumps(kept, ensure_ascii=False, indent=None, separators=(",", ":"))
    path = Path(__file__).with_name(f"{name}.json")
    path.write_text(text.replace('},{"of"', '},\n{"of"').replace("],[", "],\n[") + "\n", "utf-8")
    print(name, path.stat().st_size, flush=True)
