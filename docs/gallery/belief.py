"""A belief over time: a novice labels what they see, and the explainer learns the novice's type."""

import matplotlib.pyplot as plt
import numpy as np

from xplain import Explainer, GivenTypes

rng, p = np.random.default_rng(0), np.full((3, 8, 1), 0.9)
p[1, ::3], p[2, 1::3] = 0.4, 0.4  # what two of the three types often find inexplicable
session = Explainer(GivenTypes(p, (), ("expert", "novice", "guest"))).session(range(8))
beliefs = [session.belief]
while not session.finished:
    session.messages()
    session.observe(rng.random(session.shown) < p[1, : session.shown, 0])
    beliefs.append(session.belief)
for name in beliefs[0]:
    plt.plot([belief[name] for belief in beliefs], label=name, marker="o")
plt.xlabel("steps shown"), plt.ylabel("belief, a probability"), plt.legend()
plt.savefig("belief.png", dpi=120)
