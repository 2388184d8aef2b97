"""What every domain keeps to (see :mod:`xplain.domains.base`)."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from xplain.domains.base import Domain, transition_feature_names, transition_features
from xplain.errors import DomainError
from xplain.users.setting import Setting, UserType


class DomainConformance:
    """Attributes:
    component: the domain.
    """

    component: Any

    def test_is_a_domain(self) -> None:
        """It has all that :class:`xplain.domains.base.Domain` names."""
        assert isinstance(self.component, Domain), "something of xplain.domains.base.Domain lacks"

    def test_parameters_are_named_and_told_in_words(self) -> None:
        """Each once, with a sentence, and two values."""
        parameters = self.component.parameters
        assert parameters, "a domain needs a parameter that people may hold wrong"
        names = [parameter.name for parameter in parameters]
        assert len(set(names)) == len(names), f"names are given twice: {names}"
        for parameter in parameters:
            assert parameter.name.strip() == parameter.name != "", "a parameter without a name"
            assert ";" not in parameter.name, "tables of labels join names by ;"
            assert parameter.message.strip(), f"{parameter.name} has no sentence"
            assert parameter.accurate != parameter.inaccurate, f"{parameter.name}: two equal values"

    def test_every_idea_of_the_task_shares_states_and_actions(self) -> None:
        """Labels compare what different people think of the same transition."""
        robot = self._setting.models[0]
        for model in self._setting.models[1:]:
            assert model.successor.shape[:2] == robot.successor.shape[:2], (
                "states or actions differ"
            )
        assert len(self.component.actions) == robot.n_actions, "one name an action"
        assert len(set(self.component.actions)) == robot.n_actions, "actions share a name"

    def test_a_model_is_a_function_of_the_values(self) -> None:
        """Asked again after other values, it is the same."""
        accurate = {p.name: p.accurate for p in self.component.parameters}
        once = self.component.model(accurate)
        self.component.model({p.name: p.inaccurate for p in self.component.parameters})
        again = self.component.model(accurate)
        for key in ("successor", "probability", "reward", "terminal"):
            assert np.array_equal(getattr(once, key), getattr(again, key)), f"{key} has changed"
        assert once.discount == again.discount, "the discount has changed"

    def test_features_describe_every_state(self) -> None:
        """[S, F] finite numbers, F names."""
        features, names = self.component.state_features, self.component.feature_names
        assert features.shape == (self._setting.models[0].n_states, len(names)), features.shape
        assert np.isfinite(features).all(), "a feature is not finite"
        assert len(set(names)) == len(names), f"names are given twice: {names}"
        rows = transition_features(self.component, self._setting.reachable)
        assert rows.shape[1] == len(transition_feature_names(self.component))

    def test_traces_can_start(self) -> None:
        """Starts are states in which there is something to do."""
        starts, robot = self.component.starts, self._setting.models[0]
        assert len(starts), "no start"
        assert ((starts >= 0) & (starts < robot.n_states)).all(), "a start is no state"
        assert not robot.terminal[starts].any(), "a trace would end where it starts"

    def test_the_robot_is_explicable_to_those_who_know_the_task(self) -> None:
        """Whoever holds all values right calls every transition of the robot explicable."""
        setting = self._setting
        labels = setting.label_by_model(setting.reachable)[0]
        assert labels.all(), "the robot's own model finds the robot inexplicable"

    def test_every_message_can_matter(self) -> None:
        """For someone who holds everything wrong, each message changes some label, given some
        others."""
        setting = self._setting
        table = setting.label_table(setting.reachable)[0]
        for j, name in enumerate(setting.message_names):
            halves = table.reshape(len(table), -1, 2, 1 << j)
            assert (halves[:, :, 0] != halves[:, :, 1]).any(), f"{name} never changes a label"

    def test_transitions_are_told_in_words(self) -> None:
        """A phrase of one line for each transition."""
        for transition in self._setting.reachable[:500]:
            phrase = self.component.describe(transition)
            assert phrase.strip(), f"no words for {transition}"
            assert "\n" not in phrase, f"more than a line for {transition}"

    def test_the_map_has_a_place_for_the_robot(self) -> None:
        """Where there is a map, every state has a cell on it that is no wall."""
        scene = self.component.scene
        for state in np.unique(self._setting.reachable[:, [0, 2]]):
            cell = self.component.position(int(state))
            if scene is None:
                assert cell is None, "a position without a map"
            else:
                row, column = cell
                assert 0 <= row < scene.rows, f"row {row} is off the map"
                assert 0 <= column < scene.columns, f"column {column} is off the map"
                assert (row, column) not in scene.walls, f"{cell} is a wall"

    @cached_property
    def _setting(self) -> Setting:
        """One type that holds everything wrong: every model that any type can hold."""
        wrong = {p.name: p.inaccurate for p in self.component.parameters}
        try:
            return Setting.build(self.component, (UserType("all_wrong", wrong),))
        except DomainError as error:  # an AssertionError reads better in a test's report
            raise AssertionError(str(error)) from error
