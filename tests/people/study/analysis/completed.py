"""Data of participants made by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd


def completed(n: int) -> pd.DataFrame:
    """Makes n completed participants in each condition, and a bot that would change all results."""
    rng = np.random.default_rng(0)
    rows = [
        {
            "participant": f"{condition}{i}",
            "stream": "person",
            "stage": "done",
            "type": "ABCDE"[i % 5],
            "condition": condition,
            "eligible": 1,
            "interaction_time_s": 100 + shift + rng.normal(0, 20),
            "inexplicable_transitions": int(rng.poisson(1)),
            "quiz_score": int(rng.integers(0, 5)),
            "visible_time_s": 90.0 + i,
            "messages_given": i % 4,
        }
        for condition, shift in (("conformant", 30), ("personalized", 0))
        for i in range(n)
    ]
    bot = rows[0] | {"participant": "bot", "stream": "bot", "interaction_time_s": 1e9}
    return pd.DataFrame([*rows, bot])
