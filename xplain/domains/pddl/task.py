"""A planning task as items of text, which can be compared and changed. PDDL is read and grounded by
Fast Downward's translator (the extra ``pddl``), as that planner reads it.
"""

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


class Item(NamedTuple):
    """One thing that a task says.

    Attributes:
        kind: ``action`` (its value: (name, type) of each parameter), ``precondition`` and
            ``effect`` (of an action; True), ``cost`` (of an action; a number, or the text of a
            function), ``initial`` and ``goal`` (True), ``function`` (a number).
        owner: the action's name; empty for items of the problem.
        text: the literal, the effect or the function as :func:`write` has it; empty for ``action``
            and ``cost``.
    """

    kind: str
    owner: str = ""
    text: str = ""


Items = Mapping[Item, Any]
"""Items with their values. As a change of a task, None says that there is no such item."""


@dataclass(frozen=True)
class Task:
    """A domain and a problem.

    Attributes:
        types: the domain's section of types.
        parents: the supertypes of each type.
        objects: each object's type, constants included.
        predicates, functions: the parameters of each, (name, type).
        items: all else.
    """

    types: str
    parents: Mapping[str, tuple[str, ...]]
    objects: Mapping[str, str]
    predicates: Mapping[str, tuple[tuple[str, Any], ...]]
    functions: Mapping[str, tuple[tuple[str, Any], ...]]
    items: Items

    def is_a(self, kind: str, wanted: str) -> bool:
        """Whether a type is another, or a subtype of it."""
        return wanted in (kind, "object", *self.parents[kind])


def changed(items: Items, *changes: Items) -> dict[Item, Any]:
    """The items after all changes; the last one holds."""
    result = dict(items)
    for change in changes:
        result |= change
    return {item: value for item, value in result.items() if value is not None}


def texts(items: Items, kind: str, owner: str = "") -> Iterator[str]:
    """The texts of the items of a kind that are there."""
    for item, value in items.items():
        if item[:2] == (kind, owner) and value is not None:
            yield item.text


def write(node: Any) -> str:
    """Nested lists as PDDL, such as (not (on ?x b)); conjuncts and sides of "=" are sorted."""
    if isinstance(node, str):
        return node
    parts = [write(part) for part in node]
    if parts and parts[0] in ("and", "="):
        parts[1:] = sorted(parts[1:])
    return f"({' '.join(parts)})"


def substitute(text: str, binding: Mapping[str, str]) -> str:
    """The text with its variables replaced."""
    return re.sub(r"\?[^\s()]+", lambda found: binding.get(found[0], found[0]), text)


try:
    from fast_downward.translate import build_model, instantiate, normalize, options, pddl_to_prolog
    from fast_downward.translate import pddl as lifted
    from fast_downward.translate.pddl_parser import ParseError, lisp_parser, parsing_functions
except ImportError:
    lifted = instantiate = None

__all__ = [
    "Source",
    "instantiate",
    "lifted",
    "reach",
    "read_task",
    "read_text",
    "tidy",
    "translate",
]

PACKAGED = "pkg://"
MALFORMED = (ValueError, TypeError, LookupError, AssertionError, AttributeError, SystemExit)
"""What the translator raises, besides its ParseError, for a file that it does not expect."""


