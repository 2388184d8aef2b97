"""The exported tables and the codebook that describes them: no column without a meaning, no meaning
without a column, no formula; and the duration of an evaluation: the server's clocks, and time
without a visible page."""

import hashlib
import json
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.conftest import Run
from tests.people.street import bot_of
from tests.people.visitors import take_part
from xplain.people.export import codebook, defuse, order_columns
from xplain.people.flow import Event
from xplain.people.store import Store
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.tables import interaction, measure_hidden, pages


@pytest.fixture(scope="module")
def snapshot(tmp_path_factory: pytest.TempPathFactory, study: Study) -> Path:
    """Makes a snapshot with 24 bots, some of whom leave, one person, and one visitor."""
    path, rngs = tmp_path_factory.mktemp("collected") / "s", map(np.random.default_rng, range(24))
    with closing(Store(path.with_suffix(".live"), study)) as store:
        err = Habits(leaving=0.05, mistake=0.1)
        take_part(store, (StudyBot(study.plan, err, rng) for rng in rngs), "bot")
        take_part(store, [bot_of(study, 0)])
        store.enter_invited(store.invite(1, "person")[0])
        store.snapshot(path)
    return path


def test_tables_say_what_their_codebook_says(
    snapshot: Path, study: Study, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "out"
    run("study export", snapshot, out)
    others = ("table2", "asking", "flow", "questions")  # the last where some are asked
    book = pd.DataFrame(codebook("xplain.people.study")).groupby("table")["column"]
    known = pd.read_csv(out / "codebook.csv").set_index(["table", "column"])
    tables = dict[str, pd.DataFrame]()
    for name, described in ((str(name), own) for name, own in book if name not in others):
        columns = [one for one in described if not one.endswith("…")]
        table = tables[name] = pd.read_csv(out / f"{name}.csv")
        parquet = pd.read_parquet(out / f"{name}.parquet")
        assert list(table.columns) == list(parquet.columns) == columns
        assert pq.read_schema(out / f"{name}.parquet").names == columns
        assert len(table) == len(parquet)
        for column in table:
            numeric = pd.api.types.is_numeric_dtype(table[column]) and table[column].notna().any()
            stated = known.loc[(name, column), "type"]
            assert not (numeric and stated == "text" and column != "answer"), (name, column)
    of_people = {name: table for name, table in tables.items() if "participant" in table}
    people = of_people["participants"].set_index("participant")
    assert (people["stream"] == "bot").sum() == 24
    done = people[people["stage"] == "done"]
    assert len(done) > 3
    for who, row in done.iterrows():
        own = {name: one[one["participant"] == who] for name, one in of_people.items()}
        last = own["labels"][own["labels"]["k"] == study.plan.n_steps - 1]
        assert row["inexplicable_transitions"] == (last["label"] == 0).sum()
        assert row["quiz_score"] == own["quiz"]["correct"].sum()
        events, pages, steps = own["events"], own["pages"], own["steps"].fillna("")
        told, before = (
            [{*filter(None, one.split(";"))} for one in steps[key]]
            for key in ("messages", "given_before")
        )
        assert before == [set[str]().union(*told[:k]) for k in range(study.plan.n_steps)]
        by_step = own["labels"].fillna("").groupby("k")
        assert [*map(json.loads, steps["labels"])] == [*by_step["label"].apply(list)]
        assert [{*one.split(";")} - {""} for one in by_step["messages_shown"].first()] == [
            one | other for one, other in zip(told, before, strict=True)
        ]
        assert row.filter(
            [
                "messages_given",
                "steps_labelled",
                "cannot_tell",
                "eligibility_attempts",
                "entered",
                "last_seen",
            ]
        ).to_list() == [
            sum(map(len, told)),
            len(last),
            (last["label"] == 2).sum(),
            own["eligibility"]["attempt"].max(),
            events["wall"].min(),
            events["wall"].max(),
        ]
        shown = events[(events["kind"] == "shown") & events["payload"].str.contains("evaluation")]
        labels = events[events["kind"] == "labels"]
        time = labels["wall"].max() - shown["wall"].min()
        assert row["interaction_time_s"] == pytest.approx(time, abs=1e-3)
        of_pages = pages.loc[pages["stage"] == "evaluation", "seconds"].sum()
        assert own["steps"]["seconds"].sum() == pytest.approx(of_pages)
        # Pages follow one another: no more time passes on them than passed.
        assert pages["seconds"].sum() <= np.ptp(events["wall"])
    shown_for = done["interaction_time_s"] - done["hidden_s"]
    np.testing.assert_allclose(done["visible_time_s"], shown_for, atol=1e-3)
    assert json.loads((out / "plan.json").read_text())["seed"] == study.plan.seed
    digest, name = (out / "SHA256SUMS").read_text().split()
    assert digest == hashlib.sha256((out / name).read_bytes()).hexdigest()
    everything = "".join(path.read_text() for path in out.glob("*.csv"))
    assert snapshot.with_name("s.live.key").read_bytes().hex() not in everything


def test_streams_are_never_mixed(snapshot: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    said = run("study export", snapshot, out)[1]
    assert said.split()[-1] == hashlib.sha256((out / "events.csv").read_bytes()).hexdigest()
    said = run("study analyse", out, "--stream", "bot")[1]
    assert "SIMULATED PARTICIPANTS" in said
    assert (out / "measures.png").stat().st_size > 10_000
    people = pd.read_csv(out / "participants.csv")
    flow = pd.read_csv(out / "flow.csv").set_index("stage")
    bots = people[people["stream"] == "bot"]
    assert flow.loc["entered", "all"] == 24
    assert flow.loc["completed", "all"] == (bots["stage"] == "done").sum()
    ends = ("completed", "declined", "ineligible", "withdrawn", "timed out", "still on their way")
    assert sum(flow.loc[end, "all"] for end in ends) == 24
    code, _, error = run("study analyse", out)  # one person is no study
    assert code == 2
    assert "at least 2 completed" in error


CODEBOOK = ["who", "stated_…", "number"]


def test_columns_are_those_of_the_codebook_in_its_order_and_others_last() -> None:
    rows = [{"number": n, "stated_b": 1, "who": name, "stated_a": 0} for n, name in enumerate("xy")]
    table = order_columns("people", rows, CODEBOOK)
    assert list(table.columns) == ["who", "number", "stated_b", "stated_a"]
    assert table.to_dict("records") == rows


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ({"who": "x", "number": 1, "age": 3}, "age"),  # nobody would know what it means
        ({"who": "x"}, "number"),  # it would be lost
        ({"who": "x", "number": 1, "stated": 1}, "stated"),
        ({"who": "x", "number": 1, "stated_…": 1}, "stated_…"),
    ],
)
def test_a_row_that_is_not_as_its_codebook_says_is_refused(
    row: dict[str, object], named: str
) -> None:
    with pytest.raises(ValueError, match=f"^people: .*'{named}'"):
        order_columns("people", [row], CODEBOOK)


def test_no_cell_is_a_formula() -> None:
    signs = ("=1+1", "+A1", "-A1", "@SUM(A1)", "\t=1", "\r=1")
    wide = ("\uff1d1+1", "\uff0b1", "\uff0d1", "\uff20A1")
    for text in (*signs, *wide):
        assert defuse(text) == f"'{text}"
    for harmless in ("1 + 1", "a=b", "", -1, -1.5, None, "[1, 0]"):
        assert defuse(harmless) == harmless


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
