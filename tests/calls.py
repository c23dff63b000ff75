"""Literal arguments of calls in the source."""

import ast
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path


def literal_arguments(paths: Iterable[Path]) -> dict[str, set]:
    """Return the literals among the arguments of each function, by its name."""
    found = defaultdict(set)
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                found[node.func.id] |= set().union(*map(_literals, node.args))
    return found


def _literals(argument: ast.expr) -> set:
    """Return a literal, or both of those between which a condition chooses."""
    if isinstance(argument, ast.Constant):
        return {argument.value}
    if isinstance(argument, ast.IfExp):
        return _literals(argument.body) | _literals(argument.orelse)
    return set()