@dataclass(frozen=True)
class Source:
    """A text in PDDL.

    Attributes:
        key: what the user set, for errors.
        value: what they gave: a path, or the text itself.
        text: in small letters, without comments.
    """

    key: str
    value: object
    text: str

    @classmethod
    def read(cls, key: str, path: object) -> Source:
        """A file; ``pkg://package/path`` is one inside an installed package.

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
        """The position of an expression, from an action on if it is given."""
        start = re.search(rf":action\s+{re.escape(action)}\s", self.text) if action else None
        begin = start.start() if start else 0
        tokens = map(re.escape, re.findall(r"[()]|\?*[^\s()?]+", text))
        pattern = r"(?<![\w-])" + r"\s*".join(tokens) + r"(?![\w-])"
        found = re.compile(pattern).search(self.text, begin)
        return found.start() if found else begin

    def refusal(self, reason: str, position: int) -> InputError:
        """The error of what stands at a position; it names the line of a file."""
        line = f"line {self.text[:position].count(chr(10)) + 1}: "
        return InputError(self.key, self.value, (line if self.text != self.value else "") + reason)

    def nested(self) -> Any:
        """The text as nested lists.

        Raises:
            InputError: its brackets do not match.
        """
        if not self.text.lstrip().startswith("("):
            at = len(self.text) - len(self.text.lstrip())
            raise self.refusal("an expression in brackets begins with (", at)
        depth = 0
        for found in re.finditer(r"\(\s*:[^\s()]*|[()]", self.text):
            if ":" in found[0] and depth != 1:
                reason = f"brackets do not match: {found[0]} is inside of another part"
                raise self.refusal(reason, found.start())
            depth += 1 if found[0] != ")" else -1
        with self.translated():
            return lisp_parser.parse_nested_list(self.text.splitlines())

    @contextmanager
    def translated(self, known: str = "", problem: Source | None = None) -> Iterator[None]:
        """Makes errors of the translator errors of this text, or of the problem's if they say so;
        ``known`` is added to them.

        Raises:
            XplainError: the translator is not installed.
            InputError: it refuses the text.
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
    """The task of a domain and a problem file.

    Args:
        file, problem: their paths.
        keys: of the two in the configuration, for errors.

    Raises:
        XplainError: the translator is not installed.
        InputError: a file cannot be read, is not PDDL, or uses PDDL that is not supported; with
            the line.
    """
    domain, own = Source.read(keys[0], file), Source.read(keys[1], problem)
    lists = [_drop_requirements(source.nested()) for source in (domain, own)]
    with domain.translated(problem=own):
        lists[1] = [[":domain", *lists[0][1][1:]] if x[0] == ":domain" else x for x in lists[1]]
        found = parsing_functions.parse_task(*map(_round_numbers, lists))
    if found.axioms:
        raise domain.refusal("derived predicates are not supported", domain.find("(:derived"))
    bases = {x.basetype_name for x in found.types} - {x.name for x in found.types} - {None}
    parents = {x.name: tuple(x.supertype_names) for x in found.types} | dict.fromkeys(bases, ())
    typed = [x for of in found.predicates for x in of.arguments]
    typed += [x for of in found.actions for x in of.parameters]
    for source, x in [*((domain, x) for x in typed), *((own, x) for x in found.objects)]:
        if isinstance(x.type_name, str) and x.type_name not in parents:
            at = source.find(f"- {x.type_name}")
            raise source.refusal(f"unknown type {x.type_name} of {x.name}", at)
    items: dict[Item, Any] = {}
    parts = {x[0]: x for x in lists[1]}
    for node in parts[":init"][1:]:
        if node[0] != "=":
            items |= {Item("initial", "", write(node)): True} if node[0] != "not" else {}
        elif "total-cost" not in node[1]:
            items[Item("function", "", write(node[1]))] = float(node[2])
    for literal in _literals(parts[":goal"][1], own):
        items[Item("goal", "", literal)] = True
    actions = {
        x[1]: dict(zip(x[2::2], x[3::2], strict=True)) for x in lists[0] if x[0] == ":action"
    }
    if len(actions) < sum(x[0] == ":action" for x in lists[0]):
        raise domain.refusal("two actions have one name", 0)
    for action in found.actions:
        name, fields = action.name, actions[action.name]
        items[Item("action", name)] = _signature(action.parameters)
        items[Item("cost", name)] = 0.0 if found.use_min_cost_metric else 1.0
        for literal in _literals(fields.get(":precondition", []), domain, name):
            items[Item("precondition", name, literal)] = True
        for effect in _effects(fields[":effect"], domain, name):
            if effect[0] != "increase":
                items[Item("effect", name, write(effect))] = True
            elif found.use_min_cost_metric:
                cost = write(effect[2])
                items[Item("cost", name)] = cost if cost.startswith("(") else float(cost)
    types = next((x for x in lists[0] if x[0] == ":types"), [":types"])
    return Task(
        types=write([*types, *sorted(bases)]),
        parents=parents,
        objects={x.name: x.type_name for x in found.objects},
        predicates={x.name: _signature(x.arguments) for x in found.predicates if x.name != "="},
        functions={x.name: _signature(x.arguments) for x in found.functions},
        items=items,
    )


def _drop_requirements(lists: Any) -> Any:
    """Requirements say nothing of what is used."""
    return [part for part in lists if part[:1] != [":requirements"]]


def _round_numbers(node: Any) -> Any:
    """The translator reads whole numbers alone; what they are does not matter to it."""
    if isinstance(node, str):
        return node
    if len(node) == 3 and isinstance(node[1], list) and re.fullmatch(r"\d+\.\d*", str(node[2])):
        return [*node[:2], "0"]
    return [_round_numbers(part) for part in node]


def _signature(typed: Any) -> tuple[tuple[str, Any], ...]:
    return tuple((x.name, x.type_name) for x in typed)


