"""Random traces, asked of everybody or of each their own."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.domains.users.corridor import Corridor
from xplain.domains.users.setting import Setting, UserType
from xplain.learning.data.queries import Answered, Independent, Queries, RandomTraces, Shared

DESIGNS = [pytest.param(Independent, id="independent"), pytest.param(Shared, id="shared")]


def corridor(starts: Sequence[int] = range(1, 5)) -> Setting:
    return Setting.build(Corridor(starts), (UserType("A", {"end": "left"}),))


def asked(queries: Queries, sizes: list[int], setting: Setting | None = None) -> list[Answered]:
    """Everybody answers 1."""

    def answer(
        observer: int, transitions: NDArray[np.int64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        return np.ones(len(transitions), dtype=np.uint8)

    return queries.ask(setting or corridor(), np.array(sizes), answer, 3)


@pytest.mark.parametrize("length", [1, 2, 3])
@pytest.mark.parametrize("design", DESIGNS)
def test_traces_run_from_a_start_to_their_length_under_one_message_set(
    length: int, design: type[RandomTraces]
) -> None:
    (one,) = asked(design(length), [600], corridor(starts=(1,)))
    cell = one.transitions[:, 0]
    assert cell.tolist() == [1 + i % length for i in range(600)]
    traces = one.message_sets.reshape(-1, length)
    assert (traces == traces[:, :1]).all()


@pytest.mark.parametrize("design", DESIGNS)
def test_messages_are_given_one_by_one(design: type[RandomTraces]) -> None:
    (one,) = asked(design(1, 0.3), [4000])
    share = np.bincount(one.message_sets, minlength=4) / 4000
    expected = np.array([0.49, 0.21, 0.21, 0.09])
    assert (abs(share - expected) < 4 * (expected * (1 - expected) / 4000) ** 0.5).all()


def test_shared_questions_are_shared_and_independent_ones_are_not() -> None:
    def batteries(queries: Queries) -> set[tuple[bytes, bytes]]:
        return {
            (one.transitions[:30].tobytes(), one.message_sets[:30].tobytes())
            for one in asked(queries, [30, 70, 40, 30])
        }

    assert len(batteries(Shared())) == 1
    assert len(batteries(Independent())) == 4
