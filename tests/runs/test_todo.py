"""What a sweep still has to do, for every state of its jobs and every way to go on."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import get_args

import pytest

from xplain.runs.folder import State
from xplain.runs.reuse import Todo, decide

STATES: tuple[State, ...] = get_args(State)
ELSEWHERE = Path("elsewhere")
JOBS = {f"{state} {there}": state for state, there in itertools.product(STATES, (False, True))}
"""A job of each state, with and without the same results elsewhere."""
FOUND = {job: ELSEWHERE for job in JOBS if job.endswith("True")}


def todo(resume: str) -> Todo:
    return decide(JOBS, resume, FOUND)


def test_all_that_is_not_finished_runs_or_is_copied() -> None:
    missing = todo("missing")
    assert {JOBS[job] for job in missing.finished} == {"finished"}
    assert {JOBS[job] for job in missing.run} == {"waiting", "running", "failed"}
    assert {JOBS[job] for job in missing.copied} == {"waiting", "running", "failed"}
    assert {*missing.finished, *missing.run, *missing.copied} == set(JOBS)


def test_only_what_failed_runs_where_that_is_asked() -> None:
    failed = todo("failed")
    assert {JOBS[job] for job in (*failed.run, *failed.copied)} == {"failed"}
    assert failed.finished == todo("missing").finished


def test_all_runs_anew_and_nothing_is_copied_where_that_is_asked() -> None:
    assert todo("none") == Todo((), {}, tuple(JOBS))


@pytest.mark.parametrize("resume", ["missing", "failed", "none"])
def test_each_job_is_one_thing_in_the_order_of_the_sweep(resume: str) -> None:
    own = todo(resume)
    parts = [own.finished, tuple(own.copied), own.run]
    assert sum(map(len, parts)) == len(set().union(*parts))
    for part in parts:
        assert list(part) == [job for job in JOBS if job in part]
    assert set(own.copied.values()) <= {ELSEWHERE}


def test_when_all_are_finished_nothing_is_to_be_done() -> None:
    states: dict[str, State] = dict.fromkeys("abc", "finished")
    for resume in ("missing", "failed"):
        assert decide(states, resume, {"a": ELSEWHERE}) == Todo(("a", "b", "c"), {}, ())
