"""The cache gives back what was put in, once, and never something stale or damaged."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest

from xplain.domains.base import Item, Scene
from xplain.experiment.cache import SOURCE, prepared_once, source_fingerprint
from xplain.experiment.pipeline import Case, Prepared


def made(perfect: bool = True, seed: int = 0) -> Prepared:
    rng = np.random.default_rng(seed)
    case = Case(
        transitions=rng.integers(0, 9, (2, 3)),
        phrases=("moves up", "moves down to (1, 2)"),
        positions=((0, 1), (1, 1), (1, 2)),
        learned=rng.random((2, 2, 4)),
        everyone=rng.random((1, 2, 4)),
        perfect=rng.random((3, 2, 4)) if perfect else None,
        labels=rng.integers(0, 2, (3, 2, 4)).astype(np.uint8),
    )
    fields = {
        "domain": "grid",
        "messages": ("a", "b"),
        "sentences": ("A is 1.", "B is 2."),
        "types": ("T1", "T2", "T3"),
        "distinct": np.array([0, 1, 1]),
        "learned_types": ("F1", "F2"),
        "matched_true_type": np.array([0, 1]),
        "type_shares": np.array([1 / 3, 2 / 3]),
        "learning": {"types_found": 2.0, "unknown": float("nan")},
        "curve": np.array([5.0, 0.1, 0.0]),
        "rule": "kneedle",
        "scene": Scene(2, 3, ((0, 0),), (Item("goal", "G", ((1, 2),)),)) if perfect else None,
        "cases": (case, case),
    }
    return Prepared(**fields)


def same(one, other) -> bool:
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if dataclasses.is_dataclass(one):
        names = [field.name for field in dataclasses.fields(one)]
        return type(one) is type(other) and all(
            same(getattr(one, name), getattr(other, name)) for name in names
        )
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return type(one) is type(other) and (one == other or (one != one and other != other))


def never():
    raise AssertionError("made again")


@pytest.mark.parametrize("perfect", [True, False])
def test_what_comes_back_is_what_was_made(tmp_path, perfect):
    prepared_once(tmp_path, "key", lambda: made(perfect))
    assert same(prepared_once(tmp_path, "key", never), made(perfect))


@pytest.mark.parametrize("size", [0, 10, 300, -1])
def test_a_damaged_entry_is_made_again(tmp_path, size):
    prepared_once(tmp_path, "key", made)
    path = tmp_path / "key.npz"
    content = bytearray(path.read_bytes())
    if size >= 0:
        path.write_bytes(content[:size])
    else:
        middle = len(content) // 2
        content[middle : middle + 40] = bytes(40)
        path.write_bytes(bytes(content))
    assert same(prepared_once(tmp_path, "key", lambda: made(seed=1)), made(seed=1))
    assert same(prepared_once(tmp_path, "key", never), made(seed=1))


def test_those_who_want_the_same_at_once_wait_for_the_first(tmp_path):
    calls, found = [], []

    def make():
        calls.append(1)
        return made()

    threads = [
        threading.Thread(target=lambda: found.append(prepared_once(tmp_path, "key", make)))
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(calls) == 1
    assert all(same(one, made()) for one in found)


def test_a_folder_that_cannot_be_written_costs_no_result(tmp_path):
    (tmp_path / "cache").write_text("a file")
    assert same(prepared_once(tmp_path / "cache", "key", made), made())


CONFIG = {
    "domain": {"map": "S.V"},
    "users": {"count": 2},
    "observers": {"points": 100},
    "labeler": {"depth": 3},
    "clusterer": {"seed": 1},
    "traces": 3,
    "max_steps": 10,
    "seed": 0,
    "lambda": 1.0,
    "solver": {"simulations": 10},
    "discount": 0.95,
}


def test_the_key_covers_what_decides_data_and_types_and_nothing_else():
    before = source_fingerprint(CONFIG)
    for key in CONFIG:
        changed = source_fingerprint(CONFIG | {key: "something else"})
        assert (changed != before) == (key in SOURCE), key
