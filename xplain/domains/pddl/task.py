"""A planning task as items, which can be compared and changed. Fast Downward's translator (the
extra ``pddl``) reads and grounds PDDL."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from xplain.errors import InputError, XplainError

try:
    from fast_downward.translate import build_model, instantiate, normalize, options, pddl_to_prolog
    from fast_downward.translate import pddl as lifted
    from fast_downward.translate.pddl_parser import ParseError, lisp_parser, parsing_functions
except ImportError:
    lifted = None

__all__ = ["instantiate", "lifted"]
PACKAGED = "pkg://"
MALFORMED = (ValueError, TypeError, LookupError, AssertionError, AttributeError, SystemExit)
"""Errors of the translator, besides its ParseError, for an unexpected file."""
Signature = tuple[tuple[str, Any], ...]
"""(name, type) of each variable or object."""


class Item(NamedTuple):
    """One statement of a task.

    Attributes:
        kind: one of seven kinds, which determines the item's value: for ``action`` the signature of
            its parameters; for ``precondition`` and ``effect`` (of an action), ``initial`` and
            ``goal`` the translator's object; for ``cost`` (of an action) a number, or the text of a
            function; for ``function`` a number.
        owner: the action's name; "" for items of the problem.
        text: the condition, the effect or the function in the form of :func:`write`; "" for
            ``action`` and ``cost``.
    """

    kind: str
    owner: str = ""
    text: str = ""


Items = Mapping[Item, Any]
"""Items with their values. In a change of a task, None removes the item."""


@dataclass(frozen=True)
class Task:
    """A domain and a problem.

    Attributes:
        found: the task as the translator represents it.
        objects: name and type of each object and constant.
        predicates, functions: for each name, the signature of its parameters.
        items: all statements except types and objects.
    """

    found: Any
    objects: Signature
    predicates: Mapping[str, Signature]
    functions: Mapping[str, Signature]
    items: Items


def apply_changes(items: Items, *changes: Items) -> dict[Item, Any]:
    """Applies changes to items; later changes override earlier ones."""
    result = dict(items)
    for change in changes:
        result |= change
    return {item: value for item, value in result.items() if value is not None}


def texts(items: Items, kind: str, owner: str = "") -> Iterator[str]:
    """Yields the text of each item of one kind.

    Args:
        items: the items.
        kind: the kind.
        owner: name of the action that has the items; "" for items of the problem.
    """
    for item, value in items.items():
        if item[:2] == (kind, owner) and value is not None:
            yield item.text


def sign(typed: Any) -> Signature:
    """Returns the signature, (name, type) of each of the translator's typed objects."""
    return tuple((x.name, x.type_name) for x in typed)


def declare(signature: Signature) -> str:
    """Writes the variables or objects of a signature with types in PDDL, such as ?x - block."""
    kinds = ((x, f"(either {' '.join(y)})" if isinstance(y, list) else y) for x, y in signature)
    return " ".join(f"{name} - {kind}" for name, kind in kinds)


def write(part: Any) -> str:
    """Writes a condition or an effect in PDDL, such as (not (on ?x b)); conjuncts and the sides of
    "=" are sorted."""
    if isinstance(part, lifted.Effect):
        asked, text = write(part.condition), write(part.literal)
        text = text if asked == "(and)" else f"(when {asked} {text})"
        return f"(forall ({declare(sign(part.parameters))}) {text})" if part.parameters else text
    if isinstance(part, lifted.Literal):
        arguments = sorted(part.args) if part.predicate == "=" else part.args
        text = f"({' '.join([part.predicate.removeprefix('type@'), *arguments])})"
        return f"(not {text})" if part.negated else text
    inside = sorted(map(write, part.parts))
    if isinstance(part, lifted.ExistentialCondition):
        return f"(exists ({declare(sign(part.parameters))}) {inside[0]})"
    return f"({' '.join(['or' if isinstance(part, lifted.Disjunction) else 'and', *inside])})"


def substitute(text: str, binding: Mapping[str, str]) -> str:
    """Replaces the variables in a text."""
    return re.sub(r"\?[^\s()]+", lambda found: binding.get(found[0], found[0]), text)


