"""Message sets as masks, names and bits."""

from __future__ import annotations

import numpy as np
import pytest

from xplain.errors import InputError
from xplain.explanation.message_sets import (
    bits_of,
    compress,
    expand,
    indices,
    mask_of,
    names_of,
    subsets,
)

NAMES = ("fuel", "door", "alarm")


def test_names_and_masks_are_each_others() -> None:
    """Whatever the order in which they are named; the names come out sorted."""
    for mask in range(8):
        names = names_of(mask, NAMES)
        assert list(names) == sorted(name for j, name in enumerate(NAMES) if mask >> j & 1)
        assert mask_of(names[::-1], NAMES) == mask_of([*names, *names], NAMES) == mask
    with pytest.raises(InputError, match="data='rain': unknown message; known: fuel, door, alarm"):
        mask_of(["fuel", "rain"], NAMES, "data")


def test_the_last_of_62_messages_is_one_like_any() -> None:
    masks = np.array([1 << 61, (1 << 62) - 1, 0, 5])
    bits = bits_of(masks, 62)
    assert bits.shape == (4, 62)
    assert [sum(int(b) << j for j, b in enumerate(row)) for row in bits] == masks.tolist()
    assert [indices(mask) for mask in (1 << 61, 0, 5)] == [[61], [], [0, 2]]
    assert subsets([0, 61]).tolist() == [0, 1, 1 << 61, 1 + (1 << 61)]


def test_subsets_ascend_and_are_all() -> None:
    assert subsets([1, 2, 4]).tolist() == [m for m in range(32) if m & ~0b10110 == 0]
    assert subsets([]).tolist() == [0]


def test_a_mask_of_some_messages_is_one_of_all_and_back() -> None:
    kept = (1, 2, 5)
    for mask in range(8):
        whole = expand(mask, kept)
        assert indices(whole) == [kept[i] for i in indices(mask)]
        assert compress(whole, kept) == mask
        assert compress(whole | 1 << 3, kept) == mask  # what is not kept is left out
