"""One explanation: what the robot says, what the person answers, and the belief."""

import xplain

run = xplain.run("domain=rescue", "traces=3", "tracking=none", trade_off=1.0)
run.plot()[0].get_figure(root=True).savefig("one_explanation.png", dpi=120)
