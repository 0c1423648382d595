"""Exact association marginals of one cluster of tracks and detections, by a recursion over subsets.

Each row (a track, say) takes at most one column (a detection), each column is taken at most once, and a choice of
pairs weighs the product of their odds. Rows are dealt with one after the other. f_i(S) is the weight of all choices
of the first i rows that take the columns S:

    f_{i+1}(S) = f_i(S) + sum_{j in S} psi_ij f_i(S without j),

and a backward pass of the same form gives the marginals. Only columns that both an earlier and a later row may take
have to be remembered: S is a subset of this frontier (M. Horridge and S. Maskell, 2006, use the same fact). A column
joins the frontier with its first row and is summed out after its last, so that the cost grows with 2 to the width of
the frontier, which is 1 or 2 where the pairs form a chain or a tree. Sums have positive terms only: nothing cancels.

Reference: M. Horridge and S. Maskell, "Real-time tracking of hundreds of targets with efficient exact JPDAF
implementation", 9th International Conference on Information Fusion, 2006.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import stable_order

# Up to this number of rows, the order that keeps the frontier narrow is searched for step by step; the search costs the
# square of the number of rows.
MOST_ROWS_TO_ORDER = 48


class Table(NamedTuple):
    """Pairs of a cluster, row by row."""

    starts: Integers  # The pairs of row r are those from ``starts[r]`` to ``starts[r + 1]``
    columns: Integers  # (p,): Column of each pair
    odds: Array  # (p,): Weight of each pair
    n_columns: int  # Number of columns


class Plan(NamedTuple):
    """Order of the rows, and what it costs."""

    order: Integers  # Rows in order of elimination
    width: int  # Largest number of columns in the frontier
    room: int  # Total size of the forward messages
    cost: float  # Multiplications of one pass; infinite where the frontier is wider than the limit


@compiled
def make_table(rows: Integers, columns: Integers, odds: Array, n_rows: int, n_columns: int) -> tuple[Table, Integers]:
    """Return the pairs (p,) row by row, and the place of each of them among those given."""
    starts = np.zeros(n_rows + 1, dtype=np.int64)
    for p in range(len(rows)):
        starts[rows[p] + 1] += 1
    for r in range(n_rows):
        starts[r + 1] += starts[r]
    free = starts[:-1].copy()
    index = np.empty(len(rows), dtype=np.int64)
    for p in range(len(rows)):
        index[free[rows[p]]] = p
        free[rows[p]] += 1
    table = Table(starts, np.empty(len(rows), dtype=np.int64), np.empty(len(rows)), n_columns)
    for p in range(len(rows)):
        table.columns[p], table.odds[p] = columns[index[p]], odds[index[p]]
    return table, index


@compiled
def make_plan(table: Table, most_width: int) -> Plan:
    """Choose an order of the rows that keeps the frontier narrow; give up above a width."""
    n_rows = len(table.starts) - 1
    uses_left = np.zeros(table.n_columns, dtype=np.int64)
    for column in table.columns:
        uses_left[column] += 1
    order = np.arange(n_rows) if n_rows <= MOST_ROWS_TO_ORDER else _by_position(table)
    active = np.zeros(table.n_columns, dtype=np.bool_)
    frontier, width, room, cost = 0, 0, 0, 0.0
    for step in range(n_rows):
        if n_rows <= MOST_ROWS_TO_ORDER:
            _bring_forward(table, order, step, uses_left, active)
        row = order[step]
        shared, leaving = 0, 0
        for p in range(table.starts[row], table.starts[row + 1]):
            column = table.columns[p]
            uses_left[column] -= 1
            if active[column] or uses_left[column] > 0:
                shared += 1
                frontier += 0 if active[column] else 1
                active[column] = uses_left[column] > 0
                leaving += 0 if active[column] else 1
        if frontier > most_width:
            return Plan(order, frontier, 0, math.inf)
        width = max(width, frontier)
        room += 1 << frontier
        cost += float((1 << frontier) * (shared + 2))
        frontier -= leaving
    return Plan(order, width, room, cost)


@compiled
def _by_position(table: Table) -> Integers:
    """Rows in order of the mean number of their columns: detections are numbered along the image."""
    n_rows = len(table.starts) - 1
    place = np.zeros(n_rows)
    for row in range(n_rows):
        for p in range(table.starts[row], table.starts[row + 1]):
            place[row] += table.columns[p]
        place[row] /= max(table.starts[row + 1] - table.starts[row], 1)
    return stable_order(place)


@compiled
def _bring_forward(table: Table, order: Integers, step: int, uses_left: Integers, active: NDArray[np.bool_]) -> None:
    """Put the remaining row that leaves the narrowest frontier next, keeping the order of the others."""
    best, least = step, np.int64(1 << 62)
    for place in range(step, len(order)):
        row = order[place]
        joining, leaving = 0, 0
        for p in range(table.starts[row], table.starts[row + 1]):
            column = table.columns[p]
            if uses_left[column] == 1:
                leaving += 1 if active[column] else 0
            elif not active[column]:
                joining += 1
        # the frontier after the row decides, then the frontier during it
        grown = (joining - leaving) * 64 + joining
        if grown < least:
            best, least = place, np.int64(grown)
    row = order[best]
    for place in range(best, step, -1):
        order[place] = order[place - 1]
    order[step] = row


@compiled
def eliminate(table: Table, plan: Plan) -> tuple[Array, Array, Array, float]:
    """Exact marginals of a cluster, by a plan of finite cost.

    Returns the probabilities of the pairs (p,) in the order of the table, that a row takes no column (n_rows,), that no
    row takes a column (n_columns,), and the logarithm of the sum over all choices.
    """
    n_rows, size = len(table.starts) - 1, 1 << plan.width
    messages = np.empty(plan.room)
    # of every step: where its message begins, the columns of its frontier, how many of them are new, which leave
    starts = np.empty(n_rows, dtype=np.int64)
    widths = np.empty((n_rows, 2), dtype=np.int64)
    frontiers = np.empty((n_rows, max(plan.width, 1)), dtype=np.int64)
    uses_left = np.zeros(table.n_columns, dtype=np.int64)
    for column in table.columns:
        uses_left[column] += 1
    bit = np.full(table.n_columns, -1, dtype=np.int64)
    leaves = np.zeros((n_rows, max(plan.width, 1)), dtype=np.bool_)
    message, after = np.zeros(size), np.empty(size)
    message[0] = 1.0
    frontier = np.empty(max(plan.width, 1), dtype=np.int64)
    width, offset, log_evidence = 0, 0, 0.0
    for step in range(n_rows):
        row = plan.order[step]
        begin, end = table.starts[row], table.starts[row + 1]
        before = width
        for b in range(before):
            frontiers[step, b] = frontier[b]
        private = 1.0
        for p in range(begin, end):
            column = table.columns[p]
            uses_left[column] -= 1
            if bit[column] < 0 and uses_left[column] == 0:
                private += table.odds[p]
            elif bit[column] < 0:
                bit[column] = width
                frontiers[step, width] = column
                width += 1
        starts[step], widths[step, 0], widths[step, 1] = offset, before, width
        for s in range(1 << width):
            message[s] = message[s] if s < 1 << before else 0.0
            messages[offset + s] = message[s]
        offset += 1 << width
        _advance(table, begin, end, bit, private, message, after, width)
        kept = 0
        for b in range(width):
            column = frontiers[step, b]
            leaves[step, b] = uses_left[column] == 0
            if uses_left[column] > 0:
                frontier[kept] = column
                kept += 1
        for b in range(width - 1, -1, -1):
            if leaves[step, b]:
                bit[frontiers[step, b]] = -1
                width -= 1
                _sum_out(after, b, width)
        for b in range(kept):
            bit[frontier[b]] = b
        total = 0.0
        for s in range(1 << width):
            total += after[s]
        log_evidence += math.log(total)
        for s in range(1 << width):
            message[s] = after[s] / total
    pair, idle, free = _backward(table, plan, messages, starts, widths, frontiers, leaves)
    return pair, idle, free, log_evidence


@compiled
def _advance(
    table: Table, begin: int, end: int, bit: Integers, private: float, message: Array, after: Array, width: int
) -> None:
    """Fill `after` with the message after a row: it takes nothing, a column of its own, or one of the frontier."""
    for s in range(1 << width):
        after[s] = private * message[s]
    for p in range(begin, end):
        b = bit[table.columns[p]]
        if b >= 0:
            odds, flag = table.odds[p], 1 << b
            for high in range(0, 1 << width, 2 * flag):
                for s in range(high, high + flag):
                    after[s + flag] += odds * message[s]


@compiled
def _sum_out(message: Array, b: int, width: int) -> None:
    """Sum a message over a bit, in place; `width` bits remain."""
    low_mask = (1 << b) - 1
    for s in range(1 << width):
        source = (s & low_mask) | ((s & ~low_mask) << 1)
        message[s] = message[source] + message[source | (1 << b)]


@compiled
def _expand(message: Array, b: int, width: int) -> None:
    """Insert a bit on which a message does not depend, in place; `width` bits with it."""
    low_mask = (1 << b) - 1
    for s in range((1 << width) - 1, -1, -1):
        message[s] = message[(s & low_mask) | ((s >> 1) & ~low_mask)]


@compiled
def _backward(
    table: Table,
    plan: Plan,
    messages: Array,
    starts: Integers,
    widths: Integers,
    frontiers: Integers,
    leaves: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """Marginals from the forward messages (parameters as in `eliminate`)."""
    n_rows, size = len(table.starts) - 1, 1 << plan.width
    pair, idle, free = np.zeros(len(table.odds)), np.ones(n_rows), np.ones(table.n_columns)
    bit = np.full(table.n_columns, -1, dtype=np.int64)
    backward, earlier, forward = np.empty(size), np.empty(size), np.empty(size)
    backward[0] = 1.0
    for step in range(n_rows - 1, -1, -1):
        row, width = plan.order[step], widths[step, 1]
        begin, end = table.starts[row], table.starts[row + 1]
        remaining = width - leaves[step, :width].sum()
        for b in range(width):
            bit[frontiers[step, b]] = b
            if leaves[step, b]:
                remaining += 1
                _expand(backward, b, remaining)
        message = messages[starts[step] : starts[step] + (1 << width)]
        base = 0.0
        for s in range(1 << width):
            base += message[s] * backward[s]
        private, total = 1.0, base
        for s in range(1 << width):
            earlier[s] = 0.0
        for p in range(begin, end):
            b = bit[table.columns[p]]
            if b < 0:
                private += table.odds[p]
                pair[p] = table.odds[p] * base
            else:
                flag, value = 1 << b, 0.0
                for high in range(0, 1 << width, 2 * flag):
                    for s in range(high, high + flag):
                        value += message[s] * backward[s + flag]
                        earlier[s] += table.odds[p] * backward[s + flag]
                pair[p] = table.odds[p] * value
            total += pair[p]
        idle[row] = base / total
        if remaining > width - leaves[step, :width].sum():
            _advance(table, begin, end, bit, private, message, forward, width)
        for p in range(begin, end):
            pair[p] /= total
            if bit[table.columns[p]] < 0:
                free[table.columns[p]] = max(1.0 - pair[p], 0.0)
        for b in range(width):
            if leaves[step, b]:
                flag, value = 1 << b, 0.0
                for high in range(0, 1 << width, 2 * flag):
                    for s in range(high, high + flag):
                        value += forward[s] * backward[s]
                free[frontiers[step, b]] = value / total
            bit[frontiers[step, b]] = -1
        # columns that join with this row are not in the message before it
        largest = 0.0
        for s in range(1 << widths[step, 0]):
            earlier[s] += private * backward[s]
            largest = max(largest, earlier[s])
        for s in range(1 << widths[step, 0]):
            backward[s] = earlier[s] / largest
    return pair, idle, free
