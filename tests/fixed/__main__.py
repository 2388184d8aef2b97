"""Writes the reference runs again: ``python -m tests.fixed [NAME ...]``."""

import json
import sys
import tempfile
from pathlib import Path

from tests.fixed.commands import RUNS

if __name__ == "__main__":  # the processes of `forked` import this file, too
    for name in sys.argv[1:] or RUNS:
        with tempfile.TemporaryDirectory() as folder:
            kept = RUNS[name](Path(folder))
        text = json.dumps(kept, ensure_ascii=False, indent=None, separators=(",", ":"))
        text = text.replace('},{"of"', '},\n{"of"').replace("],[", "],\n[")
        path = Path(__file__).with_name(f"{name}.json")
        path.write_text(text + "\n", "utf-8")
        print(name, path.stat().st_size, flush=True)
