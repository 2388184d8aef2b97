"""Stored values are read back unchanged, and a file is complete or unchanged."""

import json
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from xplain.storage import decode, encode, open_atomic, write_text


@dataclass(frozen=True)
class Inner:
    cells: tuple[tuple[int, int], ...]
    text: str | None


@dataclass(frozen=True)
class Kept:
    numbers: NDArray[np.float64]


@dataclass(frozen=True)
class Outer:
    numbers: NDArray[np.float64]
    labels: NDArray[np.uint8]
    alone: Inner
    inner: Inner | None
    several: tuple[Inner, ...]
    pair: tuple[int, str]
    by_name: Mapping[str, Inner]
    plain: Mapping[str, float]
    one: NDArray[np.float64] | Kept
    other: NDArray[np.float64] | Kept | None


VALUE = Outer(
    numbers=np.array([[0.1, 1 / 3], [-0.0, 1e-300]]),
    labels=np.array([1, 0], dtype=np.uint8),
    alone=Inner(((6, 7),), "f"),
    inner=Inner(((0, 1), (2, 3)), None),
    several=(Inner((), "a"), Inner(((4, 5),), "b")),
    pair=(3, "c"),
    by_name={"d": Inner((), None)},
    plain={"e": 0.1},
    one=np.ones(2),
    other=Kept(np.zeros(3)),
)


@pytest.mark.parametrize("apart", [False, True], ids=["arrays as lists", "arrays apart"])
def test_a_value_survives_json_to_the_last_bit(apart):
    arrays = {} if apart else None
    text = json.dumps(encode(VALUE, arrays))
    again = decode(Outer, json.loads(text), arrays)
    assert again.numbers.tobytes() == VALUE.numbers.tobytes()
    assert (again.numbers.dtype, again.labels.dtype) == (np.float64, np.uint8)
    assert again.labels.tolist() == [1, 0]
    for field in ("alone", "inner", "several", "pair", "by_name", "plain"):
        assert getattr(again, field) == getattr(VALUE, field)
    assert hash(again.inner) == hash(VALUE.inner)  # tuples again, not lists
    assert again.one.tolist() == [1, 1]
    assert again.other.numbers.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.pop("pair"),
        lambda content: content.update(unknown=1),
        lambda content: content.update(pair=[1]),
        lambda content: content.update(several=[{"cells": []}]),
    ],
)
def test_what_does_not_fit_the_type_is_refused(change):
    content = encode(VALUE)
    change(content)
    with pytest.raises((KeyError, TypeError, ValueError)):
        decode(Outer, content)


def test_a_folder_that_is_not_there_is_named(tmp_path):
    path = tmp_path / "none" / "a.txt"
    with pytest.raises(FileNotFoundError) as error:
        write_text(path, "x")
    assert error.value.filename == str(path)


def test_a_file_is_replaced_whole_or_stays(tmp_path, monkeypatch):
    file = tmp_path / "file.txt"
    write_text(file, "before λ")
    write_text(file, "after")
    assert file.read_text(encoding="utf-8") == "after"
    with pytest.raises(TypeError, match="write"), open_atomic(file) as half:
        half.writelines(["new", 7])

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as caught:
        write_text(file, "half")
    assert Path(caught.value.filename) == file
    assert file.read_text(encoding="utf-8") == "after"
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]


def test_those_who_may_read_a_new_file_may_read_results(tmp_path):
    plain = tmp_path / "plain.txt"
    plain.write_text("")
    written = tmp_path / "written.txt"
    write_text(written, "")
    assert stat.S_IMODE(written.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)
