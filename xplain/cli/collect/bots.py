"""Lets simulated people give labels in a running collection, over HTTP or in a real browser. They
are marked as bots in the data for ever, and never mixed with people.

    xplain collect bots --key KEY [--url http://127.0.0.1:8080] [--count 40] [--at-once 8]
        [--error 0.05] [--lapse 0] [--leaving 0] [--pace 0] [--chromium] [--seed 0] [--save FILE]

``--key``: the researcher's key, which the server prints; ``--error``: share of wrong answers;
``--lapse``: share of pages clicked through; ``--leaving``: chance to leave, a page; ``--pace``: 1
is real time; ``--save``: where the export (ZIP) goes afterwards. Every habit of
``xplain.people.collect.bot.Habits`` is a flag, such as ``--mistake 0.1``.
"""

from functools import partial

from xplain.cli import people

main = partial(people.bots, "collect")
