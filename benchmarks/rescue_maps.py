"""A random generator of maps for the rescue task. The task's default map is such a map
(docs/choices.md)."""

import numpy as np

SIZE = 6
"""Rows, and columns."""
ONE_OF_EACH = "SVAFU"
"""Shelter, victim, first aid, fire, fuel station: each in one cell."""
OBSTACLES = "rpf"
"""Rubble, puddle, fence: each in one to MOST_OBSTACLES cells, every number equally likely."""
MOST_OBSTACLES = 3
MOST_WALLS = SIZE * SIZE // 4
"""Walls are in none to this many cells, every number equally likely."""


def random_map(rng: np.random.Generator) -> str:
    """Draws a 6 × 6 map. The numbers of obstacles and walls are drawn first, then everything is put
    into different cells uniformly at random; the rest is floor. Some cells may be out of reach."""
    symbols = ONE_OF_EACH
    for obstacle in OBSTACLES:
        symbols += obstacle * int(rng.integers(1, MOST_OBSTACLES + 1))
    symbols += "#" * int(rng.integers(0, MOST_WALLS + 1))
    cells = rng.permutation(list(symbols.ljust(SIZE * SIZE, "."))).reshape(SIZE, SIZE)
    return "".join("".join(row) + "\n" for row in cells)
