"""PDDL files as tasks, through unified-planning (the extra ``pddl``)."""

from __future__ import annotations

import re
import warnings
from importlib.resources import files
from pathlib import Path
from typing import Any, NoReturn

from xplain.domains.pddl.task import EQUAL, Action, Atom, Effect, Literal, Task
from xplain.errors import InputError, XplainError

REQUIREMENTS = (
    ":strips",
    ":typing",
    ":equality",
    ":negative-preconditions",
    ":conditional-effects",
    ":action-costs",
)
"""What a domain may require."""
CONSTRUCTS = {
    r"\(\s*(:derived)\b": "derived predicates",
    r"-\s*\(\s*(either)\b": "either types",
    r"\(\s*(:constraints)\b": "constraints on trajectories",
    r"\(\s*(preference)\s+[^\s()]*\s*\(": "preferences",
    r"\(\s*(:process)\b": "processes",
    r"\(\s*(:event)\b": "events",
}
"""Constructs of PDDL that unified-planning's grammar lacks, by the word that shows them."""
SUPPORTED = (
    "supported are STRIPS with types, equality, negative preconditions, conditional effects, and "
    "costs with (:metric minimize (total-cost))"
)
KNOWN = {
    "ACTION_BASED",
    "NEGATIVE_CONDITIONS",
    "EQUALITIES",
    "CONDITIONAL_EFFECTS",
    "FLAT_TYPING",
    "HIERARCHICAL_TYPING",
    "ACTIONS_COST",
    "PLAN_LENGTH",
    "STATIC_FLUENTS_IN_ACTIONS_COST",
    "INT_NUMBERS_IN_ACTIONS_COST",
    "REAL_NUMBERS_IN_ACTIONS_COST",
    "UNDEFINED_INITIAL_NUMERIC",  # refused later, if it is the cost of an action
}
"""The features of a task that are allowed, in unified-planning's names."""
PACKAGED = "pkg://"


