"""Asking: if questions cost more, fewer questions are asked, and an explanation costs more."""

import xplain

SETTING = ("labeler=truth", "clusterer=perfect", "traces=10", "discount=1", "tracking=none")

if __name__ == "__main__":
    prices = [0.1, 0.2, 0.3, 0.5, 1.0]
    axes = xplain.sweep(*SETTING, "ask=clips", ask_cost=prices).plot("cost")[0]
    never = xplain.run(*SETTING).results.metrics["cost"].mean
    axes.axhline(never, color="black", linestyle="--", label="never asks")
    axes.set_xlabel("κ, cost of a question"), axes.legend(loc="lower right")
    axes.get_figure(root=True).savefig("asking.png", dpi=120)
