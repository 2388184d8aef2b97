"""Named random streams of one seed (docs/method.md, section 8).

Each component draws from its own stream. So another solver leaves data and traces unchanged, and
results do not depend on the number of processes.
"""

import zlib

import numpy as np

from xplain.errors import whole_number

MOST = (1 << 32) - 1
"""Maximum seed of a run."""


def sequence(seed: int, *names: str | int) -> np.random.SeedSequence:
    """Returns the seed sequence of a component. The component has a path of names, such as
    ``"observers", 3`` for observer 3."""
    key = [name if isinstance(name, int) else zlib.crc32(name.encode()) for name in names]
    return np.random.SeedSequence(seed, spawn_key=tuple(key))


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Returns a new generator for the component with this path of names; equal arguments give
    equal draws."""
    return np.random.default_rng(sequence(seed, *names))


def below(rng: np.random.Generator, *names: str | int) -> np.random.Generator:
    """Returns a new generator whose stream is derived from the seed of ``rng`` and a path of
    names. It does not depend on earlier draws from ``rng``."""
    parent = rng.bit_generator.seed_seq
    assert isinstance(parent, np.random.SeedSequence), "every stream here has a seed sequence"
    key = (*parent.spawn_key, *sequence(0, *names).spawn_key)
    return np.random.default_rng(np.random.SeedSequence(parent.entropy, spawn_key=key))


def run_seed(value: object) -> int:
    """Checks the seed of a run and returns it. All streams are derived from this seed;
    scikit-learn's ``random_state`` accepts it.

    Raises:
        InputError: not a whole number from 0 to 2^32 − 1.
    """
    return whole_number("seed", value, 0, MOST)


def derive_seed(seed: int, *names: str | int) -> int:
    """Returns a 63-bit seed for code that needs an integer (scikit-learn takes its low 32 bits)."""
    return int(sequence(seed, *names).generate_state(1, np.uint64)[0] >> np.uint64(1))
