"""The cache returns what was stored, computes it once, and never returns old or damaged entries."""

import dataclasses
import errno
import threading

import numpy as np
import pytest

from tests.configurations import CHOICES, composed, dotted, each_changed
from tests.handmade import a_prepared
from xplain.experiment.cache import load_or_prepare, source_fingerprint
from xplain.experiment.fingerprint import configuration


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
    load_or_prepare(tmp_path, "key", lambda: a_prepared(perfect))
    assert same(load_or_prepare(tmp_path, "key", never), a_prepared(perfect))


def test_another_key_is_another_entry(tmp_path):
    load_or_prepare(tmp_path, "key", a_prepared)
    other = load_or_prepare(tmp_path, "other", lambda: a_prepared(seed=1))
    assert same(other, a_prepared(seed=1))
    assert same(load_or_prepare(tmp_path, "key", never), a_prepared())


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
    assert same(load_or_prepare(tmp_path, "key", lambda: a_prepared(seed=1)), a_prepared(seed=1))
    assert same(load_or_prepare(tmp_path, "key", never), a_prepared(seed=1))


def test_those_who_want_the_same_at_once_wait_for_the_first(tmp_path):
    calls, found = [], []

    def make():
        calls.append(1)
        return a_prepared()

    threads = [
        threading.Thread(target=lambda: found.append(load_or_prepare(tmp_path, "key", make)))
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(calls) == 1
    assert all(same(one, a_prepared()) for one in found)


def test_a_folder_that_cannot_be_written_costs_no_result(tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file")
    assert same(load_or_prepare(tmp_path / "cache", "key", a_prepared), a_prepared())

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez_compressed", full)
        assert same(load_or_prepare(tmp_path / "other", "key", a_prepared), a_prepared())
    # No partial entry stays: the next process computes it again, and stores it.
    assert same(load_or_prepare(tmp_path / "other", "key", a_prepared), a_prepared())
    assert same(load_or_prepare(tmp_path / "other", "key", never), a_prepared())


NOT_OF_THE_SOURCE = {
    "lambda": "a price, met when explaining",
    "message_cost": "a price",
    "inexplicability_cost": "a price",
    "discount": "of plans; the task's own is the domain's",
    "discount_per": "of plans",
    "prior": "of plans; the observers' shares are kept beside the cases",
    "solver": "explains what is there",
    "belief": "of the explanation",
    "explainee": "who it is explained to",
    "ask.cost": "a price",
    "ask.most": "of the explanation",
    "ask.when": "of the explanation",
    "certify": "judges the explanation",
    "points": "reaches the data through observers.points alone",
    "outputs": "where files are written",
    "tracking": "where results go besides the disk",
    "resume": "which jobs of a sweep run again",
    "dry_run": "which jobs a sweep would run",
}
"""Keys that data, types and traces do not depend on, and why. All others must count."""


@pytest.mark.parametrize("choices", CHOICES, ids=" ".join)
def test_the_key_covers_what_decides_data_and_types_and_nothing_else(choices):
    cfg = composed(*choices)
    before = source_fingerprint(configuration(cfg))
    for path in each_changed(cfg):
        counts = source_fingerprint(configuration(cfg)) != before
        # Simulated observers answer as many questions as ``points`` says.
        asked = path == ("points",) and "observers=file" not in choices
        apart = {path[0], ".".join(map(str, path[:2]))} & NOT_OF_THE_SOURCE.keys()
        assert counts == (asked or not apart), dotted(path)


def test_the_content_of_the_observers_file_counts(tmp_path):
    labels = tmp_path / "labels.csv"
    labels.write_text("1")
    config = configuration(composed("observers=file", f"observers.path={labels}"))
    before = source_fingerprint(config)
    labels.write_text("2")
    assert source_fingerprint(config) != before
