"""Which jobs a sweep has, what they are called, and when two sweeps are the same."""

from __future__ import annotations

import hashlib
import itertools

import pytest
from hydra.errors import ConfigCompositionException
from omegaconf.errors import ConfigAttributeError

from xplain.errors import InputError
from xplain.runs.plan import in_launch_order, make_plan

SETTINGS = [
    {"domain": "rescue", "solver": "qmdp,qhr", "lambda": "0.5,1"},
    {"domain": "rooms", "users.count": "2,3", "solver": "qmdp,qhr", "lambda": "0.5,1"},
]


def fingerprints(resolved):
    content = str(sorted(resolved.items()))
    return hashlib.sha256(content.encode()).hexdigest(), str(resolved.get("domain"))


def compose(overrides):
    return dict(override.split("=", 1) for override in overrides)


def plan(settings=SETTINGS, arguments=(), name="sweep", fingerprints=fingerprints):
    return make_plan(name, settings, list(arguments), compose, fingerprints)


def test_keys_that_are_forced_are_the_same_keys():
    forced = plan([{}], ["++seed=0,1", "++lambda=0.5,1"]).jobs
    assert [job.values for job in forced] == [
        job.values for job in plan([{}], ["seed=0,1", "lambda=0.5,1"]).jobs
    ]
    with pytest.raises(InputError, match=r"a list, choice\(...\) or range\(...\)"):
        plan([{}], ["solver=glob(q*)"])


def test_jobs_are_the_union_of_the_settings_products():
    jobs = plan().jobs
    values = {tuple(sorted(job.values.items())) for job in jobs}
    wanted = set()
    for solver, trade_off in itertools.product(("qmdp", "qhr"), ("0.5", "1")):
        own = {"solver": solver, "lambda": trade_off}
        wanted.add(tuple(sorted((own | {"domain": "rescue"}).items())))
        for count in ("2", "3"):
            rooms = own | {"domain": "rooms", "users.count": count}
            wanted.add(tuple(sorted(rooms.items())))
    assert values == wanted
    assert len(jobs) == len(wanted)


def test_the_command_line_replaces_what_is_swept():
    jobs = plan(arguments=["lambda=3", "seed=range(2)"]).jobs
    assert {job.values["seed"] for job in jobs} == {"0", "1"}
    assert all("lambda=3" in job.overrides for job in jobs)
    assert len(jobs) == 3 * 2 * 2


def test_the_command_line_chooses_among_settings():
    assert {job.values.get("users.count") for job in plan(arguments=["users.count=3"]).jobs} == {
        None
    }
    only = plan(arguments=["domain=rescue"]).jobs
    assert len(only) == 4
    assert not any("users.count" in override for job in only for override in job.overrides)


def test_two_keys_that_tell_settings_apart_must_both_fit():
    settings = [
        {"domain": "rescue", "users.count": "2"},
        {"domain": "rooms", "users.count": "2,3"},
        {"domain": "taxi", "users.count": "3"},
    ]

    def chosen(*arguments):
        jobs = plan(settings, arguments).jobs
        return {tuple(sorted(job.overrides)) for job in jobs}

    assert chosen("domain=rooms", "users.count=2") == {("domain=rooms", "users.count=2")}
    assert chosen("domain=rescue,rooms", "users.count=2") == {
        ("domain=rescue", "users.count=2"),
        ("domain=rooms", "users.count=2"),
    }
    with pytest.raises(InputError, match="domain='taxi'"):
        plan(settings, ["domain=taxi", "users.count=2"])


def test_a_choice_that_no_setting_has_is_named():
    with pytest.raises(InputError, match=r"domain='taxi'.*rescue.*rooms"):
        plan(arguments=["domain=taxi"])


def test_a_sweep_without_end_is_refused():
    with pytest.raises(InputError, match=r"^lambda='interval\(0,1\)': a list"):
        plan([{}], ["lambda=interval(0,1)"])


def test_jobs_that_compute_the_same_are_one():
    assert len(plan([{"lambda": "1,1"}]).jobs) == 1


def test_names_are_distinct_and_safe_in_paths():
    jobs = plan([{"path": "'a/b','a b','a:b'"}]).jobs
    names = [job.name for job in jobs]
    assert len(set(names)) == 3
    assert not any(set(name) & set("/ :'\"") for name in names)


def test_identity_follows_what_jobs_compute_and_nothing_else():
    one = plan()
    assert plan().identity == one.identity
    assert plan(name="other").identity != one.identity
    assert plan(arguments=["lambda=0.5"]).identity != one.identity
    changed = plan(fingerprints=lambda resolved: (fingerprints(resolved)[0] + "new code", ""))
    assert changed.identity != one.identity


def test_one_job_of_each_source_is_launched_first():
    jobs = in_launch_order(plan().jobs)
    assert {job.source for job in jobs[:2]} == {"rescue", "rooms"}
    assert sorted(job.name for job in jobs) == sorted(job.name for job in plan().jobs)


def test_names_sort_by_setting_then_solver_trade_off_and_seed():
    swept = {"seed": "1,2", "lambda": "1,2", "solver": "qmdp,qhr", "users.count": "2,3"}
    jobs = plan([swept | {"domain": "rescue,rooms"}]).jobs
    for job in jobs:
        keys = [part.partition("=")[0] for part in job.name.split(",")]
        assert keys[-3:] == ["solver", "lambda", "seed"]
        assert set(keys[:-3]) == {"domain", "users.count"}
        assert job.name == ",".join(f"{key}={job.values[key]}" for key in keys)
        assert set(job.label.split()) == {
            job.values["domain"],
            f"count={job.values['users.count']}",
            job.values["solver"],
            f"λ={job.values['lambda']}",
            f"seed={job.values['seed']}",
        }


@pytest.mark.parametrize("written", ["true,tree", [True, "tree"]])
def test_a_choice_that_reads_as_a_truth_value_is_still_a_name(written):
    """``labeler=true``: Hydra takes it for a bool, and a group's choice must be text."""
    one, other = plan([{"labeler": written}]).jobs
    assert (one.overrides, other.overrides) == (("labeler='true'",), ("labeler=tree",))
    assert plan([{"domain.sparse": "true"}]).jobs[0].overrides == ("domain.sparse=true",)


def test_a_key_that_some_solvers_have_varies_where_it_is_and_is_noted_where_not():
    def composed(overrides):
        values = compose(overrides)
        if "solver.simulations" in values and values["solver"] != "pomcp":
            cause = ConfigAttributeError("no such key")
            cause.full_key = "solver.simulations"
            raise ConfigCompositionException("Could not override") from cause
        return values

    def made(solvers):
        swept = {"solver": solvers, "solver.simulations": "10,20"}
        return make_plan("sweep", [swept], [], composed, fingerprints)

    mixed = made("pomcp,qmdp,qhr")
    assert [job.label for job in mixed.jobs] == [
        "simulations=10 pomcp",
        "simulations=20 pomcp",
        "qmdp",
        "qhr",
    ]
    assert mixed.notes == ("solver.simulations: no key of qmdp, qhr",)
    assert made("pomcp").notes == ()
    for without in ("qmdp", "qmdp,qhr"):  # nobody has it: a mistake
        with pytest.raises(ConfigCompositionException):
            made(without)
