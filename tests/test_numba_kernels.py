"""The tools for kernels: their cache, reports of compilations, kernels without reference counts."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numba
import numpy as np
from packaging.requirements import Requirement

from xplain.numba_kernels import count_bits, first_bit, next_uniform, nth_bit, search

ROOT = Path(__file__).parents[1]


def run(folder: Path, code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs code in a process that finds our package and the folder's modules."""
    own = {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=os.environ | own | environment,
        check=True,
        capture_output=True,
        text=True,
    )


DOUBLE = """
from xplain.numba_kernels import kernel
@kernel
def double(x):
    return 2 * x
double.py_func.__module__ = "xplain.mine"
print(double(4), double(4.5))
"""


def test_a_later_process_loads_what_was_compiled_unless_a_part_was_edited(tmp_path: Path) -> None:
    """numba itself notices edits of a kernel's own file alone."""
    (tmp_path / "mine.py").write_text(
        "from shared import times\nfrom xplain.numba_kernels import kernel\n"
        "@kernel\ndef double(x):\n    return times(x)\n"
        "print(double(4), double(4.5), len(double.stats.cache_hits))\n"
    )
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    for factor, out in ((2, "8 9.0 0\n"), (2, "8 9.0 2\n"), (3, "12 13.5 0\n")):
        (tmp_path / "shared.py").write_text(
            "from xplain.numba_kernels import part\n"
            f"@part\ndef times(x):\n    return {factor} * x\n"
        )
        assert run(tmp_path, "import mine", **cache).stdout == out


def test_works_where_nothing_can_be_written(tmp_path: Path) -> None:
    """A line says so; the kernel compiles, and this is reported once."""
    (tmp_path / "file").touch()
    places = dict.fromkeys(("NUMBA_CACHE_DIR", "HOME", "XDG_CACHE_HOME"), str(tmp_path / "file"))
    done = run(tmp_path, DOUBLE.replace("@kernel", "@kernel  # of no file"), **places)
    assert done.stdout == "8 9.0\n"
    assert "NUMBA_CACHE_DIR" in done.stderr
    assert done.stderr.count("compiling kernels") == 1  # of two


@search
def _sums(pair):  # type: ignore[no-untyped-def]
    """Sums arrays in a tuple within a tuple."""
    first, (second, number) = pair
    return first.sum() + number * second[1].sum()


def test_a_search_borrows_the_arrays_of_its_caller() -> None:
    pair = np.arange(3.0), (np.ones((2, 4)), 2)
    references = sys.getrefcount(pair[0]), sys.getrefcount(pair[1][0])
    assert [_sums(pair) for _ in range(100)] == [11.0] * 100
    assert (sys.getrefcount(pair[0]), sys.getrefcount(pair[1][0])) == references


@numba.njit
def _draw(counter):  # type: ignore[no-untyped-def]
    return next_uniform(counter)


@numba.njit
def _bits(mask, r):  # type: ignore[no-untyped-def]
    return first_bit(mask), count_bits(mask), nth_bit(mask, r)


def test_bits_of_masks() -> None:
    rng = np.random.default_rng(0)
    for mask in [1, 1 << 62, *rng.integers(1, 1 << 62, 50).tolist()]:
        places = [j for j in range(63) if mask >> j & 1]
        for r in (0, len(places) - 1):
            assert _bits(mask, r) == (places[0], len(places), places[r])


def test_random_numbers_are_those_of_the_published_generator() -> None:
    """Vigna's splitmix64 with the seed 1234567; a number has the first 53 bits of a word."""
    words = 6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431
    counter = np.array([1234567], np.uint64)
    assert [_draw(counter) for _ in words] == [(word >> 11) / 2**53 for word in words]


def test_numba_is_bounded_by_the_version_that_is_tested() -> None:
    """Any version may change functions that kernels use, so no untested version is installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (bound,) = [Requirement(one) for one in project["dependencies"] if one.startswith("numba>")]
    tested = (ROOT / "constraints.txt").read_text().split("\nnumba==")[1]
    major, minor = (int(part) for part in tested.split(".")[:2])
    assert bound.specifier.contains(numba.__version__)
    assert not bound.specifier.contains(f"{major}.{minor + 1}.0")
