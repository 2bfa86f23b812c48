"""Ways to spoil JSON: the tree is changed, and not its letters alone."""

from __future__ import annotations

import copy
import json
from typing import Any

from fuzz.texts import NUMBERS, TEXT, TIMES, WORDS, Mutator, Rng, nested, pick

_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 0.5, 1e308, -1e308, 1e-320, 2**31, 2**63, 2**64, 10**400),
    *(float("nan"), float("inf"), "", "\ud800", "0", "nan", [], {}, [[]], [None], {"a": 1}),
    *([0] * 3, [1e308, 1e308], [[0.0, 0.0]], 89.9999, 181.0, -90, "Point", "a" * 5000),
)


def _places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all nodes of a tree, its root not among them."""
    found = [path] if path else []
    if isinstance(tree, dict | list):
        for step, inside in tree.items() if isinstance(tree, dict) else enumerate(tree):
            found += _places(inside, (*path, step))
    return found


def _value(rng: Rng) -> Any:
    # A copy, since it may itself be changed afterwards.
    return copy.deepcopy(_VALUES[int(rng.integers(len(_VALUES)))])


def mutate_tree(rng: Rng, tree: Any) -> Any:
    """A tree with one node changed, lost, doubled, wrapped, or exchanged with another."""
    places = _places(tree)
    if not places:
        return _value(rng)
    path = places[int(rng.integers(len(places)))]
    parent = tree
    for step in path[:-1]:
        parent = parent[step]
    last = path[-1]
    how = int(rng.integers(8))
    if how < 3:
        parent[last] = _value(rng)
    elif how == 3:
        parent[last] = pick(rng, [*WORDS, *NUMBERS, *TIMES])
    elif how == 4:
        del parent[last]
    elif how == 5 and isinstance(parent, list):
        parent.insert(last, parent[last])
    elif how == 5:
        parent[pick(rng, list(WORDS))] = parent[last]
    elif how == 6:
        parent[last] = [parent[last]]
    else:
        other = places[int(rng.integers(len(places)))]
        source = tree
        for step in other:
            source = source[step]
        parent[last] = copy.deepcopy(source)
    return tree


def tree(rng: Rng, content: bytes) -> bytes:
    """Nodes of the tree are changed; a text that is no longer JSON stays as it is."""
    try:
        found = json.loads(content)
        for _ in range(int(rng.integers(1, 4))):
            found = mutate_tree(rng, found)
        return json.dumps(found).encode("ascii")
    except (ValueError, RecursionError):
        return content


def tree_of_line(rng: Rng, content: bytes) -> bytes:
    """Nodes of one line are changed, of a text with a tree a line."""
    lines = content.split(b"\n")
    at = int(rng.integers(len(lines)))
    lines[at] = tree(rng, lines[at])
    return b"\n".join(lines)


JSON_LINES: tuple[Mutator, ...] = (tree_of_line,) * 20 + TEXT
JSON: tuple[Mutator, ...] = (tree,) * 20 + (nested, nested, *TEXT)
"""For GeoJSON and what else is JSON."""