def _literals(node: Any, source: Source, action: str = "") -> list[str]:
    """The literals of a condition, sorted.

    Raises:
        InputError: it is no conjunction of literals.
    """
    head = node[0] if node else "and"
    if head == "and":
        return sorted(text for part in node[1:] for text in _literals(part, source, action))
    inner = node[1][0] if head == "not" else head
    if inner in ("and", "or", "not", "imply", "forall", "exists"):
        reason = f"a condition with {inner} is not supported; use literals joined by and"
        raise source.refusal(reason, source.find(f"({inner}", action))
    return [write(node)]


def _effects(node: Any, source: Source, action: str) -> Iterator[Any]:
    """The effects of a conjunction, each with its conditions."""
    if node[0] == "and":
        for part in node[1:]:
            yield from _effects(part, source, action)
    elif node[0] == "forall":
        yield from (["forall", node[1], part] for part in _effects(node[2], source, action))
    elif node[0] == "when":
        asked = _literals(node[1], source, action)
        for part in _effects(node[2], source, action):
            yield ["when", asked[0] if len(asked) == 1 else f"(and {' '.join(asked)})", part]
    else:
        yield node


def read_text(task: Task, signature: Any, source: Source, effect: bool = False) -> str:
    """A literal, or an effect, that somebody writes in the configuration, as :func:`write` has it.

    Args:
        task: whose predicates and objects it names.
        signature: (name, type) of each variable that it may name.
        source: the text.
        effect: whether conditions and variables of its own may stand before the literal.

    Raises:
        InputError: it is none, or an argument is of a type that the predicate does not take.
    """
    nested = source.nested()
    checked = {Item("action", "a"): signature, Item("effect", "a", source.text): True}
    translate(task, checked, source)
    found = (
        [write(x) for x in _effects(nested, source, "")] if effect else _literals(nested, source)
    )
    if len(found) != 1 or found[0].startswith("(increase"):
        raise InputError(source.key, source.value, "one literal such as (on ?x b)")
    kinds = {**task.objects, **dict(signature)}
    for name, *arguments in map(str.split, re.findall(r"\(([^()]+)\)", found[0])):
        for argument, (_, wanted) in zip(arguments, task.predicates.get(name, ()), strict=False):
            kind = kinds.get(argument, wanted)
            if isinstance(wanted, str) and not (task.is_a(kind, wanted) or task.is_a(wanted, kind)):
                reason = f"{argument} is a {kind}, {name} takes a {wanted}"
                raise InputError(source.key, source.value, reason)
    return found[0]


def tidy(text: str) -> str:
    """An expression as :func:`write` has it."""
    return write(lisp_parser.parse_nested_list([text])) if text else ""


def translate(task: Task, items: Items, source: Source) -> Any:
    """A task with these items as the translator has it.

    Args:
        task: whose types, objects, predicates and functions they have.
        items: the values of functions do not matter, nor do costs that are numbers.
        source: the text that is the reason of an error.

    Raises:
        InputError: the translator refuses it.
    """

    def declare(typed: Any) -> str:
        return " ".join(f"{name} - {write(kind)}" for name, kind in typed)

    lines = [f"(define (domain d) {task.types} (:constants {declare(task.objects.items())})"]
    for section in ("predicates", "functions"):
        declared = getattr(task, section).items()
        lines.append(f"(:{section} {' '.join(f'({x} {declare(own)})' for x, own in declared)})")
    for name in (item.owner for item in items if item.kind == "action"):
        cost = items.get(Item("cost", name))
        increase = f"(increase (total-cost) {cost})" if isinstance(cost, str) else ""
        lines.append(
            f"(:action {name} :parameters ({declare(items[Item('action', name)])}) "
            f":precondition (and {' '.join(texts(items, 'precondition', name))}) "
            f":effect (and {' '.join(texts(items, 'effect', name))} {increase}))"
        )
    values = " ".join(f"(= {text} 0)" for text in texts(items, "function"))
    problem = (
        f"(define (problem p) (:domain d) (:init {' '.join(texts(items, 'initial'))} {values}) "
        f"(:goal (and {' '.join(texts(items, 'goal'))})) (:metric minimize (total-cost)))"
    )
    with source.translated(f"; known: {', '.join([*task.predicates, *task.objects])}"):
        lists = (lisp_parser.parse_nested_list(text) for text in ([*lines, ")"], [problem]))
        return parsing_functions.parse_task(*lists)


def reach(found: Any) -> Any:
    """All atoms, and ground actions in the place of atoms, that a task of the translator's reaches
    if nothing is ever deleted and conditions with "not" hold."""
    with Source("domain", "", "").translated():
        normalize.normalize(found)
        return build_model.compute_model(pddl_to_prolog.translate(found))
