"""The campaign itself, on a repository of one module."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections import Counter
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="make mutants installs it")

from tests.mutants import campaign, operators
from tests.mutants.areas import Areas, Mutant, Stage
from tests.mutants.campaign import Campaign, Session
from tests.mutants.report import Equivalent, equivalents, report
from tests.mutants.scratch import KILLED, SURVIVED, TIMEOUT, Copy

ROOT = Path(__file__).parents[2]
BOX = '''
LIMIT = 3


def clamp(x):
    """At most LIMIT."""
    if x > LIMIT:
        return LIMIT
    return x


def fill(n):
    done = 0
    while done < n:
        done += 1
    return done
'''
TABLE = {"areas": {"box": {"sources": ["box/*.py"]}}}


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Areas:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # half a second each
    root = tmp_path / "toy"
    for path, text in {
        "box/__init__.py": "",
        "box/lid.py": BOX,
        "tests/test_lid.py": """
            from box.lid import clamp, fill

            def test_clamp():
                assert [clamp(x) for x in (2, 3, 4)] == [2, 3, 3]

            def test_fill():
                assert fill(2) == 2
        """,
    }.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(textwrap.dedent(text))
    return Areas(root, TABLE)


def _all(areas: Areas) -> list[Mutant]:
    return areas.draw(1000, 1, [])


def _one(areas: Areas, after: str) -> Mutant:
    (found,) = {
        mutant.key: mutant
        for seed in range(40)
        for mutant in areas.draw(1000, seed, [])
        if mutant.after == after
    }.values()
    return found


def _state(root: Path) -> dict[str, tuple[bytes, int]]:
    return {
        str(path.relative_to(root)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in root.rglob("*")
        if path.is_file()
    }


def test_a_mistake_is_killed_by_name_an_equivalent_survives_an_endless_loop_is_ended(
    toy: Areas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign, "SLACK", 1)
    before = _state(toy.root)
    mistake, same, endless = (
        _one(toy, line) for line in ("if x <= LIMIT:", "if x >= LIMIT:", "done -= 1")
    )
    Campaign(toy, Session(tmp_path / "session"), say=str).run([mistake, same, endless], jobs=2)
    found = Session(tmp_path / "session").outcomes()
    assert found[mistake.key].outcome == KILLED
    assert found[mistake.key].killer == "tests/test_lid.py::test_clamp"
    assert found[same.key].outcome == SURVIVED
    assert found[endless.key].outcome == TIMEOUT
    assert _state(toy.root) == before

    known = [Equivalent(same.path, same.function, same.before, same.after, "min either way")]
    explained = report(found.values(), known, toy.root)
    assert "100%" in explained
    assert same.after not in explained
    told = report(found.values(), [], toy.root)
    assert "67%" in told
    assert f"- {same.before}\n+ {same.after}" in told


def test_tests_that_fail_anyway_kill_nothing(toy: Areas, tmp_path: Path) -> None:
    broken = toy.root / "tests/test_lid.py"
    broken.write_text(broken.read_text() + "\n\ndef test_broken():\n    assert False\n")
    said: list[str] = []
    Campaign(toy, Session(tmp_path / "session"), said.append).run(
        [_one(toy, "if x <= LIMIT:")], jobs=1
    )
    (found,) = Session(tmp_path / "session").outcomes().values()
    assert found.outcome == SURVIVED
    assert "test_broken" in said[0]


def test_ctrl_c_leaves_nothing_and_the_session_goes_on(toy: Areas, tmp_path: Path) -> None:
    slow = """
        import subprocess, sys, time

        def test_slow():
            apart = [sys.executable, "-c", "import time; time.sleep(300)"]
            subprocess.Popen(apart, start_new_session=True)
            time.sleep(1)
    """
    tests = toy.root / "tests/test_lid.py"
    tests.write_text(textwrap.dedent(slow) + tests.read_text())
    before = _state(toy.root)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    program = f"""if True:
        from pathlib import Path
        from tests.mutants.areas import Areas
        from tests.mutants.campaign import Campaign, Session
        areas = Areas(Path({str(toy.root)!r}), {TABLE!r})
        session = Session(Path({str(tmp_path / "session")!r}))
        Campaign(areas, session).run(areas.draw(30, 1, []), jobs=2)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=os.environ | {"TMPDIR": str(scratch)},
        stderr=subprocess.PIPE,
    )
    session = Session(tmp_path / "session")
    ends = time.monotonic() + 60
    while len(session.outcomes()) < 2 and time.monotonic() < ends:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert process.returncode != 0
    assert b"KeyboardInterrupt" in error
    assert not list(scratch.iterdir())
    assert _state(toy.root) == before
    assert not [pid for pid in Path("/proc").glob("[0-9]*") if str(scratch) in _environment(pid)]
    known = session.outcomes()
    assert 2 <= len(known) < 30
    assert set(known) <= {mutant.key for mutant in toy.draw(30, 1, [])}
    with session.path.open("a") as file:
        file.write('{"mutant": {"area"')  # as a crash leaves it
    assert set(session.outcomes()) == set(known)
    session.add("baseline", test="a", compiled=True, cpu=1.0, wall=2.0)
    assert set(session.outcomes()) == set(known)
    assert session.baselines()[Stage(("a",))] == (1.0, 2.0)


