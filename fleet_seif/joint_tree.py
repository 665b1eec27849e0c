"""A tree of frames: the sparse Cholesky factor of the joint information matrix, of which only what changed is redone.

1. Leaves hold frames that lie near each other (pieces of frames, where those are large). A node stands for all frames
   below it.
2. A node adds up what its children (or its own frames) say about their variables. Variables that no frame elsewhere
   touches are eliminated there, the others are passed on: at the root nothing is left. This is the multifrontal method;
   halving by place keeps what two halves share small, as in nested dissection.
3. Of a node, D, W and U are kept: with E eliminated and B passed on, of H = [H_EE H_EB; H_EB' H_BB],

       D'D = H_EE,  D upper triangular        W = D^-T H_EB        U = H_BB - W'W

   U is what all frames below say about B: their own variables, poses included, marginalised out.
4. A node is stale when its frames are linearised anew or changed, or when a variable's end of elimination moves; then
   all above it are. The others are not touched, so the cost of a refresh follows what changed.
5. A node one of whose children has far more pieces than the other is built anew.

Rounding depends on the history of a tree; a tree that is fed the same pieces in the same order gives the same bits.
"""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy.linalg

from fleet_seif.errors import NumericalError
from fleet_seif.jit import kernel
from fleet_seif.joint_assembly import Evaluation, add_pieces_into
from fleet_seif.joint_frames import Frames
from fleet_seif.records import Floats, Ints

LEAF_PIECES_MAX: Final = 6
BALANCE_MAX: Final = 0.7
"""Largest share of a node's pieces that one child may hold, beyond a leaf's."""

_blas, _lapack = scipy.linalg.blas, scipy.linalg.lapack


class Piece(NamedTuple):
    """A frame, or a part of one: frame number, first and last block + 1; what it touches, each once; where it lies."""

    frame: int
    first: int
    last: int
    variables: Ints
    place: tuple[float, float]


class Node:
    """See the rules above. `variables`: E ascending, then B ascending; `eliminated`: how many are E."""

    __slots__ = (
        "D", "U", "W", "at", "axis", "children", "count", "counts", "eliminated", "parent", "pieces", "place",
        "reshape", "rows", "stale", "variables",
    )  # fmt: skip

    def __init__(self, parent: "Node | None") -> None:
        self.parent = parent
        self.children: tuple[Node, Node] | tuple[()] = ()
        self.pieces: list[int] = []
        self.count = 0
        self.axis, self.at = 0, 0.0
        self.stale = self.reshape = True
        self.variables = self.counts = self.rows = self.place = np.empty(0, np.int64)
        self.eliminated = 0
        self.D = self.W = np.empty((0, 0))
        self.U = np.empty(0)


@kernel
def _merged(a: Ints, a_counts: Ints, b: Ints, b_counts: Ints, total: Ints) -> tuple[Ints, Ints, int]:
    """Two ascending lists of variables with counts, as one: those whose count is the total first, and how many."""
    most = len(a) + len(b)
    variables, counts = np.empty(most, np.int64), np.empty(most, np.int64)
    rest, rest_counts = np.empty(most, np.int64), np.empty(most, np.int64)
    i = j = n = m = 0
    while i < len(a) or j < len(b):
        v = b[j] if i == len(a) or (j < len(b) and b[j] < a[i]) else a[i]
        count = 0
        if i < len(a) and a[i] == v:
            count += a_counts[i]
            i += 1
        if j < len(b) and b[j] == v:
            count += b_counts[j]
            j += 1
        if count == total[v]:
            variables[n], counts[n] = v, count
            n += 1
        else:
            rest[m], rest_counts[m] = v, count
            m += 1
    for k in range(m):
        variables[n + k], counts[n + k] = rest[k], rest_counts[k]
    return variables[: n + m].copy(), counts[: n + m].copy(), n


