"""The commands of a collection; each docstring is the command's help."""

from __future__ import annotations

from xplain.cli import people


def serve(arguments: list[str]) -> None:
    """Collects labels from people in a web page: ``xplain collect domain=rescue``, or
    ``xplain collect transitions=TABLE.csv facts=FACTS.csv`` for one's own robot.

    Before the first start it says what to expect, from simulated people. That start fixes the
    collection in its database; later starts go on with it. How a lab does it: docs/collect.md.
    """
    people.serve("collect", arguments)


def bots(arguments: list[str]) -> None:
    """Lets simulated people give labels in a running collection, over HTTP or in a real browser.
    They are marked as bots in the data for ever, and never mixed with people.

        xplain collect bots --key KEY [--url http://127.0.0.1:8080] [--count 40] [--at-once 8]
            [--error 0.05] [--lapse 0] [--leaving 0] [--pace 0] [--chromium] [--seed 0]
            [--save FILE]

    ``--key``: the researcher's key, which the server prints; ``--error``: share of wrong answers;
    ``--lapse``: share of pages clicked through; ``--leaving``: chance to leave, a page; ``--pace``:
    1 is real time; ``--save``: where the export (ZIP) goes afterwards. Every habit of
    ``xplain.people.collect.bot.Habits`` is a flag, such as ``--mistake 0.1``.
    """
    people.bots("collect", arguments)


def export(arguments: list[str]) -> None:
    """Labels, observers, and their codebook, from a collection's database that no server has open
    (or from a snapshot).

        xplain collect export DATABASE FOLDER
    """
    people.export("collect", arguments)


def replay(arguments: list[str]) -> None:
    """Recomputes every question and posterior of a collection from its log, and compares.

        xplain collect replay DATABASE [--head DIGEST]

    ``--head`` is the head of the log that an earlier export printed: everything up to it must be as
    it was then. The database is one that no server has open. Exit code 1 where anything differs.
    """
    people.replay("collect", arguments)


def erase(arguments: list[str]) -> None:
    """Erases everything that one participant did or said, by the reference they were given.

        xplain collect erase DATABASE REFERENCE

    The database is one that no server has open; a running server's page can do the same. The
    erasure is written to the log, which can still be checked. Exports and backups made before keep
    the data.

    What was learned from their answers before, about which questions tell most of others, stays in
    the log without answers or reference: the questions of those who came after followed from it.
    """
    people.erase("collect", arguments)


def habits(arguments: list[str]) -> None:
    """How people listened and answered, learned from the log of a collection begun with
    ``rules.listening``: how often they err, take a message in and forget, as keys for a study or an
    experiment.

        xplain collect habits DATABASE [--stream person]

    The database is one that no server has open (or a snapshot); ``--stream`` is person, pilot or
    bot. A step after which something may be forgotten is a page.
    """
    people.habits("collect", arguments)
