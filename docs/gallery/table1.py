"""A small Table 1: the paper's solvers on rescue at two prices of a message, three seeds."""

import xplain

if __name__ == "__main__":
    sweep = xplain.sweep(
        *("domain=rescue", "labeler=truth", "traces=5", "tracking=none"),
        solver=["qmdp", "pomcp_paper", "qhr", "baseline"],
        trade_off=[0.5, 2],
        seed=[0, 1, 2],
    )
    print(sweep.answer)
    sweep.plot("cost")[0].get_figure(root=True).savefig("table1.png", dpi=120)
