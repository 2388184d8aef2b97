"""Lets simulated participants take part in a running study, over HTTP or in a real browser. They
are marked as bots in the data for ever, and take nobody's place.

    xplain study bots --key KEY [--url http://127.0.0.1:8080] [--count 40] [--at-once 8]
        [--pace 0] [--leaving 0] [--chromium] [--seed 0] [--save FILE]

``--key``: the researcher's key, which the server prints; ``--pace``: 1 is real time;
``--leaving``: chance to leave, a page; ``--save``: where the export (ZIP) goes afterwards. Other
habits (``xplain.people.study.bot.Habits``) are flags too, such as ``--label-noise 0.1``.
"""

from functools import partial

from xplain.cli import people

main = partial(people.bots, "study")
