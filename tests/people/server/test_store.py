"""The store: answers are stored exactly once, on the disk, for the right person; conditions are
balanced."""

import json
import sqlite3
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from filelock import FileLock

from tests.people.bare_flow import attend
from tests.people.server.test_fuzz import records
from tests.people.street import bot_of, street_study
from tests.people.visitors import Opened, agreed, consent, copied, differences, query
from xplain.errors import InputError, Refused, XplainError
from xplain.people.flow import Conflict, Full
from xplain.people.log import Unknown, read_plan
from xplain.people.store import MAX_TAB_EVENTS, Clock, DataErased, Store
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.tables import glance


@pytest.fixture
def time() -> SimpleNamespace:
    """A time that changes only when it is set."""
    return SimpleNamespace(now=1000.0)


def clock_of(time: SimpleNamespace) -> Clock:
    return Clock(lambda: time.now, lambda: time.now, "boot")


def places(store: Store, own: str = "person") -> dict[int, str]:
    """Returns the participants who have, or had, each place of a stream."""
    people = [one for one in store.present() if one.stream == own]
    return {one.state.place: one.id for one in people if one.state.place is not None}


@pytest.fixture
def store(opened: Opened, study: Study, time: SimpleNamespace) -> Store:
    """Makes a store with a clock that the test sets."""
    return opened(study, clock_of(time))


def whole(store: Store) -> str:
    """Returns everything in the database, as text."""
    with copied(store) as copy:
        return "\n".join(copy.iterdump())


def ids_of(person: str, study: str, session: str) -> dict[str, str]:
    return {"PROLIFIC_PID": person, "STUDY_ID": study, "SESSION_ID": session}


PLATFORM = ids_of("P", "S", "X")
REFUSALS: dict[str, Callable[[Store, str], object]] = {
    "nobody's page": lambda store, who: store.report("nobody", "a" * 16, []),
    "another page": lambda store, who: store.submit(who, 0, "labels", {"labels": [1]}),
    "another number": lambda store, who: store.submit(who, 3, "read", {}),
    "no choice": lambda store, who: store.submit(who, 0, "consent", {}),
    # By then a place has been reserved, and silent participants have been timed out.
    "another text": lambda store, who: store.submit(who, 0, "consent", {"agree": 1, "text": "x"}),
    "nobody": lambda store, who: consent(store, "nobody"),
    "no such invitation": lambda store, who: store.enter_invited("none"),
    "another session": lambda store, who: store.enter_from_platform(
        PLATFORM | {"SESSION_ID": "another"}, keep=True
    ),
    "too many events": lambda store, who: store.report(
        who, "a" * 16, [(n, "visible", 1.0, {}) for n in range(MAX_TAB_EVENTS + 1)]
    ),
    "one event that cannot be kept": lambda store, who: store.report(
        who, "a" * 16, [(0, "visible", 1.0, {}), (1, "visible", 2.0, {"at": {1}})]
    ),
}


@pytest.mark.parametrize("refused", REFUSALS)
def test_a_refusal_leaves_the_database_as_it_was(
    opened: Opened, study: Study, time: SimpleNamespace, refused: str
) -> None:
    store = opened(study, clock_of(time))
    silent, who = (store.enter_invited(token) for token in store.invite(2, "person"))
    consent(store, silent)
    consent(store, store.enter_from_platform(PLATFORM, keep=True))
    time.now += 31 * 60
    before = whole(store)
    with pytest.raises((Refused, Unknown, TypeError)):
        REFUSALS[refused](store, who)
    assert whole(store) == before
    store.close()
    assert whole(opened(study, clock_of(time))) == before  # nor did anything reach the disk


def test_the_same_answer_from_many_threads_counts_once(store: Store) -> None:
    who = store.enter_invited(store.invite(1, "person")[0])
    with ThreadPoolExecutor(8) as threads:
        states = [*threads.map(partial(consent, store), [who] * 8)]
    assert states == states[:1] * 8
    kinds = [event.kind for event in store.events()]
    assert kinds.count("consent") == 1


