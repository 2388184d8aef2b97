"""Discovery: the user types in a table of labels. Two kinds of people, twelve in all."""

import numpy as np
import pandas as pd

import xplain

rng, rows = np.random.default_rng(0), []
for person in range(12):
    for _ in range(30):
        zone, told = rng.choice(["bridge", "river"]), rng.random() < 0.5
        puzzled = zone == ("bridge" if person % 2 else "river") and not told
        rows.append((f"p{person}", f"{zone}_is_safe" if told else "", int(not puzzled), zone))
found = xplain.discover(pd.DataFrame(rows, columns=["observer", "messages", "label", "zone"]))
print(found.frame())
found.plot()["messages"].savefig("discovery.png", dpi=120, bbox_inches="tight")
