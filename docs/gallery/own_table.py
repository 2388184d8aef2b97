"""Your own table: P(a step makes sense | type, message given). When is the message given?"""

import matplotlib.pyplot as plt
import numpy as np

from xplain import Explainer, GivenTypes

table = np.tile([[[0.95, 0.95]], [[0.60, 0.95]]], (1, 12, 1))  # the novice misses one fact
types = GivenTypes(table, messages=("fuel",), names=("expert", "novice"))
prices, told = np.linspace(0, 12, 49), []
for price in prices:
    session = Explainer(types, trade_off=float(price)).session(range(12))
    while not session.finished and not session.messages():
        session.observe([0] + [1] * (session.shown - 1))  # the first step puzzles them
    told.append(np.nan if session.finished else session.shown)
plt.plot(prices, told, "o")
plt.xlabel("λ, cost of a message"), plt.ylabel("step before which the message is given")
plt.yticks([1, 2, 3])
plt.savefig("own_table.png", dpi=120)
