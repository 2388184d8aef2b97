"""The odd step of the practice, against what a search through the whole task finds."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate

from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.experiment.config import composed
from xplain.people.ahead import ahead_of

MAPS = ("US..#.\nf.....\nF..r..\npr....\np.AVr.\n...f..", "S..\n.#.\nVAF\npU.\nfr.")
ON_THE_WAY = "sAFVUrpfS"


def rescue(text: str) -> Any:
    return instantiate(composed("collect", ["domain=rescue", f"domain.map='{text}'"]).domain)


def found(domain: Any) -> tuple[Any, Hypotheses, list[int]]:
    """The odd step, the hypotheses, and the transitions of its way."""
    known, rows = hypotheses_of(domain, None), []
    assert known.states is not None

    def sentence(row: int) -> str:
        rows.append(row)
        return known.phrases[row]

    return ahead_of(domain, known.states, known.labels, sentence), known, rows


def walked(domain: Any, cell: tuple[int, int]) -> dict[tuple[int, int], int]:
    """Steps from every cell of a grid to one, around its walls."""
    far, new = {cell: 0}, [cell]
    for here in new:
        for move in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            to = (here[0] + move[0], here[1] + move[1])
            if to in map(tuple, domain.grid.cells.tolist()) and to not in far:
                far[to] = far[here] + 1
                new.append(to)
    return far


@pytest.mark.parametrize("text", MAPS)
def test_it_leads_away_from_the_shelter_makes_sense_to_everybody_and_ends_with_its_reason(
    text: str,
) -> None:
    domain = rescue(text)
    ahead, known, rows = found(domain)
    assert ahead is not None
    assert known.states is not None
    shelter, victim = (domain.grid.position(cell) for cell in (domain.shelter, domain.victim))
    home = walked(domain, shelter)
    (here, after), *_ = ahead.way
    assert home[after] > home[here]
    assert known.labels[:, rows].all()  # whatever facts somebody holds wrong
    assert int(known.states[rows[0], 0]) in domain.starts
    for (_, one), (other, _) in pairwise(ahead.way):
        assert one == other
    assert len(rows) == walked(domain, victim)[here] + 1
    assert ahead.steps[-1] == "picks up the victim"


def test_of_all_such_steps_it_is_the_one_whose_reason_comes_last() -> None:
    domain = rescue(MAPS[0])
    _, known, rows = found(domain)
    assert known.states is not None
    home, there = (
        walked(domain, domain.grid.position(cell)) for cell in (domain.shelter, domain.victim)
    )
    cells = [[domain.position(state) for state in pair] for pair in known.states.tolist()]
    begins = np.isin(known.states[:, 0], domain.starts) & known.labels.all(axis=0)
    odd = [there[a] for (a, b), one in zip(cells, begins, strict=True) if one and home[b] > home[a]]
    assert len(rows) == max(odd) + 1


@pytest.mark.parametrize("name", ["four_rooms", "taxi", "frozen_lake", "blocks"])
def test_a_task_without_such_a_step_goes_without(name: str) -> None:
    """No step leads away, or no map tells where all is."""
    assert found(instantiate(composed("collect", [f"domain={name}"]).domain))[0] is None


def test_a_victim_on_the_way_gives_no_reason() -> None:
    ahead, _, _ = found(rescue(ON_THE_WAY))
    assert ahead is None


def test_what_somebody_may_think_senseless_is_not_shown() -> None:
    domain = rescue(MAPS[0])
    ahead, known, rows = found(domain)
    assert known.states is not None
    doubted = np.array(known.labels)
    doubted[1, rows[0]] = 0
    other = ahead_of(domain, known.states, doubted, lambda row: known.phrases[row])
    assert other != ahead
