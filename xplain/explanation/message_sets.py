"""Message sets: an integer bitmask inside, a sorted tuple of names in all interfaces.

Bit j of a mask is message j (in the order of the domain's parameters).
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from xplain.errors import one_of


def names_of(mask: int, messages: Sequence[str]) -> tuple[str, ...]:
    """Returns the names in a mask, sorted."""
    return tuple(sorted(name for j, name in enumerate(messages) if mask >> j & 1))


def mask_of(names: Iterable[str], messages: Sequence[str], key: str = "messages") -> int:
    """Returns the mask of these names.

    Raises:
        InputError: a name is not among ``messages``.
    """
    mask = 0
    for name in names:
        mask |= 1 << messages.index(one_of(key, name, messages, "message"))
    return mask


def bits_of(masks: NDArray[np.int64], count: int) -> NDArray[np.uint8]:
    """Returns [P, count] the bits of masks [P]."""
    return ((masks[:, None] >> np.arange(count)) & 1).astype(np.uint8)


def indices(mask: int) -> list[int]:
    """Lists the positions of a mask's bits that are 1, ascending."""
    return [j for j in range(mask.bit_length()) if mask >> j & 1]


def subsets(messages: Iterable[int]) -> NDArray[np.int64]:
    """Lists the masks of all subsets of some messages, in ascending order if the messages are
    ascending."""
    masks = np.zeros(1, dtype=np.int64)
    for j in messages:
        masks = np.concatenate([masks, masks | 1 << j])
    return masks


def expand(mask: int, kept: Sequence[int]) -> int:
    """Converts a bitmask over the messages ``kept`` to a bitmask over all messages. Bit i of the
    given mask is message ``kept[i]``; bit j of the result is message j."""
    return sum(1 << j for i, j in enumerate(kept) if mask >> i & 1)


def compress(mask: int, kept: Sequence[int]) -> int:
    """Converts a bitmask over all messages to a bitmask over the messages ``kept``, and leaves out
    all other messages. Bit j of the given mask is message j; bit i of the result is message
    ``kept[i]``."""
    return sum(1 << i for i, j in enumerate(kept) if mask >> j & 1)
