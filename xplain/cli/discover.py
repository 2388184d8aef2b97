"""Finds the user types in people's labels: ``xplain discover data=FILE``.

The file is read as :mod:`xplain.learning.data.label_file` says. Into the folder ``output`` go

- ``types.npz``: the types and their labelers, as :class:`xplain.learning.saved.LearnedTypes`
  loads them (for ``xplain.Explainer``);
- ``assignment.csv``: the type of each observer;
- ``predictions.csv``, with ``predict=FILE``: the rows of FILE, and ``p``, the probability of the
  answer 1 of that observer;
- ``summary.json``: what is known of each type, and how it was found;
- ``curve.png`` (disagreements by number of types) or ``posterior.png`` (probability of each number
  of types), as the method has them, ``messages.png``: what each message does for each type, and
  ``calibration.png``: how likely held-out labels were said to be 1, against how many are.

The last line on standard output is one JSON object: ``n_types``, ``assignment`` {observer: type},
``method``, ``rule``, ``held_out`` (how well held-out labels are predicted, in nats a label, with
and without types; null where ``held_out=false``), ``held_out_log_likelihood`` (that with types),
``seconds``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from xplain.experiment.config import composed
from xplain.runs.discovery import discovery, require_writable


def main(arguments: list[str]) -> dict[str, Any]:
    """Finds the types and writes the files; returns what the command prints. ``arguments``
    override conf/discover.yaml."""
    cfg = composed("discover", arguments)
    folder = Path(cfg.output)
    require_writable(folder)
    found = discovery(cfg)
    found.save(folder)
    found.show(folder)
    return found.row
