"""Collects labels from people in a web page: ``xplain collect domain=rescue``, or
``xplain collect transitions=TABLE.csv facts=FACTS.csv`` for one's own robot.

Before the first start it says what to expect, from simulated people. That start fixes the
collection in its database; later starts go on with it. How a lab does it: docs/collect.md.
"""

from functools import partial

from xplain.cli import people

main = partial(people.serve, "collect")
