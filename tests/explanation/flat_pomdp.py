"""A reader of the ``.pomdp`` text that :mod:`xplain.explanation.files` writes. It reads like any
other program, without knowledge about explanations."""

from collections import defaultdict
from dataclasses import dataclass, field

from xplain.errors import InputError


@dataclass(frozen=True)
class Flat:
    """A POMDP from a file; missing entries are 0.

    Attributes:
        discount: γ.
        states, actions, observations: numbers of these.
        start: initial belief, one number for each state.
        transition: {(action, state): {next state: probability}}.
        observation: {(action, next state): {observation: probability}}.
        reward: {(action, state): expected value}.
    """

    discount: float
    states: int
    actions: int
    observations: int
    start: tuple[float, ...]
    transition: dict[tuple[int, int], dict[int, float]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    observation: dict[tuple[int, int], dict[int, float]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    reward: dict[tuple[int, int], float] = field(default_factory=dict)


def read(text: str) -> Flat:
    """Reads numeric entries, one on each line; rewards are by action and state.

    Raises:
        InputError: a line of another form.
    """
    header: dict[str, str] = {}
    flat: Flat | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            key, rest = line.split(":", 1)
            if key not in ("T", "O", "R"):
                header[key] = rest
                continue
            flat = flat or _flat(header)
            *places, last = rest.split(":")
            place, value = last.split()
            action, state, *wildcards = places
            if key == "R":
                if [part.strip() for part in (*wildcards, place)] != ["*", "*"]:
                    raise ValueError
                flat.reward[int(action), int(state)] = float(value)
            else:
                if wildcards:
                    raise ValueError
                entries = flat.transition if key == "T" else flat.observation
                entries[int(action), int(state)][int(place)] = float(value)
        except (ValueError, IndexError, KeyError):
            raise InputError("pomdp", line, f"line {number} is no numeric entry") from None
    if flat is None:
        raise InputError("pomdp", text[:20], "no entries")
    return flat


def _flat(header: dict[str, str]) -> Flat:
    return Flat(
        float(header["discount"]),
        int(header["states"]),
        int(header["actions"]),
        int(header["observations"]),
        tuple(float(p) for p in header["start"].split()),
    )