def read_text(key: str, path: object) -> str:
    """The text of a file; ``pkg://package/path`` is one inside an installed package.

    Raises:
        InputError: there is no such file, or it is not text.
    """
    if not isinstance(path, str) or not path:
        raise InputError(key, path, "the path of a PDDL file")
    try:
        if path.startswith(PACKAGED):
            package, _, inside = path.removeprefix(PACKAGED).partition("/")
            return files(package).joinpath(inside).read_text(encoding="utf-8")
        return Path(path).read_text(encoding="utf-8")
    except (OSError, ModuleNotFoundError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(key, path, f"cannot be read: {reason}") from None
    except UnicodeDecodeError:
        raise InputError(key, path, "a text in UTF-8") from None


def read_task(file: object, problem: object, keys: tuple[str, str]) -> Task:
    """The task of a domain and a problem file.

    Args:
        file, problem: their paths.
        keys: of the two in the configuration, for errors.

    Raises:
        XplainError: unified-planning is not installed.
        InputError: a file cannot be read, is not PDDL (with the line), or uses PDDL that is not
            supported.
    """
    try:
        from unified_planning.io import PDDLReader
    except ImportError:
        raise XplainError(
            "domain: PDDL tasks need unified-planning: pip install 'xplain-hri[pddl]'"
        ) from None
    texts = (read_text(keys[0], file), read_text(keys[1], problem))
    for key, path, text in zip(keys, (file, problem), texts, strict=True):
        _require_supported(key, path, text)
    try:
        found = _parsed(keys[1], problem, lambda: PDDLReader().parse_problem_string(*texts))
    except InputError:  # which file is wrong? The domain, if it cannot be read alone.
        _parsed(keys[0], file, lambda: PDDLReader().parse_problem_string(texts[0], None))
        raise
    unsupported = sorted(set(found.kind.features) - KNOWN)
    if unsupported:
        raise InputError(
            keys[0],
            file,
            f"unsupported: {', '.join(name.lower().replace('_', ' ') for name in unsupported)}; "
            f"{SUPPORTED}",
        )
    return _task(found, keys, (file, problem))


def _require_supported(key: str, file: object, text: str) -> None:
    """Raises InputError if a file requires or uses PDDL that is not supported."""
    without_comments = re.sub(r";[^\n]*", "", text.lower())

    def refuse(at: int, what: str) -> NoReturn:
        line = without_comments[:at].count("\n") + 1
        raise InputError(key, file, f"line {line}: unsupported {what}")

    declared = re.search(r"\(\s*:requirements([^)]*)\)", without_comments)
    for requirement in declared[1].split() if declared else ():
        if requirement not in REQUIREMENTS:
            known = f"supported: {', '.join(REQUIREMENTS)}"
            refuse(without_comments.index(requirement), f"requirement {requirement}; {known}")
    for pattern, name in CONSTRUCTS.items():
        if used := re.search(pattern, without_comments):
            refuse(used.start(1), f"{name} ({used[1]}); {SUPPORTED}")


def _parsed(key: str, file: object, parse: Any) -> Any:
    """What ``parse`` returns.

    Raises:
        InputError: the file's error, with its line if the parser gives it.
    """
    from pyparsing import ParseBaseException
    from unified_planning.environment import get_environment
    from unified_planning.exceptions import UPException

    environment = get_environment()
    strict, environment.error_used_name = environment.error_used_name, False
    try:  # in PDDL an object and a type may share a name
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return parse()
    except ParseBaseException as error:
        reason = f"line {error.lineno}, column {error.col}: {error.msg}, found {error.found}"
    except SyntaxError as error:
        place = re.search(r"line: (\d+), col:? ?(\d+)", str(error))
        text = re.split(r"\s*(?:\n|Error from|[Ff]ound at|From) ?(?=line|Error|$)", str(error))[0]
        reason = f"line {place[1]}, column {place[2]}: {text}" if place else text
    except (UPException, AssertionError, KeyError, ValueError) as error:
        reason = str(error) or type(error).__name__
    finally:
        environment.error_used_name = strict
    raise InputError(key, file, "cannot be read as PDDL: " + " ".join(reason.split()))


def _task(found: Any, keys: tuple[str, str], paths: tuple[object, object]) -> Task:
    """A unified-planning problem as a :class:`Task`."""
    costs: dict[Any, Any] = {}
    counted = False
    for metric in found.quality_metrics:
        if hasattr(metric, "costs"):
            costs, counted = metric.costs, True
    actions = {}
    for action in found.actions:
        name = action.name.lower()
        cost = _cost(costs.get(action), keys[0], paths[0], name) if counted else 1.0
        actions[name] = Action(
            name=name,
            parameters=tuple((f"?{p.name.lower()}", _type(p.type)) for p in action.parameters),
            preconditions=frozenset(x for c in action.preconditions for x in _literals(c)),
            effects=frozenset(_effect(effect) for effect in action.effects),
            cost=cost,
        )
    given = found.explicit_initial_values.items()
    return Task(
        parents={t.name.lower(): _type(t.father) if t.father else "" for t in found.user_types},
        objects={o.name.lower(): _type(o.type) for o in found.all_objects},
        predicates={
            fluent.name.lower(): tuple(
                (f"?{p.name.lower()}", _type(p.type)) for p in fluent.signature
            )
            for fluent in found.fluents
            if fluent.type.is_bool_type()
        },
        functions={
            fluent.name.lower(): len(fluent.signature)
            for fluent in found.fluents
            if not fluent.type.is_bool_type()
        },
        actions=actions,
        initial=frozenset(_atom(a) for a, v in given if v.is_bool_constant() and v.is_true()),
        values={_atom(a): float(v.constant_value()) for a, v in given if not v.is_bool_constant()},
        goal=frozenset(x for goal in found.goals for x in _literals(goal)),
    )


def _type(kind: Any) -> str:
    return str(kind.name).lower()


def _atom(node: Any) -> Atom:
    """A fluent with its arguments."""
    return (node.fluent().name.lower(), *map(_argument, node.args))


def _argument(node: Any) -> str:
    if node.is_parameter_exp():
        return f"?{node.parameter().name.lower()}"
    return str(node.object().name).lower()


def _literals(node: Any) -> list[Literal]:
    """The literals of a conjunction."""
    if node.is_and():
        return [literal for argument in node.args for literal in _literals(argument)]
    if node.is_bool_constant() and node.is_true():
        return []
    positive = not node.is_not()
    inner = node if positive else node.args[0]
    if inner.is_equals():
        return [Literal((EQUAL, *sorted(map(_argument, inner.args))), positive)]
    return [Literal(_atom(inner), positive)]


def _effect(effect: Any) -> Effect:
    condition = () if not effect.is_conditional() else tuple(sorted(_literals(effect.condition)))
    return Effect(Literal(_atom(effect.fluent), effect.value.is_true()), condition)


def _cost(node: Any, key: str, file: object, action: str) -> float | Atom:
    """A number, or a function whose value is one.

    Raises:
        InputError: anything else, or nothing.
    """
    if node is not None and node.is_fluent_exp():
        return _atom(node)
    number = node is not None and (node.is_int_constant() or node.is_real_constant())
    if number and node.constant_value() > 0:
        return float(node.constant_value())
    shown = "nothing" if node is None else str(node)
    raise InputError(
        key,
        file,
        f"the action {action} costs {shown}; a cost is a number > 0, or a function with one",
    )
