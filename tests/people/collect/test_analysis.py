"""From answers to tables and types: exclusions, learned types, and the types expected in more
people."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.people.bare_flow import answer, observe
from tests.people.street import FAULTLESS_OBSERVER, street_collection, street_study
from tests.people.visitors import agreed
from xplain.errors import InputError, XplainError
from xplain.learning.data.label_file import read_table, write_table
from xplain.people.collect.asking import ATTENTION, CollectState
from xplain.people.collect.bot import Habits, bot
from xplain.people.collect.tables import (
    count_agreement,
    dataset_of,
    export,
    fact_sets,
    find_types_so_far,
    predict_new_types,
)
from xplain.people.log import read_plan
from xplain.people.store import Store
from xplain.people.study.plan import StudyPlan

COLLECTION = street_collection()


def person(number: int, habits: Habits = FAULTLESS_OBSERVER) -> CollectState:
    return observe(COLLECTION, bot(COLLECTION.plan, habits, 0, number), number)


def test_what_people_say_is_compared_with_what_their_answers_say() -> None:
    plan = COLLECTION.plan
    people = [
        replace(CollectState(), belief={str(held): 0.9, "none": 0.1}, stated=stated)
        for held, stated in ((3, (1, 1, 0, 0)), (3, (0, 1, 2, 0)), (0, (1, 0, 0, 0)))
    ]
    found = count_agreement(plan, [*people, CollectState()])
    bridge, market, school, tunnel = (found[fact.name] for fact in plan.facts)
    assert bridge == {"said": 2, "inferred": 2, "agree": 1, "of": 3}
    assert market == {"said": 2, "inferred": 2, "agree": 3, "of": 3}
    assert school == {"said": 0, "inferred": 0, "agree": 2, "of": 2}
    assert tunnel["agree"] == tunnel["of"] == 3
    # People whom no hypothesis fits, or who are unsure of everything, are not compared.
    unlike, known = {"none": 1.0}, {"3": 0.9, "none": 0.1}
    nobody = [
        replace(CollectState(), belief=unlike, stated=(0,) * 4),
        replace(CollectState(), belief=known, stated=(2,) * 4),
    ]
    assert count_agreement(plan, nobody) == {}


@pytest.mark.parametrize(("error", "doubtful"), [(0.0, False), (0.05, False), (0.45, True)])
def test_types_are_doubtful_where_answers_are_not_what_people_think(
    error: float, doubtful: bool
) -> None:
    people = [person(number, replace(FAULTLESS_OBSERVER, error=error)) for number in range(8)]
    found = find_types_so_far(COLLECTION.plan, people)
    assert found.doubtful == doubtful


def test_only_who_finished_and_looked_is_learned_from() -> None:
    done = person(0)
    assert done.left_out == ""
    assert replace(done, stage="beliefs").left_out == ""  # every clip is answered
    assert replace(done, stage="clips").left_out == "unfinished"
    for end in ("withdrawn", "declined", "timed_out"):
        assert replace(done, stage=end).left_out == end
    blind = [replace(c, labels=(1,)) if c.purpose == ATTENTION else c for c in done.answered]
    assert replace(done, answered=tuple(blind)).left_out == "inattentive"


def test_the_table_of_labels_holds_every_question_once_and_reads_back(tmp_path: Path) -> None:
    people = {f"p{number}": person(number) for number in range(3)}
    dataset = dataset_of(COLLECTION.plan, people)
    assert len(dataset) == 3 * 12
    assert np.bincount(dataset.observer).tolist() == [12, 12, 12]
    known = COLLECTION.plan.hypotheses
    for o, state in enumerate(people.values()):
        own = dataset.of(np.array([o]))
        given = [(c.transitions[0], c.told, c.labels[0]) for c in state.questions()]
        for row, (transition, told, label) in enumerate(given):
            assert own.features[own.transition[row]].tolist() == known.features[transition].tolist()
            assert (own.message_set[row], own.label[row]) == (told, label)
    write_table(dataset, tmp_path / "labels.csv")
    again = read_table(tmp_path / "labels.csv", known.messages)
    assert again.label.tolist() == dataset.label.tolist()
    assert again.message_set.tolist() == dataset.message_set.tolist()


def test_faultless_people_are_sorted_into_the_types_they_are() -> None:
    plan = COLLECTION.plan
    people = [person(number) for number in range(9)]
    facts, error = fact_sets(plan, people)
    assert facts.tolist() == [plan.roles[number % 3].held for number in range(9)]
    assert error < 0.02
    found = find_types_so_far(plan, people)
    assert sorted(len(one.members) for one in found.types) == [3, 3, 3]
    assert {one.wrong for one in found.types} == {
        ("bridge", "market"),
        ("market", "school"),
        ("school", "tunnel"),
    }
    assert min(one.posterior for one in found.types) > 0.9
    assert found.unlike < 0.1
    assert find_types_so_far(plan, people[:1]) is None
    # One of the type with the smallest mask, two of the next, three of the last.
    rank = sorted(role.held for role in plan.roles[:3]).index
    some = [one for i, one in enumerate(people) if i // 3 <= rank(plan.roles[i % 3].held)]
    largest_first = find_types_so_far(plan, some)
    assert [len(one.members) for one in largest_first.types] == [3, 2, 1]


@pytest.mark.parametrize("people", [5, 24, 200])
def test_new_types_are_those_of_ewens(people: int) -> None:
    """With the concentration that expects the observed number of types, the sums are those of the
    Chinese restaurant process."""
    before = 0.0
    for types in range(1, people, max(people // 10, 1)):
        next_new, ten = predict_new_types(types, people, 10)
        alpha = next_new * people / (1 - next_new)
        seen = (alpha / (alpha + np.arange(people))).sum()
        assert seen == pytest.approx(types, abs=1e-6) or seen > types == 1
        assert ten == pytest.approx((alpha / (alpha + people + np.arange(10))).sum())
        assert before < next_new < 1  # more seen, more to come
        before = next_new
    assert predict_new_types(people, people, 10) == (1.0, 10.0)


def test_the_export_says_who_gave_which_labels(tmp_path: Path) -> None:
    """The last person withdraws during the clips."""
    path, out, everybody = tmp_path / "c.sqlite", tmp_path / "out", list[str]()
    with closing(Store(path, COLLECTION)) as store:
        for number in range(4):
            everybody.append(who := agreed(store))
            someone = bot(COLLECTION.plan, FAULTLESS_OBSERVER, 1, number)
            while not (state := store.participant(who).state).over:
                store.show(store.participant(who), state)
                kind, payload = answer(COLLECTION, someone, state)
                if number == 3 and len(state.answered) == 5:
                    kind, payload = "withdraw", {}
                if kind == "answers":
                    payload = {"age": "33", "comment": "=HYPERLINK(1)"}
                store.submit(who, state.accepted, kind, payload)
    export(path, out)
    observers = pd.read_csv(out / "observers.csv").set_index("observer")
    assert observers.index.tolist() == everybody
    kept = observers[observers["in_labels"] == 1]
    labels = pd.read_csv(out / "labels.csv", keep_default_na=False)
    assert set(labels["observer"]) == set(kept.index)
    assert set(labels.groupby("observer").size()) == {12}
    assert not (out / "labels_bot.csv").exists()
    last = everybody[-1]
    assert observers.loc[last, "left_out"] == "withdrawn"
    clips = pd.read_csv(out / "clips.csv")
    assert last not in set(clips["observer"])  # nothing they answered leaves the database
    assert observers.loc[last, ["likeliest", "stated_bridge", "answer_age"]].isna().all()
    assert set(clips.groupby("observer").size()) == {15}
    for who, row in kept.iterrows():  # nobody erred, or took a second for a page
        own = clips[clips["observer"] == who]
        each = own["seconds"] / (own["labels"].astype(str).str.count(";") + 1)
        found = row.filter(
            ["labels", "cannot_tell", "fast_pages", "practice_errors", "attentive", "consistency"]
        )
        assert found.to_list() == [(own["purpose"] == "question").sum(), 0, len(own), 0, 1, 1]
        assert row["label_s"] == pytest.approx(each.median())
        assert own["seconds"].sum() <= row["clips_s"] <= 60
        role = COLLECTION.plan.roles[everybody.index(who) % 3]
        assert row["likeliest"].split(";") == [
            fact.name for j, fact in enumerate(COLLECTION.plan.facts) if role.held >> j & 1
        ]
        assert row["posterior"] > 0.85 > 0.15 > row["unlike"]
    assert set(observers["answer_comment"].dropna()) == {"'=HYPERLINK(1)"}
    assert set(kept["stated_bridge"]) <= {"accurate", "inaccurate"}
    columns = set(pd.read_csv(out / "codebook.csv").query("table == 'observers'")["column"])
    families = ("stated_", "answer_")
    assert {c for c in observers.reset_index() if not c.startswith(families)} == {
        c for c in columns if not c.endswith("…")
    }


def test_a_studys_database_is_not_a_collections(tmp_path: Path) -> None:
    Store(tmp_path / "s.sqlite", street_study()).close()
    with pytest.raises(XplainError, match="another plan"):
        Store(tmp_path / "s.sqlite", COLLECTION)
    with pytest.raises(InputError, match="the plan of a collection"):
        export(tmp_path / "s.sqlite", tmp_path / "out")
    Store(tmp_path / "c.sqlite", COLLECTION).close()
    with pytest.raises(InputError, match="the plan of a study"):
        read_plan(tmp_path / "c.sqlite", StudyPlan)
