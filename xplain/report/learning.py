"""Of a sweep's learning stage: elbows, and how well types and labels were learned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from xplain.report.settings import setting_of
from xplain.report.summary import Summary


def elbows(summary: Summary, domain: str) -> dict[str, tuple[NDArray[np.float64], Counter[int]]]:
    """``{setting: (mean curve over seeds, how often each k was chosen)}``."""
    curves: dict[str, dict[int, NDArray[np.float64]]] = {}
    chosen: dict[str, dict[int, int]] = {}
    for job, results in summary.results:
        curve = results.elbow.disagreements
        if results.domain == domain and curve:
            name, seed = setting_of(job["values"]), results.seed
            curves.setdefault(name, {})[seed] = np.array(curve, dtype=float)
            chosen.setdefault(name, {})[seed] = len(results.types.found)
    means = {}
    for name, by_seed in curves.items():
        shortest = min(map(len, by_seed.values()))
        mean = np.mean([curve[:shortest] for curve in by_seed.values()], axis=0)
        means[name] = (mean, Counter(chosen[name].values()))
    return means


def learning(summary: Summary) -> dict[tuple[str, str], dict[str, float]]:
    """``{(domain, setting): figure: mean over seeds}`` of the learning stage."""
    found: dict[tuple[str, str], dict[int, Mapping[str, float]]] = {}
    for job, results in summary.results:
        key = (results.domain, setting_of(job["values"]))
        found.setdefault(key, {})[results.seed] = results.learning
    return {
        key: {
            name: float(np.mean([figures[name] for figures in by_seed.values()]))
            for name in next(iter(by_seed.values()))
            if all(name in figures for figures in by_seed.values())
        }
        for key, by_seed in found.items()
    }
