"""Tests of domains (see :mod:`xplain.domains.base`)."""

from typing import Any

import numpy as np

from xplain.domains.base import Domain, transition_feature_names, transition_features
from xplain.domains.users.setting import MAX_MODELS, Setting, UserType
from xplain.errors import DomainError
from xplain.testing.suite import Conformance


class DomainConformance(Conformance):
    """Tests a :class:`~xplain.domains.base.Domain`. Labels, traces, messages and maps need these
    properties.

    Two tests fail for a task that is valid but useless: a message never changes a label, or two
    actions nearly tie, so that a label would be arbitrary.
    """

    def test_is_a_domain(self, component: Any) -> None:
        """The domain has all attributes of :class:`xplain.domains.base.Domain`."""
        assert isinstance(component, Domain), "lacks an attribute of xplain.domains.base.Domain"

    def test_parameters_are_named_and_told_in_words(self, component: Any) -> None:
        """Each parameter has a unique name, a sentence, and an inaccurate value other than the
        accurate one."""
        parameters = component.parameters
        assert parameters, "a domain needs a parameter that people may believe incorrectly"
        names = [parameter.name for parameter in parameters]
        assert len(set(names)) == len(names), f"names are given twice: {names}"
        for parameter in parameters:
            assert parameter.name.strip() == parameter.name != "", "a parameter without a name"
            assert ";" not in parameter.name, "tables of labels join names by ;"
            assert parameter.message.strip(), f"{parameter.name} has no sentence"
            assert parameter.accurate != parameter.inaccurate, f"{parameter.name}: two equal values"

    def test_every_idea_of_the_task_shares_states_and_actions(self, component: Any) -> None:
        """All models have the same states and actions, because the labels of one transition are
        compared."""
        robot, *others = _make_setting(component).models
        for model in others:
            assert model.successor.shape[:2] == robot.successor.shape[:2], (
                "states or actions differ"
            )
        assert len(component.actions) == robot.n_actions, "not one name for each action"
        assert len(set(component.actions)) == robot.n_actions, "actions share a name"

    def test_a_model_is_a_function_of_the_values(self, component: Any) -> None:
        """The same values give the same model, also after other values."""
        accurate = {p.name: p.accurate for p in component.parameters}
        once = component.model(accurate)
        component.model({p.name: p.inaccurate for p in component.parameters})
        again = component.model(accurate)
        for key in ("successor", "probability", "reward", "terminal"):
            assert np.array_equal(getattr(once, key), getattr(again, key)), f"{key} has changed"
        assert once.discount == again.discount, "the discount has changed"

    def test_features_describe_every_state(self, component: Any) -> None:
        """``state_features`` is [S, F], all finite; ``feature_names`` has F different names."""
        features, names = component.state_features, component.feature_names
        setting = _make_setting(component)
        assert features.shape == (setting.models[0].n_states, len(names)), features.shape
        assert np.isfinite(features).all(), "a feature is not finite"
        assert len(set(names)) == len(names), f"names are given twice: {names}"
        rows = transition_features(component, setting.reachable)
        assert rows.shape[1] == len(transition_feature_names(component))

    def test_traces_can_start(self, component: Any) -> None:
        """Traces start in states that are not terminal."""
        starts, robot = component.starts, _make_setting(component).models[0]
        assert len(starts), "no start"
        assert ((starts >= 0) & (starts < robot.n_states)).all(), "a start is not a state"
        assert not robot.terminal[starts].any(), "a start is terminal"

    def test_every_message_can_matter(self, component: Any) -> None:
        """For a person who believes everything incorrectly, each message changes some label,
        possibly together with other messages."""
        setting = _make_setting(component)
        labels = setting.labels_by_type(setting.reachable)
        for j, name in enumerate(setting.message_names):
            matters = any(j in own for own in labels.effective())
            assert matters, f"{name} never changes a label"

    def test_transitions_are_told_in_words(self, component: Any) -> None:
        """``describe`` gives one non-empty line for each transition."""
        for transition in _make_setting(component).reachable:
            phrase = component.describe(transition)
            assert phrase.strip(), f"no words for {transition}"
            assert "\n" not in phrase, f"more than a line for {transition}"

    def test_the_map_has_a_place_for_the_robot(self, component: Any) -> None:
        """If there is a map, every state has a cell on it that is not a wall."""
        scene = component.scene
        for state in np.unique(_make_setting(component).reachable[:, [0, 2]]):
            cell = component.position(int(state))
            if scene is None:
                assert cell is None, "a position without a map"
            else:
                row, column = cell
                assert 0 <= row < scene.rows, f"row {row} is off the map"
                assert 0 <= column < scene.columns, f"column {column} is off the map"
                assert (row, column) not in scene.walls, f"{cell} is a wall"


def _make_setting(domain: Domain) -> Setting:
    """Makes a setting with one type, which believes every parameter incorrectly. Messages correct
    these beliefs, so the setting contains the model of each set of incorrect parameters. If these
    are too many models, the setting has one type for each parameter, and each type believes only
    its own parameter incorrectly.

    Raises:
        AssertionError: a model is not valid, or its ties are ambiguous.
    """
    wrong = {p.name: p.inaccurate for p in domain.parameters}
    types = [UserType("all_wrong", wrong)]
    if 1 << len(wrong) > MAX_MODELS:
        types = [UserType(name, {name: value}) for name, value in wrong.items()]
    try:
        return Setting.build(domain, tuple(types))
    except DomainError as error:  # a test's report shows an AssertionError better
        raise AssertionError(str(error)) from error
