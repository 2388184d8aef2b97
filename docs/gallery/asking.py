"""Asking: the more expensive a question, the fewer are asked, and the more an explanation costs."""

import matplotlib.pyplot as plt

import xplain

SETTING = ("labeler=truth", "clusterer=perfect", "traces=10", "discount=1", "tracking=none")
prices = [0.05, 0.1, 0.2, 0.3, 0.5, 1.0]
runs = [xplain.run(*SETTING, "ask=clips", ask_cost=price) for price in prices]
never = xplain.run(*SETTING).results.metrics["cost"].mean
plt.plot(prices, [run.results.metrics["cost"].mean for run in runs], "o-", label="asks")
plt.axhline(never, color="black", linestyle="--", label="never asks")
plt.xlabel("κ, cost of a question"), plt.ylabel("cost of an explanation"), plt.legend()
plt.savefig("asking.png", dpi=120)
