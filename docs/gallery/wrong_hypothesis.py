"""The price of a wrong hypothesis: people whose facts nobody assumed, beside people as assumed."""

import matplotlib.pyplot as plt

import xplain

SETTING = ("labeler=truth", "clusterer=perfect", "traces=10", "tracking=none")
kinds = ["exact", "expert", "union", "unseen", "all_wrong"]
runs = [xplain.run(*SETTING, explainee=kind).results.metrics for kind in kinds]
plt.bar(kinds, [own["cost"].mean for own in runs], label="this explainer")
plt.plot(kinds, [own["clairvoyant_cost"].mean for own in runs], "k_", ms=30, label="clairvoyant")
plt.ylabel("cost of an explanation"), plt.legend()
plt.savefig("wrong_hypothesis.png", dpi=120)
