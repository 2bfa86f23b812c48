"""Data association as a linear assignment over the pairs inside the gates."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sightline.types import FloatArray, IntArray

_IMPOSSIBLE = 1e6


def assign(
    targets: IntArray, boxes: IntArray, cost: FloatArray, count: tuple[int, int]
) -> tuple[IntArray, IntArray]:
    """Assign boxes to targets: as many pairs as can be, each once, at the least total cost.

    Targets and boxes that are linked by no pair, not even through others, are assigned apart: of
    hundreds of targets few are near each other, and the Hungarian method is cubic in their number.

    Args:
        targets: (P,) row of the target of each possible pair.
        boxes: (P,) row of its box.
        cost: (P,) finite.
        count: How many targets and boxes there are.

    Returns:
        Rows of targets and of boxes, one a pair.
    """
    if not targets.size:
        return targets, boxes
    n, m = count
    alone = np.bincount(targets, minlength=n)[targets] == 1
    alone &= np.bincount(boxes, minlength=m)[boxes] == 1
    if alone.all():
        return targets, boxes
    chosen = [np.flatnonzero(alone)]
    rest = np.flatnonzero(~alone)
    if rest.size:
        links = coo_array(
            (np.ones(rest.size), (targets[rest], n + boxes[rest])), shape=(n + m, n + m)
        )
        group = connected_components(links, directed=False)[1][targets[rest]]
        order = np.argsort(group, kind="stable")
        for part in np.split(rest[order], np.flatnonzero(np.diff(group[order])) + 1):
            rows, i = np.unique(targets[part], return_inverse=True)
            columns, j = np.unique(boxes[part], return_inverse=True)
            table = np.full((rows.size, columns.size), _IMPOSSIBLE)
            table[i, j] = cost[part]
            pair = np.full(table.shape, -1, dtype=np.int64)
            pair[i, j] = part
            taken = pair[linear_sum_assignment(table)]
            chosen.append(taken[taken >= 0])
    pairs = np.concatenate(chosen)
    return targets[pairs], boxes[pairs]
