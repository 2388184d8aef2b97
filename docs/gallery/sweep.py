"""A sweep: three solvers at five prices of a message."""

import xplain

if __name__ == "__main__":
    sweep = xplain.sweep(
        *("domain=rescue", "traces=10", "tracking=none"),
        solver=["qmdp", "qhr", "conformant"],
        trade_off=[0.5, 1, 1.5, 2, 2.5],
    )
    sweep.plot("cost")[0].get_figure(root=True).savefig("sweep.png", dpi=120)
