"""The mistakes that are put in, and where none is: cosmic-ray's operators and five of our own.

Of cosmic-ray's those a person could write (``<`` for ``<=``, not ``+`` for ``<<``). Types, texts,
error messages, logging, decorators and imports are left alone: there a mutant is no mistake.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

try:
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.operators.operator import Operator
    from cosmic_ray.operators.provider import OperatorProvider
    from parso.python.tree import Keyword
except ModuleNotFoundError as error:
    raise SystemExit(f"{error.name} is missing: pip install --editable '.[mutants]'") from None

Node = Any  # of parso's tree
Span = tuple[tuple[int, int], tuple[int, int]]

_BINARY = "Add_Sub Sub_Add Mul_Div Mul_Add Div_Mul FloorDiv_Div Mod_FloorDiv Pow_Mul RShift_LShift \
LShift_RShift BitOr_BitAnd BitAnd_BitOr BitXor_BitAnd"
_COMPARISON = "Lt_LtE Lt_GtE LtE_Lt LtE_Gt Gt_GtE Gt_LtE GtE_Gt GtE_Lt Eq_NotEq NotEq_Eq Is_IsNot \
IsNot_Is"
_UNARY = "Delete_USub Delete_Invert Delete_Not"
_OTHERS = "AddNot ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd \
ReplaceBreakWithContinue ReplaceContinueWithBreak NumberReplacer \
ZeroIterationForLoop"

_UNTOUCHED = {"tfpdef", "decorator", "raise_stmt", "assert_stmt", "import_name", "import_from"}
_UNTOUCHED |= {"fstring", "global_stmt", "del_stmt"}
_LOGGING = {"log", "logger", "logging", "warnings"}
_CHECKS = {"strict", "stacklevel"}  # arguments that only catch mistakes, or word a warning
_ARITHMETIC = {"arith_expr", "term", "shift_expr", "expr", "xor_expr", "and_expr", "power"}


class _Own(Operator):  # type: ignore[misc]
    @classmethod
    def examples(cls) -> tuple[()]:
        """None: they are in the tests."""
        return ()


class SwapName(_Own):
    """``any`` for ``all``, ``max`` for ``min``: a call of the one that was not meant."""

    NAMES = dict(
        pair
        for one, other in (
            ("all", "any"),
            ("min", "max"),
            ("argmin", "argmax"),
            ("minimum", "maximum"),
            ("zeros", "ones"),
            ("floor", "ceil"),
            ("sum", "mean"),
            ("union", "intersection"),
        )
        for pair in ((one, other), (other, one))
    ) | {"cumsum": "cumprod", "sorted": "list"}

    def mutation_positions(self, node: Node) -> Iterator[Span]:
        if node.type == "name" and node.value in self.NAMES and _called(node):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Node, index: int) -> Node:
        node.value = self.NAMES[node.value]
        return node


class DropStatement(_Own):
    """``pass`` for a call, for ``x += …`` and for an assignment to an item or an attribute."""

    def mutation_positions(self, node: Node) -> Iterator[Span]:
        if node.type == "simple_stmt" and self._has_effect(node.children[0]):
            yield node.children[0].start_pos, node.children[0].end_pos

    def _has_effect(self, statement: Node) -> bool:
        if statement.type == "atom_expr":
            return bool(statement.children[-1].children[0] == "(")
        if statement.type != "expr_stmt":
            return False
        target, operator = statement.children[:2]
        plain = getattr(operator, "value", "") == "="
        return operator.type != "annassign" and not (plain and target.type != "atom_expr")

    def mutate(self, node: Node, index: int) -> Node:
        node.children[0] = _keyword("pass", node.children[0])
        return node


class SwapAugmented(_Own):
    """``-=`` for ``+=``."""

    OPERATORS = {"+=": "-=", "-=": "+=", "*=": "/=", "/=": "*=", "|=": "&=", "&=": "|="} | {
        "<<=": ">>=",
        ">>=": "<<=",
        "^=": "|=",
    }

    def mutation_positions(self, node: Node) -> Iterator[Span]:
        if node.type == "operator" and node.value in self.OPERATORS:
            yield node.start_pos, node.end_pos

    def mutate(self, node: Node, index: int) -> Node:
        node.value = self.OPERATORS[node.value]
        return node


class DropItem(_Own):
    """One item left out of a literal list of texts, or of a dictionary whose keys are texts."""

    def mutation_positions(self, node: Node) -> list[Span]:
        children = node.children if (items := _items(node)) else []
        return [(children[i].start_pos, children[i].end_pos) for i in items]

    def mutate(self, node: Node, index: int) -> Node:
        item = _items(node)[index]
        del node.children[item : item + (4 if _keyed(node) else 2)]
        return node


class DropArgument(_Own):
    """One of the values that a call only passes on: ``savez``, ``replace``, ``dict``."""

    CALLS = ("savez", "savez_compressed", "replace", "dict")

    def mutation_positions(self, node: Node) -> list[Span]:
        children = node.children if (items := self._named(node)) else []
        return [(children[i].start_pos, children[i].end_pos) for i in items]

    def _named(self, node: Node) -> list[int]:
        if node.type != "arglist":
            return []
        callee = node.parent.get_previous_sibling()
        if callee is None or callee.get_last_leaf().value not in self.CALLS:
            return []
        return [
            i
            for i, child in enumerate(node.children)
            if child.type == "argument" and child.children[1] == "="
        ]

    def mutate(self, node: Node, index: int) -> Node:
        item = self._named(node)[index]
        del node.children[item : item + 2]
        return node


OWN = {
    one.__name__: one for one in (SwapName, DropStatement, SwapAugmented, DropItem, DropArgument)
}


@cache
def operators() -> dict[str, Operator]:
    """All operators by name."""
    provider = OperatorProvider()
    names = [f"ReplaceBinaryOperator_{pair}" for pair in _BINARY.split()]
    names += [f"ReplaceComparisonOperator_{pair}" for pair in _COMPARISON.split()]
    names += [f"ReplaceUnaryOperator_{pair}" for pair in _UNARY.split()]
    return {name: provider[name]() for name in names + _OTHERS.split()} | {
        name: kind() for name, kind in OWN.items()
    }


def places(source: str) -> Iterator[tuple[str, int, Span, str]]:
    """Every mutant of a module: operator, which of the operator's occurrences, the span that it
    replaces, and the function (dotted, empty at module level)."""
    nodes = list(ast_nodes(get_ast(source)))
    for name, operator in operators().items():
        occurrence = 0
        for node in nodes:
            for span in operator.mutation_positions(node):
                if not _left_alone(node, name):
                    yield name, occurrence, span, _function(node)
                occurrence += 1


def mutate(source: str, operator: str, occurrence: int) -> str | None:
    """The mutated source; None where it is no Python, or the same."""
    mutated: str | None = mutate_code(source, operators()[operator], occurrence)
    if mutated is None or mutated == source:
        return None
    try:
        compile(mutated, "mutant", "exec")
    except (SyntaxError, ValueError):
        return None
    return mutated


def _left_alone(node: Node, operator: str) -> bool:
    if operator.startswith("ReplaceBinaryOperator") and node.parent.type not in _ARITHMETIC:
        return True
    if operator == "AddNot" and _told_otherwise(node):
        return True
    child = node.children[0] if node.type == "simple_stmt" else node
    while child is not None:
        parent = child.parent
        if child.type in _UNTOUCHED or _exports(child) or _logs(child):
            return True
        if parent is not None:
            if parent.type == "annassign" and child is parent.children[1]:
                return True
            if parent.type == "funcdef" and child is parent.annotation:
                return True
            if parent.type == "argument" and parent.children[0].get_code().strip() in _CHECKS:
                return True
        child = parent
    return False


def _told_otherwise(node: Node) -> bool:
    """A condition whose negation another operator makes, or that only the type checker reads."""
    condition = node.children[2 if node.type == "test" else 1]
    simple = condition.type == "comparison" and len(condition.children) == 3
    return simple or condition.type == "not_test" or condition.get_code().strip() == "TYPE_CHECKING"


def _exports(node: Node) -> bool:
    return node.type == "expr_stmt" and node.children[0].get_code().strip() == "__all__"


def _logs(node: Node) -> bool:
    return node.type == "atom_expr" and getattr(node.children[0], "value", "") in _LOGGING


def _called(name: Node) -> bool:
    following = name.get_next_leaf()
    return following is not None and following.value == "("


def _keyed(node: Node) -> bool:
    return any(child == ":" for child in node.children)


def _items(node: Node) -> list[int]:
    """Indices of the children that :class:`DropItem` leaves out."""
    if node.type == "dictorsetmaker" and _keyed(node):
        pairs = range(0, len(node.children) - 2, 4)
        children = node.children
        if all(children[i].type == "string" and children[i + 1] == ":" for i in pairs):
            return list(pairs)
        return []
    if node.type == "testlist_comp" or node.type == "dictorsetmaker":
        items = range(0, len(node.children), 2)
        if len(items) > 2 and all(node.children[i].type == "string" for i in items):
            return list(items)
    return []


def _keyword(word: str, replaced: Node) -> Keyword:
    return Keyword(word, replaced.start_pos, replaced.get_first_leaf().prefix)


def _function(node: Node) -> str:
    names: list[str] = []
    while node is not None:
        if node.type in ("funcdef", "classdef"):
            names.insert(0, node.name.value)
        node = node.parent
    return ".".join(names)
