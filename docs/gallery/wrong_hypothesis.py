"""The price of a wrong hypothesis: costs with people nobody assumed and people as assumed."""

import matplotlib.pyplot as plt
import numpy as np

import xplain

SETTING = ("labeler=truth", "clusterer=perfect", "traces=10", "tracking=none")
kinds = ["exact", "expert", "union", "unseen", "all_wrong"]
runs = [xplain.run(*SETTING, explainee=kind).results.metrics for kind in kinds]
costs = [own["cost"] for own in runs]
intervals = np.transpose([(cost.mean - cost.low, cost.high - cost.mean) for cost in costs])
plt.bar(kinds, [cost.mean for cost in costs], yerr=intervals, capsize=4, label="this explainer")
plt.plot(kinds, [own["clairvoyant_cost"].mean for own in runs], "k_", ms=30, label="clairvoyant")
plt.xlabel("kind of user (explainee=)")
plt.ylabel("cost of an explanation, 95 % intervals"), plt.legend()
plt.savefig("wrong_hypothesis.png", dpi=120)
