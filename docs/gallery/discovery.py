"""Discovery: finds user types in a table of labels. Its twelve people have two types."""

import numpy as np
import pandas as pd

import xplain

rng, rows = np.random.default_rng(0), []
for person in range(12):
    for _ in range(30):
        zone = rng.choice(["bridge", "river"])
        told = [place for place in ("bridge", "river") if rng.random() < 0.5]
        puzzled = zone == ("bridge" if person % 2 else "river") and zone not in told
        rows.append((f"p{person}", ";".join(told), int(not puzzled), zone))
found = xplain.discover(pd.DataFrame(rows, columns=["observer", "messages", "label", "zone"]))
print(found.frame())
found.plot()["messages"].savefig("discovery.png", dpi=120, bbox_inches="tight")
