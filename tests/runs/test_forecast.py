"""How long the jobs of a sweep will take, judged by those that are finished."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from omegaconf import OmegaConf

from xplain.runs import forecast
from xplain.runs.forecast import expected_seconds, experience, print_dry_run
from xplain.runs.plan import Plan
from xplain.runs.reuse import Todo


def config(domain: str, solver: str, traces: int) -> dict[str, Any]:
    return {"domain": {"_target_": domain}, "solver": {"_target_": solver}, "traces": traces}


def test_the_jobs_most_alike_are_the_judge() -> None:
    known = [
        experience(config("rescue", "qmdp", 10), 20.0),
        experience(config("rescue", "qmdp", 20), 20.0),
        experience(config("rescue", "qmdp", 1), 9.0),
        experience(config("rooms", "qmdp", 1), 30.0),
        experience(config("rooms", "pomcp", 1), 40.0),
    ]
    assert expected_seconds(known, config("rescue", "qmdp", 3)) == 3 * 2.0  # of 2, 1 and 9
    assert expected_seconds(known, config("warehouse", "qmdp", 2)) == 2 * 5.5  # and 30
    assert expected_seconds(known, config("rescue", "pomcp", 1)) == 40.0
    assert expected_seconds(known, config("rescue", "qhr", 1)) is None  # nobody knows
    more = config("rescue", "pomcp", 1)
    more["solver"] |= {"simulations": 1e10}
    assert expected_seconds(known, more) is None  # another search than those known
    assert expected_seconds([], config("rescue", "qmdp", 3)) is None


@pytest.mark.parametrize(
    ("launcher", "said"),
    [
        ({}, "about 40 s on 1 worker,"),
        ({"n_jobs": 2}, "about 20 s on 2 workers,"),
        ({"n_jobs": 8}, "about 10 s on 4 workers,"),
        ({"n_jobs": -1}, "about 13 s on 3 workers,"),
        ({"n_jobs": None}, "about 13 s on 3 workers,"),
    ],
)
def test_the_launcher_says_how_many_work_at_a_time(
    launcher: dict[str, Any],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(
        forecast, "experiences", lambda _: [experience(config("rescue", "qmdp", 2), 1.0)]
    )
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    jobs = [SimpleNamespace(fingerprint=str(i), label=f"seed={i}") for i in range(4)]
    todo = Todo((), {}, tuple(job.fingerprint for job in jobs))
    print_dry_run(
        cast("Plan", SimpleNamespace(jobs=jobs)),
        todo,
        cast("Any", None),
        OmegaConf.create({"hydra": {"launcher": launcher}}),
        {job.fingerprint: config("rescue", "qmdp", 20) for job in jobs},
    )
    told = capsys.readouterr().out
    assert "4 jobs: 0 done, 0 done elsewhere (to be copied), 4 to run" in told
    assert said in told
    assert "judged by 1 finished job\n" in told


def test_jobs_that_nobody_can_judge_are_counted_apart(capsys: pytest.CaptureFixture[str]) -> None:
    print(forecast._time([2.0, None, None], 1, 4))
    told = capsys.readouterr().out
    assert "about 2 s on 1 worker, and 2 jobs unlike all that have finished, judged by 4" in told
