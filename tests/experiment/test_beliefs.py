"""Questions about beliefs: right answers by the truth, and by the learned types."""

from __future__ import annotations

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate

from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError
from xplain.experiment.asking import CaseQuestions, belief_questions, merge_questions
from xplain.experiment.config import compose_config
from xplain.experiment.explanations import evaluate
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import Prepared, prepare
from xplain.experiment.strangers import with_others
from xplain.interaction.explainees import Unseen

TRUE = ("labeler=truth", "clusterer=perfect", "traces=2")
HYPOTHESES = ("labeler=hypotheses", "queries=adaptive", "points=20", "traces=2")


def prepared_with(*overrides: str) -> Prepared:
    GlobalHydra.instance().clear()
    return prepare(components_of(compose_config("config", list(overrides))))


def questions(prepared: Prepared, trace: int = 0) -> CaseQuestions:
    found = prepared.cases[trace].questions
    assert found is not None
    return found


@pytest.fixture(scope="module")
def setting() -> Setting:
    GlobalHydra.instance().clear()
    domain = instantiate(compose_config("config", []).domain)
    values = {one.name: one.inaccurate for one in domain.parameters}
    held = [(), ("fire",), ("rubble", "fence"), ("refuel", "puddle", "first_aid")]
    return Setting.build(
        domain,
        tuple(UserType(str(t), {n: values[n] for n in own}) for t, own in enumerate(held)),
    )


def test_a_fact_is_right_unless_it_is_held_wrong_and_was_not_told(setting: Setting) -> None:
    beliefs = belief_questions(setting, setting.wrong, 0)
    names = setting.message_names
    assert [names[j] for j in beliefs.facts] == list(names)
    for given in range(1 << len(names)):
        found = beliefs.labels.label_probabilities(len(names), given)
        for t, user in enumerate(setting.types):
            wanted = [n not in user.inaccurate or given >> j & 1 for j, n in enumerate(names)]
            assert found[t].tolist() == wanted


def test_what_types_know_is_what_is_left_until_they_are_told(setting: Setting) -> None:
    rng = np.random.default_rng(0)
    wrong = np.where(rng.random((3, 6)) < 0.3, 0.004, rng.random((3, 6)))
    learned = belief_questions(setting, wrong, 0).learned
    for given in range(1 << 6):
        told = np.array([given >> j & 1 for j in range(6)], bool)
        wanted = np.where(told & (wrong >= 0.01), 1, 1 - wrong)
        np.testing.assert_allclose(learned.label_probabilities(6, given), wanted)


def test_the_order_of_sentences_is_drawn_and_says_nothing_of_the_right_one(
    setting: Setting,
) -> None:
    drawn = [belief_questions(setting, setting.wrong, seed) for seed in range(200)]
    again = belief_questions(setting, setting.wrong, 7)
    assert (again.texts, again.right.tolist()) == (drawn[7].texts, drawn[7].right.tolist())
    shares = np.mean([one.right for one in drawn], axis=0)
    assert (abs(shares - 0.5) < 4 * 0.5 / np.sqrt(200)).all()
    for one in drawn:
        for j, text, right in zip(one.facts, one.texts, one.right, strict=True):
            assert text.split("\n")[right] == setting.domain.parameters[j].message
            assert text.split("\n")[1 - right] == setting.domain.parameters[j].belief


def test_labels_of_people_tell_what_their_types_hold_wrong() -> None:
    """20 labels of each person are enough for these types; the posterior is never certain."""
    found = questions(prepared_with(*HYPOTHESES, "ask=beliefs"))
    true = questions(prepared_with(*TRUE, "ask=beliefs"))
    assert found.facts.tolist() == true.facts.tolist()
    p = found.learned.label_probabilities(len(found.facts), 0)
    truth = true.learned.label_probabilities(len(true.facts), 0)
    assert ((p > 0) & (p < 1)).all()
    for own in p:  # types come in another order
        assert abs(truth - own).sum(axis=1).min() < 0.1


def test_types_without_fact_sets_are_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="labeler=truth and labeler=hypotheses"):
        prepared_with("labeler=tree", "ask=beliefs", "traces=1")


def test_clips_and_beliefs_are_one_list_with_one_cap() -> None:
    both = questions(prepared_with(*TRUE, "ask=both"))
    clips = questions(prepared_with(*TRUE, "ask=clips"))
    assert len(both.texts) == len(clips.texts) + (both.facts >= 0).sum()
    assert (both.transitions[both.facts < 0] == clips.transitions).all()
    few = questions(prepared_with(*TRUE, "ask=both", "ask.clips=7"))
    assert len(few.texts) == 7
    assert merge_questions([], 5) is None


@pytest.mark.parametrize("kind", ["clips", "beliefs", "both"])
def test_strangers_answer_for_themselves(kind: str) -> None:
    GlobalHydra.instance().clear()
    cfg = compose_config("config", [*TRUE, f"ask={kind}", "explainee=unseen", "ask.cost=0"])
    components = components_of(cfg)
    strangers = with_others(prepare(components), components, Unseen())
    for case in strangers.cases:
        asked = case.questions
        assert asked is not None
        assert asked.labels.n_types == len(strangers.types)
        for t, name in enumerate(strangers.types):
            facts = set(name.removeprefix("unseen ").split("+"))
            for q in np.flatnonzero(asked.facts >= 0):
                right = asked.labels.label_probabilities(q + 1, 0)[t, q]
                assert right == (strangers.messages[asked.facts[q]] not in facts)
        for q, i in np.argwhere(asked.shows):
            for given in (0, 5, 63):
                one = case.labels.label_probabilities(i + 1, given)[:, i]
                other = asked.labels.label_probabilities(q + 1, given)[:, q]
                np.testing.assert_array_equal(one, other)
    explainee = instantiate(cfg.explainee)
    assert isinstance(explainee, Unseen)
    solvers = {"solver": instantiate(cfg.solver)}
    records = evaluate(strangers, costs_of(cfg), solvers, instantiate(cfg.belief), explainee, 0)
    assert any(record.episode.n_questions for record in records)