def _environment(process: Path) -> str:
    try:
        return (process / "environ").read_text()
    except OSError:
        return ""


def test_a_smaller_sample_is_the_beginning_of_a_larger_one(toy: Areas) -> None:
    keys = [mutant.key for mutant in _all(toy)]
    assert len(keys) == len(set(keys)) > 5
    assert [mutant.key for mutant in toy.draw(5, 1, [])] == keys[:5]
    assert [mutant.key for mutant in toy.draw(5, 2, [])] != keys[:5]


def test_every_area_has_an_equal_share() -> None:
    areas = Areas.load(ROOT)
    some = ["mdp", "slots", "interaction"]
    drawn = areas.draw(12, 3, some)
    assert Counter(mutant.area for mutant in drawn) == dict.fromkeys(some, 4)
    for mutant in drawn:
        source = (ROOT / mutant.path).read_text("utf-8")
        assert mutant.before.splitlines()[0] in source
        assert areas.stages(mutant.area, mutant.path)
    everything = [path for area in areas.table["areas"] for path in areas.sources(area)]
    assert len(everything) == len(set(everything))


def test_what_is_no_mistake_is_left_alone() -> None:
    source = textwrap.dedent('''
        from a import b
        __all__ = ["p", "q", "r"]

        @d(frozen=True)
        def f(a: int | None, b: "x" = None) -> A | B:
            """Not 1 + 1."""
            c: int | None = g
            log.info("%d", 1 + 1)
            warnings.warn("a" + "b", stacklevel=2)
            h = zip(a, b, strict=True)
            raise InputError(f"{a + 1} is not < 2")
    ''')
    assert not list(operators.places(source))


@pytest.mark.parametrize(
    ("source", "mutants"),
    [
        ("x = a + b", {"x = a - b"}),
        ("x = a < b", {"x = a <= b", "x = a >= b"}),
        ("x = not a", {"x =  a"}),
        ("x = -a", {"x = a"}),
        ("x = a and b", {"x = a or b"}),
        ("x = max(a)", {"x = min(a)"}),
        ("x = all(a)", {"x = any(a)"}),
        ("x = a.max", set()),
        ("f(a)", {"pass"}),
        ("a.b = c", {"pass"}),
        ("a = c", set()),
        ("a += c", {"a -= c", "pass"}),
        ('x = ("a", "b", "c")', {'x = ( "b", "c")', 'x = ("a", "c")', 'x = ("a", "b",)'}),
        ('x = {"a": b, "c": d}', {'x = { "c": d}', 'x = {"a": b,}'}),
        ("x = savez(f, a=b, c=d)", {"x = savez(f, c=d)", "x = savez(f, a=b,)"}),
        ("x = other(f, a=b)", set()),
    ],
)
def test_mistakes(source: str, mutants: set[str]) -> None:
    source += "\n"
    found = {
        operators.mutate(source, name, which) for name, which, _, _ in operators.places(source)
    }
    assert {" ".join(one.split()) for one in found if one} == {
        " ".join(one.split()) for one in mutants
    }