def test_only_completion_uses_a_place_up(store: Store, time: SimpleNamespace, study: Study) -> None:
    """Whoever has not agreed yet is never timed out: their link stays good, also after they were
    refused at a full study."""
    everybody = [store.enter_invited(token) for token in store.invite(15, "person")]
    most = len(study.plan.cells) * study.plan.rules.per_cell
    for who in everybody[:most]:
        consent(store, who)
    for who in everybody[most:]:
        with pytest.raises(Full):
            consent(store, who)
    assert places(store)[3] == everybody[3]
    state = store.participant(everybody[3]).state
    store.submit(everybody[3], state.accepted, "withdraw", {})
    consent(store, everybody[most])
    assert places(store)[3] == everybody[most]  # the very place that came back
    # Silence frees a place too, when somebody asks for one.
    time.now += 29 * 60
    assert store.time_out_stale() == 0
    time.now += 2 * 60
    for who in everybody[:2]:
        store.participant(who)  # signs of life
    consent(store, everybody[most + 1])
    assert store.participant(everybody[5]).state.stage == "timed_out"
    assert store.participant(everybody[0]).state.stage == "briefing"
    time.now += 7 * 86400
    store.time_out_stale()
    assert store.participant(everybody[-1]).state.stage == "consent"
    assert consent(store, everybody[-1]).stage == "briefing"


def test_who_sets_the_clock_times_nobody_out(opened: Opened, study: Study) -> None:
    """The monotonic clock counts until the machine restarts, and the wall clock over a restart."""
    wall, monotonic = [1e9], [50.0]
    clock = Clock(lambda: wall[0], lambda: monotonic[0], "boot")
    store = opened(study, clock)
    who = agreed(store)
    for jump in (1e6, -2e6):
        wall[0] += jump
        assert store.time_out_stale() == 0
    monotonic[0] += 1801
    assert store.time_out_stale() == 1
    store.submit(who, 1, "return", {})
    store.close()
    monotonic[0] = 2.0
    store = opened(study, replace(clock, boot="another"))
    for seconds, expected in ((1799, 0), (600, 1)):
        wall[0] += seconds
        assert store.time_out_stale() == expected


def test_cells_are_balanced_in_spite_of_drop_outs(opened: Opened, time: SimpleNamespace) -> None:
    rules = {"per_cell": 2, "max_attempts": 2, "timeout_minutes": 30}
    store, stages = opened(street_study(rules=rules), clock_of(time)), Counter[str]()
    for number in range(400):
        if stages["done"] == 12:
            break
        rng = np.random.default_rng(number)
        who = attend(store, StudyBot(store.flow.plan, Habits(leaving=0.1, mistake=0.05), rng))
        stages[store.participant(who).state.stage] += 1
        time.now += 40 * 60  # whoever left has been silent for too long by now
    assert stages["done"] == 12
    assert stages.total() > 12 + 5
    done = [one.state for one in store.present() if one.state.stage == "done"]
    cells = Counter((state.user_type, state.condition) for state in done)
    assert cells == dict.fromkeys(store.flow.plan.cells, 2)


def test_bots_and_pilots_do_not_touch_peoples_places(store: Store) -> None:
    for token in store.invite(40, "bot"):
        consent(store, store.enter_invited(token))
    consent(store, store.enter_as_pilot())
    assert store.participant(store.enter_as_pilot(0)).about["entry"] == "preview"
    assert places(store) == {}
    assert [*places(store, "bot")] == [*range(40)]
    assert {
        (row["stream"], row["free"]) for row in glance(store.flow, store.present())["slots"]
    } == {
        ("person", 2),
        ("bot", None),
        ("pilot", None),
    }
    cells = Counter(store.flow.cell("bot", position) for position in range(40))
    assert max(cells.values()) - min(cells.values()) <= 1


@pytest.mark.parametrize(
    "sql",
    [
        "UPDATE event SET payload = '{}'",
        "UPDATE event SET state = NULL",
        "DELETE FROM event",
    ],
)
def test_the_log_only_grows(store: Store, sql: str) -> None:
    consent(store, store.enter_as_pilot())
    with copied(store) as copy, pytest.raises(sqlite3.IntegrityError):
        copy.execute(sql)


def test_who_was_silent_for_too_long_goes_on_while_a_place_is_free(
    store: Store, time: SimpleNamespace, study: Study
) -> None:
    most = len(study.plan.cells) * study.plan.rules.per_cell
    everybody = [store.enter_invited(token) for token in store.invite(most + 2, "person")]
    gone, away, other = *everybody[:2], everybody[-1]
    for who in (gone, away):
        consent(store, who)
    store.submit(gone, 1, "withdraw", {})  # the first free place is of another cell than theirs
    before = store.submit(away, 1, "read", {})
    time.now += 31 * 60
    assert store.time_out_stale() == 1
    state = store.submit(away, 2, "return", {})
    assert (state.stage, state.user_type, state.condition) == (
        before.stage,
        before.user_type,
        before.condition,
    )
    (position,) = [position for position, who in places(store).items() if who == away]
    assert store.flow.cell("person", position) == (state.user_type, state.condition)
    # The log says which place they hold now.
    said = "SELECT payload FROM event WHERE participant = ? AND kind = 'return'"
    returned = [json.loads(row["payload"]) for row in query(store, said, (away,))]
    assert returned == [{"position": position}]
    for who in everybody[2:-1]:
        consent(store, who)
    time.now += 31 * 60
    for who in everybody[2:-1]:
        store.participant(who)  # signs of life
    consent(store, other)  # takes the only place, which was theirs
    with pytest.raises(Full):
        store.submit(away, 2, "return", {})
    # A return finds the place of somebody who is silent by then, though nobody looked in between.
    time.now += 31 * 60
    assert store.submit(away, 2, "return", {}).stage == before.stage
    assert differences(store) == []