@kernel
def _rows_into(place: Ints, variables: Ints, size: Ints) -> Ints:
    """Rows of the state (three a variable) that variables have, one after the other; where each begins, into place."""
    n = 0
    for v in variables:
        place[v] = n
        n += size[v]
    rows = np.empty(n, np.int64)
    for v in variables:
        for a in range(size[v]):
            rows[place[v] + a] = 3 * v + a
    return rows


@kernel
def _positions(place: Ints, variables: Ints, size: Ints) -> Ints:
    """The row in a front of each row of these variables."""
    n = 0
    for v in variables:
        n += size[v]
    positions = np.empty(n, np.int64)
    n = 0
    for v in variables:
        for a in range(size[v]):
            positions[n] = place[v] + a
            n += 1
    return positions


@kernel
def _extend_into(D: Floats, W: Floats, U: Floats, child: Floats, place: Ints) -> None:
    """Add what a child passes on (the upper triangle, row by row) to the front of its parent.

    place: the row in the front of each of the child's rows. Those eliminated here ascend, and so do those passed on.
    """
    e, n = len(D), len(place)
    order, here = np.empty(n, np.int64), 0
    for a in range(n):
        if place[a] < e:
            order[here] = a
            here += 1
    on = here
    for a in range(n):
        if place[a] >= e:
            order[on] = a
            on += 1
    for t in range(here):
        a = order[t]
        row, at = place[a], a * n - a * (a + 1) // 2  # child (a, b) is child[at + b] for b >= a
        for u in range(t, here):
            D[row, place[order[u]]] += child[at + order[u]]
        for u in range(here, n):
            b = order[u]
            W[row, place[b] - e] += child[at + b] if b >= a else child[b * n - b * (b + 1) // 2 + a]
    for t in range(here, n):
        a = order[t]
        row, at = place[a] - e, a * n - a * (a + 1) // 2
        for u in range(t, n):
            U[row, place[order[u]] - e] += child[at + order[u]]


@kernel
def _packed(U: Floats) -> Floats:
    """The upper triangle, row by row."""
    n, at = len(U), 0
    out = np.empty(n * (n + 1) // 2)
    for i in range(n):
        for j in range(i, n):
            out[at] = U[i, j]
            at += 1
    return out


@kernel
def _forward_into(g: Floats, D: Floats, W: Floats, rows: Ints) -> None:
    """y_E = D^-T g_E in place of g_E, and g_B -= W' y_E."""
    e, n = len(D), len(rows)
    v = g[rows]
    for i in range(e):
        y = v[i] / D[i, i]
        v[i] = y
        for j in range(i + 1, e):
            v[j] -= D[i, j] * y
    if 0 < e < n:
        pulled = np.dot(v[:e], W)
        for j in range(n - e):
            v[e + j] -= pulled[j]
    for i in range(n):
        g[rows[i]] = v[i]


@kernel
def _backward_into(g: Floats, D: Floats, W: Floats, rows: Ints) -> None:
    """x_E = D^-1 (y_E - W x_B) in place of y_E."""
    e, n = len(D), len(rows)
    v = g[rows]
    if 0 < e < n:
        pulled = np.dot(W, v[e:])
        for i in range(e):
            v[i] -= pulled[i]
    for i in range(e - 1, -1, -1):
        v[i] = (v[i] - np.dot(D[i, i + 1 :], v[i + 1 : e])) / D[i, i]
        g[rows[i]] = v[i]


def _factored(D: Floats, W: Floats, U: Floats, damping: float) -> None:
    """Rule 3, in place. Transposed views are what LAPACK calls lower triangles."""
    e, b = W.shape
    if not e:
        return
    if damping:
        D[np.arange(e), np.arange(e)] *= 1.0 + damping
    _, fault = _lapack.dpotrf(D.T, lower=1, overwrite_a=1, clean=0)
    if fault:
        raise NumericalError("the joint information matrix is not positive definite: a delta is missing or wrong")
    if b:
        _blas.dtrsm(1.0, D.T, W.T, side=1, lower=1, trans_a=1, overwrite_b=1)
        _blas.dsyrk(-1.0, W.T, beta=1.0, c=U.T, lower=1, overwrite_c=1)


class Tree:
    """See the rules above.

    Joint variables are numbered 0 ... v-1 in the order they were told of; the state has three rows for each. size (v,):
    rows of each in the system; touches (v,): how many pieces it is in.
    """

    def __init__(self) -> None:
        self.pieces: dict[int, Piece] = {}
        self.root = Node(None)
        self.size = np.empty(0, np.int64)
        self._next = 0
        self._leaf: dict[int, Node] = {}
        self._home: list[Node | None] = []
        self._touching: list[set[int]] = []
        self.touches = np.empty(0, np.int64)
        self._place = np.empty(0, np.int64)
        self._order: list[Node] = []
        self._damping = 0.0

    def know(self, sizes: Sequence[int]) -> None:
        """More joint variables: two rows each, or three."""
        more = np.array(sizes, np.int64)
        self.size = np.concatenate([self.size, more])
        self.touches = np.concatenate([self.touches, np.zeros(len(more), np.int64)])
        self._place = np.zeros(len(self.size), np.int64)
        self._home += [None] * len(more)
        self._touching += [set() for _ in more]

    def add(self, pieces: Sequence[Piece]) -> list[int]:
        """Take pieces in; their numbers."""
        numbers = list(range(self._next, self._next + len(pieces)))
        self._next += len(pieces)
        for number, piece in zip(numbers, pieces, strict=True):
            self.pieces[number] = piece
            self._touch(number, piece.variables)
        if 2 * len(pieces) > self.root.count:
            self._build(self.root, [*self._below(self.root), *numbers])
        else:
            for number in numbers:
                self._insert(number)
        self._order = []
        return numbers

    def remove(self, numbers: Sequence[int]) -> None:
        """Take pieces out again."""
        for number in numbers:
            node: Node | None = self._leaf.pop(number)
            self._mark(node)
            self._untouch(number, self.pieces.pop(number).variables)
            while node is not None:
                node.count -= 1
                if not node.children:
                    node.pieces.remove(number)
                node = node.parent

    def replace(self, number: int, piece: Piece) -> None:
        """Another content for a piece, at the same place in the tree."""
        old = self.pieces[number].variables
        self.pieces[number] = piece
        self._mark(self._leaf[number])
        self._untouch(number, np.setdiff1d(old, piece.variables))
        self._touch(number, np.setdiff1d(piece.variables, old))

    def touching(self, numbers: Sequence[int]) -> Ints:
        """Frame, first and last block + 1 of every piece that shares a variable with these, itself included; (p, 3)."""
        variables = {v for number in numbers for v in self.pieces[number].variables.tolist()}
        found = sorted(set[int]().union(*(self._touching[v] for v in variables)))
        return np.array([self.pieces[number][:3] for number in found], np.int64)

    def _touch(self, number: int, variables: Ints) -> None:
        """A piece touches these: where they were eliminated they may no longer be."""
        for v in variables.tolist():
            self._mark(self._home[v])
            self._touching[v].add(number)
        self.touches[variables] += 1

    def _untouch(self, number: int, variables: Ints) -> None:
        """A piece no longer touches these: they may be eliminated nearer to those that do."""
        for v in variables.tolist():
            self._touching[v].discard(number)
            for other in self._touching[v]:
                self._mark(self._leaf[other])
        self.touches[variables] -= 1

    def relinearise(self, numbers: Sequence[int]) -> None:
        """These pieces are to be added up anew, their variables as before."""
        for number in numbers:
            self._mark(self._leaf[number], reshape=False)

    def _mark(self, node: Node | None, *, reshape: bool = True) -> None:
        """A node is stale, and all above it (rule 4)."""
        while node is not None and not (node.stale and (node.reshape or not reshape)):
            node.stale, node.reshape = True, node.reshape or reshape
            node = node.parent

    def _below(self, node: Node) -> list[int]:
        return [number for leaf in _postorder(node) for number in leaf.pieces]

    def _insert(self, number: int) -> None:
        node, crooked, place = self.root, None, self.pieces[number].place
        while True:
            node.count += 1
            if not node.children:
                break
            left, right = node.children
            nearer = left if place[node.axis] < node.at else right
            if crooked is None and nearer.count + 1 > BALANCE_MAX * node.count + LEAF_PIECES_MAX:
                crooked = node
            node = nearer
        node.pieces.append(number)
        self._leaf[number] = node
        self._mark(node)
        if crooked is not None:
            self._build(crooked, self._below(crooked))
        elif len(node.pieces) > LEAF_PIECES_MAX:
            self._build(node, node.pieces)

    def _build(self, node: Node, numbers: list[int]) -> None:
        """Make a node stand for these pieces: halved along the longer side until few are left."""
        node.count, node.pieces, node.children = len(numbers), [], ()
        node.stale = False
        self._mark(node)
        if len(numbers) <= LEAF_PIECES_MAX:
            node.pieces = numbers
            for number in numbers:
                self._leaf[number] = node
            return
        places = np.array([self.pieces[number].place for number in numbers])
        node.axis = int(np.argmax(np.ptp(places, axis=0)))
        order = np.argsort(places[:, node.axis], kind="stable")
        half = len(order) // 2
        node.at = float(places[order[half], node.axis])
        node.children = (Node(node), Node(node))
        for child, part in zip(node.children, (order[:half], order[half:]), strict=True):
            self._build(child, [numbers[i] for i in part.tolist()])

    def nodes(self) -> list[Node]:
        """Children before parents."""
        if not self._order:
            self._order = list(_postorder(self.root))
        return self._order

    def factor(self, frames: Frames, at: Evaluation, damping: float = 0.0) -> int:
        """Bring D, W and U up to date, frames below stale nodes linearised at `at`. Returns how many nodes were redone.

        damping: share by which the diagonal grows when a variable is eliminated; a change of it makes all stale.

        Raises NumericalError where the matrix is not positive definite; whatever was stale is stale still.
        """
        if damping != self._damping:
            for node in self.nodes():
                node.stale = True
            self._damping = damping
        stale = [node for node in self.nodes() if node.stale]
        for node in stale:
            if node.reshape:
                self._shape(node)
            self._sum_up(node, frames, at)
        for node in stale:
            node.stale = node.reshape = False
        return len(stale)

    def _shape(self, node: Node) -> None:
        """Which variables a node has, and which of them it eliminates."""
        if node.children:
            lists = [(c.variables[c.eliminated :], c.counts[c.eliminated :]) for c in node.children]
        else:
            touched = [self.pieces[number].variables for number in node.pieces]
            nothing = np.empty(0, np.int64)
            variables, counts = np.unique(np.concatenate([*touched, nothing]), return_counts=True)
            lists = [(variables, counts.astype(np.int64)), (nothing, nothing)]
        (a, a_counts), (b, b_counts) = lists
        node.variables, node.counts, node.eliminated = _merged(a, a_counts, b, b_counts, self.touches)
        node.rows = _rows_into(self._place, node.variables, self.size)
        for child in node.children:
            child.place = _positions(self._place, child.variables[child.eliminated :], self.size)
        for v in node.variables[: node.eliminated].tolist():
            self._home[v] = node

    def _sum_up(self, node: Node, frames: Frames, at: Evaluation) -> None:
        e = int(self.size[node.variables[: node.eliminated]].sum())
        b = len(node.rows) - e
        if node.children:
            D, W, U = np.zeros((e, e)), np.zeros((e, b)), np.zeros((b, b))
            for child in node.children:
                _extend_into(D, W, U, child.U, child.place)
        else:
            F = np.zeros((e + b, e + b))
            _rows_into(self._place, node.variables, self.size)
            own = np.array([self.pieces[number][:3] for number in node.pieces], np.int64).reshape(-1, 3)
            add_pieces_into(F, frames, own, at, self._place)
            D, W, U = F[:e, :e].copy(), F[:e, e:].copy(), F[e:, e:].copy()
        _factored(D, W, U, self._damping)
        node.D, node.W, node.U = D, W, _packed(U)

    def solve(self, g: Floats) -> Floats:
        """H^-1 g, shape (v, 3) like g; zero where there is no variable."""
        x = g.ravel().copy()
        for node in self.nodes():
            _forward_into(x, node.D, node.W, node.rows)
        for node in reversed(self.nodes()):
            _backward_into(x, node.D, node.W, node.rows)
        return x.reshape(-1, 3)

    def covariance(self, variables: Ints) -> Floats:
        """The joint block of H^-1 of these variables (each once, ascending rows of one after the other's), (n, n).

        E' H^-1 E = Y'Y with Y = L^-1 E: only nodes between a variable's own and the root take part.
        """
        sizes = self.size[variables]
        ends = np.cumsum(sizes)
        if not len(ends):
            return np.zeros((0, 0))
        column = dict(zip(variables.tolist(), (ends - sizes).tolist(), strict=True))
        g: dict[Node, Floats] = {}
        for v in variables.tolist():
            node = self._home[v]
            while node is not None and node not in g:
                g[node] = np.zeros((len(node.rows), int(ends[-1])))
                node = node.parent
        total = np.zeros((int(ends[-1]), int(ends[-1])))
        for node in self.nodes():
            if node not in g:
                continue
            whole = g.pop(node)
            at = 0
            for v in node.variables[: node.eliminated].tolist():
                if v in column:
                    for a in range(self.size[v]):
                        whole[at + a, column[v] + a] = 1.0
                at += int(self.size[v])
            if at:
                y = scipy.linalg.solve_triangular(node.D, whole[:at], trans=1, check_finite=False)
                total += y.T @ y
                whole[at:] -= node.W.T @ y
            if node.parent is not None:
                g[node.parent][node.place] += whole[at:]
        return (total + total.T) / 2

    def inverse_blocks(self) -> Floats:
        """The block of H^-1 of every variable, shape (v, 3, 3): selected inversion (Takahashi), from the root down.

        With Y = W' D^-T:   S_BE = -S_BB Y        S_EE = D^-1 D^-T - Y' S_BE

        where S_BB is a part of what the parent has found.
        """
        blocks, S = np.zeros((len(self.size), 3, 3)), {}
        S[self.root] = np.empty((0, 0))
        for node in reversed(self.nodes()):
            S_F = _selected(node.D, node.W, S.pop(node))
            at = 0
            for v in node.variables[: node.eliminated].tolist():
                n = int(self.size[v])
                blocks[v, :n, :n] = S_F[at : at + n, at : at + n]
                at += n
            for child in node.children:
                S[child] = S_F[np.ix_(child.place, child.place)]
        return blocks


def _selected(D: Floats, W: Floats, S_BB: Floats) -> Floats:
    """The inverse over a front, (n, n)."""
    e, b = W.shape
    if not e:
        return S_BB
    inverse, _ = _lapack.dpotri(D.T, lower=1)
    S_EE: Floats = np.tril(inverse) + np.tril(inverse, -1).T
    if not b:
        return S_EE
    Y: Floats = _blas.dtrsm(1.0, D.T, W.T, side=1, lower=1)
    S_BE = -S_BB @ Y
    S_EE -= Y.T @ S_BE
    return np.asarray(np.block([[(S_EE + S_EE.T) / 2, S_BE.T], [S_BE, S_BB]]))


def _postorder(node: Node) -> Iterator[Node]:
    waiting, found = [node], []
    while waiting:
        each = waiting.pop()
        found.append(each)
        waiting += each.children
    return reversed(found)