@dataclass(frozen=True)
class Source:
    """A text in PDDL.

    Attributes:
        key: the user's key, for errors.
        value: the user's value: a path, or the text itself.
        text: the text in lower case, without comments.
    """

    key: str
    value: object
    text: str

    @classmethod
    def read(cls, key: str, path: object) -> Source:
        """Reads a file; ``pkg://package/path`` is a file inside an installed package.

        Raises:
            InputError: there is no such file.
        """
        if not isinstance(path, str) or not path:
            raise InputError(key, path, "the path of a PDDL file")
        package, _, inside = path.removeprefix(PACKAGED).partition("/")
        try:
            file = files(package).joinpath(inside) if PACKAGED in path else Path(path)
            text = file.read_bytes().decode("utf-8-sig", errors="replace")
        except (OSError, ModuleNotFoundError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(key, path, f"cannot be read: {reason}") from None
        return cls(key, path, re.sub(";[^\n]*", "", text.lower()))

    def find(self, text: str, action: str = "") -> int:
        """Finds an expression in the text.

        Args:
            text: the expression.
            action: name of an action; the search begins at this action. "" searches the whole text.

        Returns:
            The position of the expression's first character; if it is not found, the position where
            the search began.
        """
        start = re.search(rf":action\s+{re.escape(action)}\s", self.text) if action else None
        begin = start.start() if start else 0
        tokens = map(re.escape, re.findall(r"[()]|\?*[^\s()?]+", text))
        pattern = r"(?<![\w-])" + r"\s*".join(tokens) + r"(?![\w-])"
        found = re.compile(pattern).search(self.text, begin)
        return found.start() if found else begin

    def refusal(self, reason: str, position: int) -> InputError:
        """Makes an error about the expression at a position, with the line of the file."""
        line = f"line {self.text[:position].count(chr(10)) + 1}: "
        return InputError(self.key, self.value, (line if self.text != self.value else "") + reason)

    def parse(self) -> Any:
        """Parses the text into nested lists.

        Raises:
            InputError: the brackets do not match.
        """
        if not self.text.lstrip().startswith("("):
            at = len(self.text) - len(self.text.lstrip())
            raise self.refusal("an expression in brackets begins with (", at)
        depth = 0
        # No part of a task is inside another part, except in the old (:length …).
        for found in re.finditer(r"\(\s*:(?!serial|parallel)[^\s()]*|[()]", self.text):
            if ":" in found[0] and depth != 1:
                reason = f"brackets do not match: {found[0]} is inside of another part"
                raise self.refusal(reason, found.start())
            depth += 1 if found[0] != ")" else -1
        with self.translate_errors():
            return lisp_parser.parse_nested_list(self.text.splitlines())

    @contextmanager
    def translate_errors(self, known: str = "", problem: Source | None = None) -> Iterator[None]:
        """Opens a context in which the translator is called. Errors of the translator become errors
        about this text.

        Args:
            known: is appended to the errors' texts.
            problem: text of the problem file, if it is read too; errors in it name this file.

        Raises:
            XplainError: the translator is not installed.
            InputError: the translator refuses a text.
        """
        if lifted is None:
            raise XplainError(
                "domain: PDDL tasks need Fast Downward's translator: pip install 'xplain-hri[pddl]'"
            )
        options.set_options(["", ""])
        try:
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                yield
        except (ParseError, *MALFORMED) as error:
            lines = str(error).splitlines() or ["the translator does not read the domain's actions"]
            inside = "".join(x for x in lines if x.startswith(("Parsing", "\t->")))
            got = "".join(x.removeprefix("Got: ") for x in lines if x.startswith("Got: "))
            said = [x.rstrip(".") for x in lines if x not in inside and not x.startswith("Got: ")]
            said[0] += f": {got[:90]}" if got else ""
            action = re.search(r"Parsing action '(.*?)'", inside)
            source = problem if problem and not inside.startswith("Parsing domain") else self
            raise source.refusal(
                "; ".join(said) + known, source.find(got, action[1] if action else "")
            ) from None


def read_task(file: object, problem: object, keys: tuple[str, str]) -> Task:
    """Reads the task of a domain and a problem file.

    Args:
        file, problem: their paths.
        keys: their configuration keys, for errors.

    Raises:
        XplainError: the translator is not installed.
        InputError: a file cannot be read, is not PDDL, or uses unsupported PDDL; with the line.
    """
    domain, own = Source.read(keys[0], file), Source.read(keys[1], problem)
    numbers: dict[int, float] = {}
    parts, inside = ([x for x in y.parse() if x[:1] != [":requirements"]] for y in (domain, own))
    with domain.translate_errors(problem=own):
        inside = [[":domain", *parts[1][1:]] if x[0] == ":domain" else x for x in inside]
        found = parsing_functions.parse_task(
            _replace_decimals(parts, numbers), _replace_decimals(inside, numbers)
        )
    if found.axioms:
        raise domain.refusal("derived predicates are not supported", domain.find("(:derived"))
    bases = {x.basetype_name for x in found.types} - {x.name for x in found.types} - {None}
    for kind in map(lifted.Type, sorted(bases)):
        kind.supertype_names = []
        found.types.append(kind)
    items: dict[Item, Any] = {}
    _refuse_universal(found.goal, own)
    typed = [(domain, y) for x in found.predicates for y in x.arguments]
    for action in found.actions:
        name, cost = action.name, action.cost and action.cost.expression
        if Item("action", name) in items:
            at = domain.text.rfind(f":action {name}")
            raise domain.refusal(f"two actions are called {name}; rename one of them", at)
        items[Item("action", name)] = sign(action.parameters)
        items[Item("cost", name)] = _read_cost(cost, numbers) if found.use_min_cost_metric else 1.0
        items |= {
            Item("precondition", name, write(x)): x for x in split_conjunction(action.precondition)
        }
        items |= {Item("effect", name, write(x)): x for x in action.effects}
        for condition in (action.precondition, *(x.condition for x in action.effects)):
            _refuse_universal(condition, domain, name)
        typed += [(domain, x) for x in action.parameters]
    for source, x in [*typed, *((own, x) for x in found.objects)]:
        if isinstance(x.type_name, str) and x.type_name not in {y.name for y in found.types}:
            at = source.find(f"- {x.type_name}")
            raise source.refusal(f"unknown type {x.type_name} of {x.name}", at)
    for x in found.init:
        if isinstance(x, lifted.Atom):
            items |= {Item("initial", "", write(x)): x} if x.predicate != "=" else {}
        elif x.fluent.symbol != "total-cost":
            items[Item("function", "", str(_read_cost(x.fluent, {})))] = _read_cost(
                x.expression, numbers
            )
    items |= {Item("goal", "", write(x)): x for x in split_conjunction(found.goal)}
    return Task(
        found,
        sign(found.objects),
        {x.name: sign(x.arguments) for x in found.predicates if x.name != "="},
        {x.name: sign(x.arguments) for x in found.functions},
        items,
    )


def split_conjunction(condition: Any) -> list[Any]:
    """Returns the conjuncts of a condition, sorted."""
    whole = condition.simplified()
    parts = whole.parts if isinstance(whole, lifted.Conjunction | lifted.Truth) else [whole]
    return sorted(parts, key=write)


def _refuse_universal(condition: Any, source: Source, action: str = "") -> None:
    if condition.has_universal_part():
        reason = "a condition with forall, or with exists after not, is not supported"
        raise source.refusal(reason, source.find("(forall", action))


def _replace_decimals(node: Any, numbers: dict[int, float]) -> Any:
    """Replaces each decimal in a parsed text by an integer, because the translator reads only
    integers. Returns the new text.

    Args:
        node: the text as nested lists.
        numbers: receives the decimal that each new integer represents.
    """
    if isinstance(node, str):
        return node
    if len(node) == 3 and isinstance(node[1], list) and re.fullmatch(r"\d+\.\d*", str(node[2])):
        key = 10**12 + len(numbers)
        numbers[key] = float(node[2])
        return [*node[:2], str(key)]
    return [_replace_decimals(part, numbers) for part in node]


def _read_cost(expression: Any, numbers: Mapping[int, float]) -> float | str:
    """Converts a cost of the translator to a number, or to a function in PDDL such as (distance
    ?x); a missing cost is 0.

    Args:
        expression: the cost.
        numbers: the decimals that integers represent (:func:`_replace_decimals`).
    """
    if isinstance(expression, lifted.PrimitiveNumericExpression):
        return f"({' '.join([expression.symbol, *expression.args])})"
    return float(numbers.get(expression.value, expression.value)) if expression else 0.0


def read_text(task: Task, signature: Signature, source: Source, effect: bool = False) -> Any:
    """Reads a literal or an effect from the configuration.

    Args:
        task: defines the predicates and objects.
        signature: the variables that the text may contain.
        source: the text.
        effect: True if conditions and variables may come before the literal.

    Raises:
        InputError: the text is not valid.
    """
    types = " ".join(f"{x.name} - {x.basetype_name}" for x in task.found.types if x.basetype_name)
    declared = " ".join(f"({name} {declare(x)})" for name, x in task.predicates.items())
    texts = (
        f"(define (domain d) (:types {types}) (:constants {declare(task.objects)})"
        f"(:predicates (done@) {declared}) (:functions (total-cost)))",
        "(define (problem p) (:domain d) (:init) (:goal (and)))",
        f"(:action a :parameters ({declare(signature)}))",
    )
    nested = source.parse()
    with source.translate_errors(f"; known: {', '.join([*task.predicates, *dict(task.objects)])}"):
        domain, problem, action = (lisp_parser.parse_nested_list([text]) for text in texts)
        added = [":effect", nested] if effect else [":precondition", nested, ":effect", ["done@"]]
        actions = parsing_functions.parse_task([*domain, [*action, *added]], problem).actions
    found = [
        x for y in actions for x in (y.effects if effect else split_conjunction(y.precondition))
    ]
    if len(found) != 1:
        raise InputError(source.key, source.value, "one literal such as (on ?x b)")
    _refuse_universal(found[0].condition if effect else found[0], source)
    return found[0]


def reach(found: Any) -> Any:
    """Finds all atoms and ground actions (as atoms) that a translator's task reaches if nothing is
    ever deleted and all negated conditions hold."""
    with Source("domain", "", "").translate_errors():
        normalize.normalize(found)
        return build_model.compute_model(pddl_to_prolog.translate(found))