def test_erasing_leaves_nothing_but_a_log_that_can_be_checked(
    opened: Opened, study: Study, tmp_path: Path
) -> None:
    store = opened(study)
    for number in range(2):
        attend(store, bot_of(study, number))
    gone, kept = (one.id for one in store.present())
    store.report(gone, "a" * 16, [(0, "visible", 1.0, {"what": "whatnobodyelsesaid"})])
    (place,) = [position for position, who in places(store).items() if who == gone]
    before = records(store, [kept])
    with pytest.raises(InputError, match="reference"):
        store.erase_by(gone)  # an id is in published data; it erases nothing
    store.erase_by(store.reference(gone))
    assert records(store, [kept]) == before
    when = "SELECT DISTINCT wall, monotonic, boot, browser FROM event WHERE participant = ?"
    assert query(store, when, (gone,)) == [
        {"wall": 0.0, "monotonic": 0.0, "boot": "", "browser": None}
    ]
    states = query(store, "SELECT state FROM event WHERE participant = ? AND state > ''", (gone,))
    assert states == [{"state": '{"stage": "erased"}'}]
    assert place not in places(store)
    assert differences(store) == [] != store.everybody()
    with pytest.raises(InputError, match="reference"):
        store.erase_by(store.reference(gone))
    store.close()
    content = b"".join(file.read_bytes() for file in tmp_path.glob("s.sqlite*"))
    assert b"whatnobodyelsesaid" not in content


