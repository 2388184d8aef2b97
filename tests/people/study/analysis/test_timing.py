"""The duration of an evaluation: the server's clocks, and time without a visible page."""

from typing import Any

import pytest

from xplain.people.flow import Event
from xplain.people.study.tables import interaction, measure_hidden, pages


def event(source: str, kind: str, at: float, number: int = 0, **payload: Any) -> Event:
    """Makes an event at ``at`` seconds on every clock."""
    tab = source.startswith("tab:")
    told = {"at": 1e12 + 1000 * at} | payload if tab else payload
    clocks = (1e9 + at, 5.0 + at, "one", 1000 * at)
    return Event("ann", 0, source, number, kind, *clocks, told, None, 0)


def seen(at: float, tab: str = "a", stage: str = "evaluation") -> Event:
    return event(f"tab:{tab}", "visible", at, what=stage)


def gone(at: float, tab: str = "a") -> Event:
    return event(f"tab:{tab}", "hidden", at, what="evaluation")


LABELS = [
    event("shown", "shown", 0, stage="evaluation"),
    event("protocol", "labels", 40),
    event("shown", "shown", 41, stage="evaluation"),
    event("protocol", "labels", 100),
    event("shown", "shown", 101, stage="quiz"),
]


def test_time_runs_from_the_first_rendering_to_the_last_label() -> None:
    found = interaction(LABELS)
    assert [*found.values()] == [100, "monotonic", None, None]
    restarted = [*LABELS[:3], LABELS[3]._replace(boot="two", monotonic=0.5)]
    assert [*interaction(restarted).values()][:2] == [100, "wall"]
    assert interaction(LABELS[:1])["interaction_time_s"] is None


def test_questions_in_between_are_part_of_the_evaluation() -> None:
    """Its first page may also be a question, and the page of a question does not end it."""
    asked = [
        event("shown", "shown", -20, stage="asking"),
        event("protocol", "clip", -10),
        *(seen(-20, stage="asking"), gone(-15), seen(-13, stage="asking")),
        *(seen(-8), gone(-7), seen(-3)),
        *(seen(50, stage="asking"), seen(60), gone(70), seen(75), seen(101, stage="quiz")),
        *LABELS,
    ]
    found = interaction(asked)
    assert (found["interaction_time_s"], found["hidden_s"]) == (120, pytest.approx(2 + 4 + 5))


def test_a_clock_that_was_set_back_gives_no_time_that_cannot_be() -> None:
    back = [*LABELS[:3], LABELS[3]._replace(wall=1e9 - 259_198.0)]
    assert [*interaction(back).values()][:2] == [100, "monotonic"]
    restarted = [*back[:3], back[3]._replace(boot="two")]
    assert [*interaction(restarted).values()] == [None, "impossible", None, None]
    of_pages = [
        one._replace(source_sequence=n // 2, browser=None) for n, one in enumerate(back[:4])
    ]
    assert [page["seconds"] for page in pages(of_pages)] == [40, 59]


@pytest.mark.parametrize(
    ("reports", "away"),
    [
        ([], None),
        ([seen(0), seen(41, "b"), seen(101, "c", "quiz")], 0),
        ([seen(0), gone(10), seen(30), seen(41, "b"), seen(101, "c", "quiz")], 20),
        # Two tabs: from one to the other and back is not away; both hidden is.
        ([seen(0), gone(10), seen(10, "b"), gone(20, "b"), seen(20), gone(50), seen(57, "b")], 7),
        # The page before stays "visible" for ever, since an answer led on from it.
        ([seen(0), seen(41, "b"), gone(50, "b"), seen(60, "b")], 10),
        # Hidden before and after the evaluation is not counted.
        ([seen(-9, "z", "briefing"), gone(-8, "z"), seen(-2, "z", "briefing"), seen(0)], 0),
        ([seen(0), seen(101, "c", "quiz"), gone(110, "c"), seen(150, "c", "quiz")], 0),
        # Closed, and opened again later.
        ([seen(0), gone(30), seen(90, "b"), seen(101, "c", "quiz")], 60),
    ],
)
def test_hidden_time_is_when_no_page_is_looked_at(reports: list[Event], away: float | None) -> None:
    assert measure_hidden(reports) == (None if away is None else pytest.approx(away))
    found = interaction([*LABELS, *reports])
    assert found["visible_time_s"] == (None if away is None else pytest.approx(100 - away))


def test_clocks_of_two_devices_need_not_agree() -> None:
    """A phone's clock is ten minutes behind a computer's: one minute was hidden."""
    slow = [seen(0), gone(20)]
    for one in slow:
        one.payload["at"] -= 600_000
    assert measure_hidden([*slow, seen(80, "b"), seen(90, "c", "quiz")]) == pytest.approx(60)


def test_a_device_that_sleeps_is_not_looked_at() -> None:
    """Its wall clock goes on, the page's own clock stands still."""
    woke = event("tab:a", "active", 50, what="")._replace(browser=10_000.0)
    assert measure_hidden([seen(0), woke, seen(101, "c", "quiz")]) == pytest.approx(40)


def test_every_page_has_its_place_and_the_time_until_its_answer() -> None:
    def at(sequence: int, found: Event, browser: float | None = None) -> Event:
        return found._replace(source_sequence=sequence, browser=browser)

    events = [
        at(4, event("shown", "shown", 0, stage="briefing")),
        at(4, event("protocol", "continue", 3)),
        at(5, event("shown", "shown", 3, stage="evaluation")),
        at(9, event("tab:a", "visible", 4, what="evaluation")),
        at(5, event("protocol", "labels", 40), browser=36_500),
        at(6, event("shown", "shown", 41, stage="evaluation")),
        at(6, event("protocol", "labels", 100)),
        at(7, event("shown", "shown", 101, stage="quiz")),
    ]
    keys = ("participant", "sequence", "stage", "step", "shown", "seconds", "browser_ms")
    rows = [
        ("ann", 4, "briefing", None, 1e9, 3, None),
        ("ann", 5, "evaluation", 0, 1e9 + 3, 37, 36_500),
        ("ann", 6, "evaluation", 1, 1e9 + 41, 59, None),
        ("ann", 7, "quiz", None, 1e9 + 101, None, None),
    ]
    assert pages(events) == [dict(zip(keys, row, strict=True)) for row in rows]
