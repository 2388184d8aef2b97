"""What saying a message again costs, and how often it may be said.

Where users may miss or forget messages, one may be said again. What was said so far is seen, as H
is: it goes with the state as a number whose n lowest bits are the messages said at least once, the
next n those said at least twice, and so on, as far as it matters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from xplain.errors import Count, Range, checks


@checks("again")
@dataclass(frozen=True)
class Again:
    """The paper says nothing twice; the defaults are a message's usual price, and no limit.

    Args:
        price: factor on λ C_e of a message that was said at an earlier step.
        most: times that a message may be said in one explanation; None for no limit.
    """

    price: Annotated[float, Range(0)] = 1.0
    most: Count | None = None

    @property
    def levels(self) -> int:
        """So often being said makes a difference to what may come; 0 where it makes none."""
        return self.most or int(self.price != 1)

    def after(self, said: int, new: int, messages: int) -> int:
        """What was said once these messages (a bitmask) are said, of so many."""
        for level in range(max(self.levels, 1)):
            before = said >> level * messages
            said |= new << level * messages
            new &= before
        return said

    def exhausted(self, said: int, messages: int) -> int:
        """Bitmask of the messages that may not be said any more."""
        return said >> (self.most - 1) * messages if self.most else 0
