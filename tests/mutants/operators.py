"""The mistakes: cosmic-ray's mistakes that a person could make, and a missing statement.

Types, texts, error messages, logging, decorators and imports stay unchanged, because a change there
is no mistake.
"""

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

BINARY = "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Div Mod_FloorDiv Pow_Mul RShift_LShift \
LShift_RShift BitOr_BitAnd BitAnd_BitOr BitXor_BitAnd"
COMPARISON = "Lt_LtE Lt_GtE LtE_Lt LtE_Gt Gt_GtE Gt_LtE GtE_Gt GtE_Lt Eq_NotEq NotEq_Eq Is_IsNot \
IsNot_Is"
OTHERS = "ReplaceUnaryOperator_Delete_USub ReplaceUnaryOperator_Delete_Not AddNot \
ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd \
ReplaceBreakWithContinue ReplaceContinueWithBreak NumberReplacer ZeroIterationForLoop"
UNTOUCHED = {"tfpdef", "decorator", "raise_stmt", "assert_stmt", "import_name", "import_from"}
UNTOUCHED |= {"fstring", "global_stmt", "del_stmt"}
LOGGING = {"log", "logger", "logging", "warnings"}
ARITHMETIC = {"arith_expr", "term", "shift_expr", "expr", "xor_expr", "and_expr", "power"}


class DropStatement(Operator):  # type: ignore[misc]
    """``pass`` for a call, for ``x += …`` and for an assignment to an item or an attribute."""

    @classmethod
    def examples(cls) -> tuple[()]:
        """Returns no examples."""
        return ()

    def mutation_positions(self, node: Node) -> Iterator[Span]:
        """Yields the positions of statements with an effect beyond a local name."""
        if node.type != "simple_stmt":
            return
        statement = node.children[0]
        effect = False
        if statement.type == "atom_expr":
            effect = statement.children[-1].children[0] == "("
        elif statement.type == "expr_stmt" and statement.children[1].type != "annassign":
            target, operator = statement.children[:2]
            effect = getattr(operator, "value", "") != "=" or target.type == "atom_expr"
        if effect:
            yield statement.start_pos, statement.end_pos

    def mutate(self, node: Node, index: int) -> Node:
        """Replaces the statement."""
        statement = node.children[0]
        prefix = statement.get_first_leaf().prefix
        node.children[0] = Keyword("pass", statement.start_pos, prefix)
        return node


@cache
def operators() -> dict[str, Operator]:
    """Returns all operators by name."""
    provider = OperatorProvider()
    names = [f"ReplaceBinaryOperator_{pair}" for pair in BINARY.split()]
    names += [f"ReplaceComparisonOperator_{pair}" for pair in COMPARISON.split()]
    known = {name: provider[name]() for name in names + OTHERS.split()}
    return {**known, "DropStatement": DropStatement()}


def places(source: str) -> Iterator[tuple[str, int, Span]]:
    """Lists every mutant of a module: the operator, the number of the occurrence, and the span that
    it replaces."""
    nodes = list(ast_nodes(get_ast(source)))
    for name, operator in operators().items():
        occurrence = 0
        for node in nodes:
            for span in operator.mutation_positions(node):
                if not left_alone(node, name):
                    yield name, occurrence, span
                occurrence += 1


def mutate(source: str, operator: str, occurrence: int) -> str | None:
    """Returns the mutated source; None if it is no Python, or unchanged."""
    mutated: str | None = mutate_code(source, operators()[operator], occurrence)
    if mutated is None or mutated == source:
        return None
    try:
        compile(mutated, "mutant", "exec")
    except (SyntaxError, ValueError):
        return None
    return mutated


def left_alone(node: Node, operator: str) -> bool:
    """Returns True if a change of the node is no mistake."""
    if operator.startswith("ReplaceBinaryOperator") and node.parent.type not in ARITHMETIC:
        return True
    child = node.children[0] if node.type == "simple_stmt" else node
    while child is not None:
        parent = child.parent
        first = getattr(child, "children", [child])[0]
        logs = child.type == "atom_expr" and getattr(first, "value", "") in LOGGING
        exports = child.type == "expr_stmt" and getattr(first, "value", "") == "__all__"
        if child.type in UNTOUCHED or logs or exports:
            return True
        if parent is not None:
            annotated = parent.type == "annassign" and child is parent.children[1]
            returned = parent.type == "funcdef" and child is parent.annotation
            if annotated or returned:
                return True
        child = parent
    return False
