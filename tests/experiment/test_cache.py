"""The cache returns what was stored, computes it once, and never returns old or damaged entries."""

import errno
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import numpy as np
import pytest

from tests.handmade import a_prepared
from xplain.experiment.cache import load_or_prepare
from xplain.experiment.pipeline import PreparedData


def assert_same(one: PreparedData, other: PreparedData) -> None:
    np.testing.assert_equal(asdict(one), asdict(other))


def never():
    raise AssertionError("made again")


@pytest.mark.parametrize("perfect", [True, False])
def test_what_comes_back_is_what_was_made(tmp_path, perfect):
    load_or_prepare(tmp_path, "key", lambda: a_prepared(perfect))
    assert_same(load_or_prepare(tmp_path, "key", never), a_prepared(perfect))


def test_another_key_is_another_entry(tmp_path):
    load_or_prepare(tmp_path, "key", a_prepared)
    other = load_or_prepare(tmp_path, "other", lambda: a_prepared(seed=1))
    assert_same(other, a_prepared(seed=1))
    assert_same(load_or_prepare(tmp_path, "key", never), a_prepared())


@pytest.mark.parametrize("size", [0, 10, 300, -1])
def test_a_damaged_entry_is_made_again(tmp_path, size):
    load_or_prepare(tmp_path, "key", a_prepared)
    path = tmp_path / "key.npz"
    content = bytearray(path.read_bytes())
    if size >= 0:
        path.write_bytes(content[:size])
    else:
        middle = len(content) // 2
        content[middle : middle + 40] = bytes(40)
        path.write_bytes(bytes(content))
    assert_same(load_or_prepare(tmp_path, "key", lambda: a_prepared(seed=1)), a_prepared(seed=1))
    assert_same(load_or_prepare(tmp_path, "key", never), a_prepared(seed=1))


def test_those_who_want_the_same_at_once_wait_for_the_first(tmp_path):
    calls = []

    def make(seed):
        calls.append(seed)
        return a_prepared(seed=seed)

    with ThreadPoolExecutor(8) as pool:
        found = pool.map(lambda n: load_or_prepare(tmp_path, "key", lambda: make(n)), range(8))
    for one in found:
        assert_same(one, a_prepared(seed=calls[0]))
    assert len(calls) == 1


def test_a_folder_that_cannot_be_written_costs_no_result(tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file")
    assert_same(load_or_prepare(tmp_path / "cache", "key", a_prepared), a_prepared())

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez_compressed", full)
        assert_same(load_or_prepare(tmp_path / "other", "key", a_prepared), a_prepared())
    # No partial entry stays: the next process computes it again, and stores it.
    assert_same(load_or_prepare(tmp_path / "other", "key", a_prepared), a_prepared())
    assert_same(load_or_prepare(tmp_path / "other", "key", never), a_prepared())