def test_kernels_of_a_mutant_are_gone_after_it(toy: Areas, tmp_path: Path) -> None:
    mutant = next(iter(_all(toy)))
    copy = Copy(toy.root, tmp_path / "scratch")
    kernels = copy.folder / "compiled/xplain/kernels"
    (kernels / "sound").mkdir(parents=True)
    before = _state(copy.folder)
    with copy.mutated(mutant):
        assert mutant.after in (copy.root / mutant.path).read_text()
        (kernels / "mutant").mkdir()
        (kernels / "mutant" / "clamp.nbc").touch()
    assert _state(copy.folder) == before
    assert [folder.name for folder in kernels.iterdir()] == ["sound"]


def test_the_quickest_tests_come_first_but_for_the_modules_own(toy: Areas, tmp_path: Path) -> None:
    own = toy.root / "tests/test_lid.py"
    text = own.read_text()
    own.write_text("import box.lid\n\ndef test_nothing():\n    pass\n")
    session = Session(tmp_path / "session")
    session.add("baseline", test="tests/test_lid.py", compiled=True, cpu=50, wall=50)
    for name, cpu in (("b", 9), ("c", 1), ("d", 30)):
        (toy.root / f"tests/test_{name}.py").write_text(text)
        session.add("baseline", test=f"tests/test_{name}.py", compiled=True, cpu=cpu, wall=cpu)
    mistake = _one(toy, "if x <= LIMIT:")
    Campaign(toy, session, say=str).run([mistake], jobs=1)
    assert session.outcomes()[mistake.key].killer == "tests/test_c.py::test_clamp"


def test_stages_are_near_before_wide(tmp_path: Path) -> None:
    for path, text in {
        "box/lid/a.py": "",
        "tests/lid/test_a.py": "import box.lid.a",
        "tests/lid/test_b.py": "from box.lid import a",
        "tests/test_c.py": "from box.lid.a import f",
        "tests/test_d.py": "",
        "tests/test_e.py": "",
        "tests/test_f.py": "import box.lid.a",
    }.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    table = {
        "areas": {"box": {"sources": ["box/**/*.py"], "tests": ["tests/test_d.py"]}},
        "left_out": ["tests/test_f.py"],
    }
    assert Areas(tmp_path, table).stages("box", "box/lid/a.py") == [
        Stage(("tests/lid/test_a.py",)),
        Stage(("tests/lid/test_b.py", "tests/test_c.py", "tests/test_d.py")),
    ]
    table["uncompiled"] = {"box/lid/a.py": ["tests/lid/test_a.py"]}
    assert Areas(tmp_path, table).stages("box", "box/lid/a.py")[0] == Stage(
        ("tests/lid/test_a.py",), compiled=False
    )
    with pytest.raises(SystemExit, match="no file is gone"):
        Areas(tmp_path, {"areas": {"box": {"sources": ["gone/*.py"]}}})


def test_an_equivalent_follows_its_line_and_its_file(toy: Areas) -> None:
    mutant = _one(toy, "if x >= LIMIT:")
    entry = Equivalent(mutant.path, mutant.function, mutant.before, mutant.after, "why")
    lid = toy.root / mutant.path
    lid.write_text("\n\n\nFIRST = 0\n" + BOX)
    shifted = _one(toy, "if x >= LIMIT:")
    assert shifted.line == mutant.line + 4
    assert entry.is_(shifted, toy.root)
    assert not entry.is_(_one(toy, "if x <= LIMIT:"), toy.root)
    other = Equivalent("box/__init__.py", mutant.function, mutant.before, mutant.after, "why")
    assert not other.is_(shifted, toy.root)
    lid.rename(toy.root / "box/cover.py")
    assert entry.is_(_one(toy, "if x >= LIMIT:"), toy.root)


def test_every_equivalent_has_a_reason_and_its_line_is_there(tmp_path: Path) -> None:
    known = equivalents(Path(__file__).with_name("equivalent.toml"))
    for one in known:
        lines = {line.strip() for line in (ROOT / one.file).read_text("utf-8").splitlines()}
        assert set(one.before.splitlines()) <= lines, one
    bare = tmp_path / "equivalent.toml"
    bare.write_text(
        '[[mutant]]\nfile = "a"\nfunction = ""\nbefore = "b"\nafter = "c"\nreason = " "\n'
    )
    with pytest.raises(SystemExit, match="lacks a reason"):
        equivalents(bare)