def test_events_of_a_page_are_kept_once_and_not_without_end(store: Store) -> None:
    who = store.enter_invited(store.invite(1, "person")[0])
    items = [(n, "visible", 1.0 * n, {"at": 1.0}) for n in range(50)]
    store.report(who, "a" * 16, items)
    store.report(who, "a" * 16, items)
    count = "SELECT count(*) AS n FROM event WHERE source LIKE 'tab:%'"
    assert query(store, count) == [{"n": 50}]
    for batch in range(MAX_TAB_EVENTS // 50 - 1):
        more = [(n + 50 * batch, "visible", 1.0, {"at": 1.0}) for n in range(50)]
        store.report(who, "b" * 16, more)
    with pytest.raises(Refused):
        store.report(who, "c" * 16, items[:1])
    assert query(store, count)[0]["n"] == MAX_TAB_EVENTS


def test_invitations_and_outside_ids_lead_back_to_the_same_participant(store: Store) -> None:
    (token,) = store.invite(1, "person")
    assert store.enter_invited(token) == store.enter_invited(token)
    with pytest.raises(Unknown):
        store.enter_invited(token + "x")
    first = store.enter_from_platform(ids_of("P", "S", "X"), keep=False)
    assert store.enter_from_platform(ids_of("P", "S", "X"), keep=False) == first
    # A person is one, whatever study the link names; the session is the last one before consent.
    assert store.enter_from_platform(ids_of("P", "T", "Y"), keep=False) == first
    consent(store, first)
    assert store.enter_from_platform(ids_of("P", "S", "Y"), keep=False) == first
    with pytest.raises(Unknown):
        store.enter_from_platform(ids_of("P", "S", "X"), keep=False)
    assert store.hash_texts("ab", "c") != store.hash_texts("a", "bc")
    store.enter_from_platform(ids_of("Q", "S", "Z"), keep=True)
    dump = whole(store)
    assert token not in dump
    assert "'P'" not in dump
    assert '"PROLIFIC_PID": "Q"' in dump


def test_a_database_has_one_process_and_one_plan(
    opened: Opened, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, acquire = opened(study), FileLock.acquire
    with monkeypatch.context() as patch:
        patch.setattr(FileLock, "acquire", lambda lock, timeout: acquire(lock, timeout=0.1))
        with pytest.raises(XplainError, match="another process"):
            opened(study)
    for path in (store.path, tmp_path / "s.sqlite.key"):
        assert path.stat().st_mode & 0o077 == 0
    store.close()
    other = street_study(seed=4)
    assert other.plan.hash != study.plan.hash
    with pytest.raises(XplainError, match="another plan"):
        opened(other)
    opened(study).close()
    # Another key would make every cookie, invitation and reference worthless.
    (tmp_path / "s.sqlite.key").unlink()
    with pytest.raises(InputError, match=r"database=.*s\.sqlite\.key is missing"):
        opened(study)
    assert not (tmp_path / "s.sqlite.key").exists()


def test_a_folder_may_have_any_name(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "50% of #1? it's ${x}"
    folder.mkdir()
    Store(folder / "s.sqlite", study).close()
    monkeypatch.chdir(folder)
    for path in (Path("s.sqlite"), folder / "s.sqlite"):
        found = read_plan(path, StudyPlan)
        assert found.hash == study.plan.hash


def test_a_damaged_or_foreign_file_is_named(opened: Opened, study: Study, tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    path.write_text("no database at all, but long enough to look like something\n" * 20)
    with pytest.raises(XplainError, match=r"s\.sqlite"):
        read_plan(path, StudyPlan)
    with pytest.raises(XplainError, match=r"s\.sqlite.*cannot be used"):
        opened(study)
    # Once it is mended it can be used, though whoever keeps the error keeps what was open.
    path.unlink()
    opened(study)


def test_an_answer_after_the_time_out_is_kept_and_brings_back(
    store: Store, time: SimpleNamespace
) -> None:
    """Also while nobody new is let in."""
    who, other = agreed(store), store.enter_invited(*store.invite(1, "person"))
    time.now += 31 * 60
    assert store.time_out_stale() == 1
    store.pause(True)
    assert store.submit(who, 1, "read", {}).accepted == 2
    with pytest.raises(Refused, match="paused"):
        consent(store, other)
    kinds = [event.kind for event in store.events("participant = ?", who)]
    assert kinds[-3:] == ["time_out", "return", "read"]
    assert differences(store) == []


def test_an_acknowledged_answer_is_the_one_that_is_kept(store: Store) -> None:
    """The same answer again is acknowledged; another answer, or an answer to no page, is a
    conflict."""
    who = agreed(store)
    store.submit(who, 1, "read", {})
    before = whole(store)
    assert store.submit(who, 1, "read", {}) == store.participant(who).state
    for number, kind in ((1, "example"), (0, "read"), (3, "read")):
        with pytest.raises(Conflict):
            store.submit(who, number, kind, {})
    with pytest.raises(Conflict):
        store.submit(who, 0, "consent", {"agree": 0, "text": ""})
    assert whole(store) == before


def test_leaving_is_accepted_from_any_page(store: Store, time: SimpleNamespace) -> None:
    for number in (0, 1, 7):
        who = agreed(store)
        time.now += 31 * 60 * (number == 7)  # also after a time-out
        store.time_out_stale()
        for _ in range(2):
            assert store.submit(who, number, "withdraw", {}).stage == "withdrawn"
        assert [event.kind for event in store.events("participant = ?", who)].count("withdraw") == 1


def test_a_link_of_somebody_erased_makes_nobody_new(store: Store) -> None:
    (token,) = store.invite(1, "person")
    invited = store.enter_invited(token)
    sent = store.enter_from_platform(ids_of("P", "S", "X"), keep=False)
    for who in (invited, sent):
        store.erase_by(store.reference(who))
    before = whole(store)
    with pytest.raises(DataErased):
        store.enter_invited(token)
    with pytest.raises(DataErased):
        store.enter_from_platform(ids_of("P", "S", "X"), keep=False)
    assert whole(store) == before


def test_of_who_declines_the_decision_alone_is_kept(store: Store) -> None:
    who = store.enter_from_platform(ids_of("unique-person-id", "S", "X"), keep=True)
    store.show(store.participant(who), store.participant(who).state)
    store.report(who, "a" * 16, [(0, "visible", 1.0, {"at": 1.0, "what": "seen-by-them"})])
    agreed = {"agree": 0, "text": store.flow.plan.texts.consent_hash, "width": 4321}
    assert store.submit(who, 0, "consent", agreed).stage == "declined"
    kept = whole(store)
    for told in ("unique-person-id", "seen-by-them", "4321"):
        assert told not in kept
    assert [*store.participant(who).identity] == ["code"]
    kinds = [event.kind for event in store.events("participant = ?", who)]
    assert kinds == ["enter", "identity", "erased", "erased", "consent"]
    assert differences(store) == []
