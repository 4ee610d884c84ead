"""Mutants of a module, made with mutmut's operators.

Mutants that change only a text for people, a type or a decorator are left out: tests do not assert wording, and mypy
checks types.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest

import libcst as cst
import libcst.matchers as m
from mutmut.mutation.mutators import mutation_operators, operator_string

LOG_METHODS = ("debug", "info", "warning", "error", "critical", "exception", "log", "print", "echo", "cast")
PASSED_OVER = m.OneOf(
    m.Annotation(),
    m.Decorator(),
    m.FormattedString(),
    m.Assert(),  # states what the type checker cannot know
    m.Raise(),
    *(m.Call(func=m.Attribute(attr=m.Name(name)) | m.Name(name)) for name in LOG_METHODS),
)
Place = tuple[cst.CSTNode, cst.CSTNode]
"""A node, and the node that replaces it."""


@dataclass(frozen=True)
class Mutant:
    """One mistake: the number of the first changed line, its text before and after, and the whole mutated source."""

    line: int
    before: str
    after: str
    source: str


class Places(cst.CSTVisitor):
    """All places in functions where an operator applies."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[Place] = []
        self._depth = 0

    def on_visit(self, node: cst.CSTNode) -> bool:
        """Collect the mutants of a node, then enter it."""
        if m.matches(node, PASSED_OVER):
            return False
        self._depth += isinstance(node, cst.FunctionDef)
        if self._depth:
            for kind, operator in mutation_operators:
                if isinstance(node, kind) and operator is not operator_string:
                    self.found.extend((node, mutant) for mutant in operator(node))
        return True

    def on_leave(self, original_node: cst.CSTNode) -> None:
        """Leave a node."""
        self._depth -= isinstance(original_node, cst.FunctionDef)


def mutants(source: str, sample: int, seed: int) -> Iterator[Mutant]:
    """Yield a seeded sample of a source's mutants; all of them if there are fewer."""
    places = Places()
    tree = cst.parse_module(source)
    tree.visit(places)
    random.Random(seed).shuffle(places.found)
    lines, made = source.splitlines(), 0
    for node, mutant in places.found:
        changed = cst.ensure_type(tree.deep_replace(node, mutant), cst.Module).code
        try:
            compile(changed, "mutant", "exec")
        except SyntaxError:
            continue
        if changed == source:
            continue
        after = changed.splitlines()
        pairs = enumerate(zip_longest(lines, after, fillvalue=""))
        at, (old, new) = next((n, pair) for n, pair in pairs if pair[0] != pair[1])
        made += 1
        yield Mutant(at + 1, old.strip(), new.strip(), changed)
        if made == sample:
            return
