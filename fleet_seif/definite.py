"""Whether a frame's information matrix is positive definite, with the same verdict on every machine.

1. Rows go in pairs, so that every block is 2 x 2: x and y of a landmark or the pose; theta with a row of its own.
2. Pairs are eliminated in an order of minimum degree, ties by position: integers decide it, nothing else.
3. In that order H = L L' is factored row by row, each sum in one fixed order: no BLAS, no threads, no fused arithmetic.
4. Memory and time are bounded by VARIABLES_MAX and PRODUCTS_MAX. Beyond them there is no verdict, but NumericalError.

Who is linked to whom is a matrix of bits, a row for each pair. Eliminating a pair links its neighbours with each other:
its row is added to theirs. What remains in its own row is where its column of L has blocks. (Quotient graphs do the
same with less memory and several times the code; 10,000 landmarks take 12 MB and 0.2 s here.)
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_seif.errors import NumericalError
from fleet_seif.information import H_QUANTUM, POSE, FrameDelta, block_size
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints

VARIABLES_MAX: Final = 2**15
"""Most variables of a frame: the matrix of bits then takes 128 MiB."""
PRODUCTS_MAX: Final = 2**30
"""Most products of two blocks in a factorisation, some 3 s of work. L then has at most sqrt(VARIABLES_MAX PRODUCTS_MAX)
= 6 million blocks (Cauchy-Schwarz over its columns): with their places below 400 MiB."""

INDEFINITE: Final = 0
DEFINITE: Final = 1
TOO_LARGE: Final = 2

Bits = NDArray[np.uint64]
WORD: Final = 64
ONE: Final = np.uint64(1)
PAIRS: Final = np.uint64(0x5555555555555555)
QUADS: Final = np.uint64(0x3333333333333333)
NIBBLES: Final = np.uint64(0x0F0F0F0F0F0F0F0F)


class Lists(NamedTuple):
    """Lists of numbers: list i is items[start[i] : start[i + 1]]."""

    start: Ints
    items: Ints


@kernel
def _ones(word: np.uint64) -> np.int64:
    """Number of bits set: summed in pairs, in fours, in bytes, then over the bytes."""
    x = word - ((word >> np.uint64(1)) & PAIRS)
    x = (x & QUADS) + ((x >> np.uint64(2)) & QUADS)
    x = (x + (x >> np.uint64(4))) & NIBBLES
    x += x >> np.uint64(8)
    x += x >> np.uint64(16)
    x += x >> np.uint64(32)
    return np.int64(x & np.uint64(127))


@kernel
def _degree(row: Bits) -> np.int64:
    count = np.int64(0)
    for word in row:
        count += _ones(word)
    return count


@kernel
def _members_into(members: Ints, row: Bits) -> int:
    """Positions of the bits set in a row, ascending; returns how many."""
    n = 0
    for w in range(len(row)):
        word = row[w]
        while word != 0:
            rest = word & (word - ONE)
            members[n] = WORD * w + _ones((word ^ rest) - ONE)
            word = rest
            n += 1
    return n


@kernel
def _block_into(blocks: Floats, a: int, b: int, c: int, d: int) -> None:
    """Write a block in quanta, rows (a b) and (c d)."""
    blocks[0], blocks[1], blocks[2], blocks[3] = a * H_QUANTUM, b * H_QUANTUM, c * H_QUANTUM, d * H_QUANTUM


@kernel
def _pairs(variables: Ints, rows: Ints, cols: Ints, H: Ints) -> tuple[Ints, Ints, Floats]:
    """H as 2 x 2 blocks of pairs of rows: their pairs i and j, shape (k,), and values, shape (k, 4), row by row.

    Pair 0 is x and y of the pose, pair 1 its theta and a row of nothing but a 1 on the diagonal, the others are the
    landmarks. variables: the pose first.
    """
    most = len(rows) + len(variables) + 2  # a block of the pose and a landmark is two here, that of the pose three
    i, j, values = np.zeros(most, np.int64), np.zeros(most, np.int64), np.empty((most, 4))
    n = at = 0
    for k in range(len(rows)):
        h = H[at:]
        at += block_size(variables[rows[k]], variables[cols[k]])
        if cols[k] == 0:
            _block_into(values[n], h[0], h[1], h[1], h[3])
            _block_into(values[n + 1], h[2], 0, h[4], 0)
            _block_into(values[n + 2], h[5], 0, 0, 2**28)
            j[n + 1] = i[n + 2] = j[n + 2] = 1
            n += 3
        elif rows[k] == 0:
            _block_into(values[n], h[0], h[1], h[2], h[3])
            _block_into(values[n + 1], h[4], h[5], 0, 0)
            i[n + 1], j[n], j[n + 1] = 1, cols[k] + 1, cols[k] + 1
            n += 2
        else:
            same = rows[k] == cols[k]
            _block_into(values[n], h[0], h[1], h[1] if same else h[2], h[2] if same else h[3])
            i[n], j[n] = rows[k] + 1, cols[k] + 1
            n += 1
    return i[:n], j[:n], values[:n]


@kernel
def _links(count: int, rows: Ints, cols: Ints) -> Bits:
    """The matrix of bits of `count` variables: a block links two of them."""
    bits = np.zeros((count, (count + WORD - 1) // WORD), np.uint64)
    for k in range(len(rows)):
        i, j = rows[k], cols[k]
        if i != j:
            bits[i, j // WORD] |= ONE << np.uint64(j % WORD)
            bits[j, i // WORD] |= ONE << np.uint64(i % WORD)
    return bits


@kernel
def _eliminate(bits: Bits) -> tuple[Ints, int]:
    """An order of minimum degree, shape (v,), and the blocks L has below its diagonal: -1, unfinished, if too large.

    The row of a variable is left with those that come later and that its columns of L reach.
    """
    count, words = bits.shape
    order, degree, members = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    for i in range(count):
        degree[i] = _degree(bits[i])
    blocks = products = 0
    for k in range(count):
        v = 0
        for i in range(1, count):
            if degree[i] < degree[v]:
                v = i
        order[k] = v
        blocks += degree[v]
        products += degree[v] ** 2
        if products > PRODUCTS_MAX:
            return order, -1
        degree[v] = count  # gone: above every degree
        for i in members[: _members_into(members, bits[v])]:
            for w in range(words):
                bits[i, w] |= bits[v, w]
            bits[i, i // WORD] &= ~(ONE << np.uint64(i % WORD))
            bits[i, v // WORD] &= ~(ONE << np.uint64(v % WORD))
            degree[i] = _degree(bits[i])
    return order, blocks


@kernel
def _starts(keys: Ints, count: int) -> Ints:
    """How many of `keys` are below 0, 1 .. count, shape (count + 1,)."""
    start = np.zeros(count + 1, np.int64)
    for key in keys:
        start[key + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    return start


@kernel
def _grouped(keys: Ints, count: int) -> Lists:
    """Positions in `keys` of each key 0 .. count - 1, ascending."""
    start, items = _starts(keys, count), np.empty(len(keys), np.int64)
    end = start.copy()
    for i in range(len(keys)):
        items[end[keys[i]]] = i
        end[keys[i]] += 1
    return Lists(start, items)


@kernel
def _row_structure(bits: Bits, order: Ints, place: Ints, blocks: int) -> Lists:
    """For each variable in `order` the earlier ones its row of L has blocks for, ascending. place: inverse of order."""
    earlier, later = np.empty(blocks, np.int64), np.empty(blocks, np.int64)
    members = np.empty(len(order), np.int64)
    n = 0
    for k in range(len(order)):
        for member in members[: _members_into(members, bits[order[k]])]:
            earlier[n], later[n] = k, place[member]
            n += 1
    grouped = _grouped(later, len(order))
    return Lists(grouped.start, earlier[grouped.items])


@kernel
def _scatter_into(X: Floats, i: int, own: Ints, p: Ints, q: Ints, values: Floats) -> None:
    """Write the row of pair i of H, up to the diagonal, into X (n, 4). own: its blocks; (p, q): where a block is."""
    for k in own:
        j = q[k] if p[k] == i else p[k]
        X[j, 0], X[j, 3] = values[k, 0], values[k, 3]
        X[j, 1], X[j, 2] = (values[k, 1], values[k, 2]) if p[k] == i else (values[k, 2], values[k, 1])


@kernel
def _factors(structure: Lists, own: Lists, p: Ints, q: Ints, H: Floats) -> bool:
    """Whether H = L L' exists, found row by row, in blocks: L_ik = (H_ik - sum_j<k L_ij L_kj') inv(L_kk)'.

    Args:
        structure: earlier pairs that the row of a pair in L reaches; own: blocks of H in a pair's row.
        p, q: places of a block's two pairs, shape (k,). H: the blocks, shape (k, 4), rows of p, columns of q.
    """
    count = len(structure.start) - 1
    start = _starts(structure.items, count)
    end = start.copy()
    L, places = np.empty((len(structure.items), 4)), np.empty(len(structure.items), np.int64)
    diagonal, X = np.empty((count, 3)), np.zeros((count, 4))
    for i in range(count):
        _scatter_into(X, i, own.items[own.start[i] : own.start[i + 1]], p, q, H)
        xx, xy, yy = X[i, 0], X[i, 2], X[i, 3]
        X[i] = 0.0
        for k in structure.items[structure.start[i] : structure.start[i + 1]]:
            d_xx, d_xy, d_yy = diagonal[k, 0], diagonal[k, 1], diagonal[k, 2]
            a, c = X[k, 0] / d_xx, X[k, 2] / d_xx
            b, d = (X[k, 1] - a * d_xy) / d_yy, (X[k, 3] - c * d_xy) / d_yy
            X[k] = 0.0
            for e in range(start[k], end[k]):
                j = places[e]
                X[j, 0] -= a * L[e, 0] + b * L[e, 1]
                X[j, 1] -= a * L[e, 2] + b * L[e, 3]
                X[j, 2] -= c * L[e, 0] + d * L[e, 1]
                X[j, 3] -= c * L[e, 2] + d * L[e, 3]
            xx, xy, yy = xx - (a * a + b * b), xy - (a * c + b * d), yy - (c * c + d * d)
            L[end[k], 0], L[end[k], 1], L[end[k], 2], L[end[k], 3] = a, b, c, d
            places[end[k]] = i
            end[k] += 1
        if not xx > 0.0:  # NaN is not
            return False
        diagonal[i, 0] = math.sqrt(xx)
        diagonal[i, 1] = xy / diagonal[i, 0]
        rest = yy - diagonal[i, 1] * diagonal[i, 1]
        if not rest > 0.0:
            return False
        diagonal[i, 2] = math.sqrt(rest)
    return True


@kernel
def _verdict(variables: Ints, rows: Ints, cols: Ints, H: Ints) -> int:
    """DEFINITE, INDEFINITE or TOO_LARGE."""
    count = len(variables) + 1
    i, j, values = _pairs(variables, rows, cols, H)
    bits = _links(count, i, j)
    order, blocks = _eliminate(bits)
    if blocks < 0:
        return TOO_LARGE
    place = np.empty(count, np.int64)
    for k in range(count):
        place[order[k]] = k
    p, q = place[i], place[j]
    own = _grouped(np.maximum(p, q), count)
    return DEFINITE if _factors(_row_structure(bits, order, place, blocks), own, p, q, values) else INDEFINITE


def is_positive_definite(delta: FrameDelta) -> bool:
    """Whether a cumulative delta holds the pose, and its H (2^-28 per quantum) has a Cholesky factor in float64.

    A variable without a block on the diagonal makes it False. Rounding decides where an eigenvalue is within about
    1e-15 of zero, relative to the diagonal: the same way everywhere.

    Raises:
        NumericalError: the frame is too large to tell.
    """
    count = len(delta.variables)
    if not count or delta.variables[0] != POSE:
        return False
    if count > VARIABLES_MAX:
        raise NumericalError(f"frame of {count} variables: at most {VARIABLES_MAX} are checked; begin frames earlier")
    verdict = _verdict(delta.variables, delta.rows, delta.cols, delta.H)
    if verdict == TOO_LARGE:
        raise NumericalError(
            f"frame of {count} variables: to factor it takes more than {PRODUCTS_MAX} products of blocks; "
            "keep fewer links (active_max) or begin frames earlier"
        )
    return verdict == DEFINITE
