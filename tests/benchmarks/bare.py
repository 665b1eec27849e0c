"""The factorisations that a step needs, on their own: what is left of a step if everything else cost nothing.

All by the routines of fleet_seif.dense that the step itself uses. Two answers to "needs", with n rows of the block
(pose, active, sighted), a landmarks active before the step, k cut from the pose:

1. As the paper's formulas ask, at the local sizes.
   motion      H' = (F H^-1 F' + U)^-1 on pose and active: 3 + 2 a rows, as many right-hand sides. Its Lemma 3 reduces
               that to three rows: `motion_3`, three rows and 3 + 2 a right-hand sides.
   sparsify    eq. (42): three solves, of 2 k, 3 + 2 k and 3 rows, each against the n columns of the block.
   recover     n rows, one right-hand side.
2. As our algebra needs (MATHS.md, sections 4, 7, 9).
   motion      three rows and right-hand sides.
   sparsify    2 k rows, three right-hand sides; twice three rows and right-hand sides.
   recover     n rows, one right-hand side.
   gate        n rows, factor only; counted on its own, as the paper has no gate.
"""

from typing import Final, NamedTuple

import numpy as np

from fleet_seif.dense import cholesky_into, solve_3x3, solve_lower_into, solve_upper_into
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints
from tests.benchmarks.captured import Captured
from tests.benchmarks.clock import now_ns

PAPER: Final = ("motion", "sparsify_0", "sparsify_x0", "sparsify_x", "recover")
LEMMA_3: Final = ("motion_3", "sparsify_0", "sparsify_x0", "sparsify_x", "recover")
OURS: Final = ("motion_3x3", "sparsify_00", "sparsify_3x3", "sparsify_3x3", "recover")
GATE: Final = "gate"
DEFINITIONS: Final = {"paper": PAPER, "paper_lemma_3": LEMMA_3, "ours": OURS, "ours_and_gate": (*OURS, GATE)}


class Solve(NamedTuple):
    """A (n, n) symmetric positive definite; B (k, n): each row is one right-hand side.

    general: A has three rows and is solved without use of its symmetry, as the step does.
    """

    A: Floats
    B: Floats
    general: bool = False


@kernel
def solve_ns(repeats: int, systems: tuple[Solve, ...], work: bool) -> tuple[int, float]:
    """Time of copying all right-hand sides and, if `work`, solving one system after the other, so many times over, ns.

    The numbers are read once before, for within a step they have just been made. The second result is there so that
    the compiler cannot leave the work out.
    """
    rows = columns = 1
    for system in systems:
        rows, columns = max(rows, len(system.A)), max(columns, len(system.B))
    L, space, done = np.zeros((rows, rows)), np.zeros(rows * columns), 0.0
    for system in systems:
        done += np.sum(system.A) + np.sum(system.B)
    begin = now_ns()
    for _ in range(repeats):
        for system in systems:
            n, k = len(system.A), len(system.B)
            X = space[: k * n].reshape(k, n)
            for c in range(k):
                for i in range(n):
                    X[c, i] = system.B[c, i]
            if work and system.general:
                done += solve_3x3(system.A, X)[0, 0]
            elif work:
                done += cholesky_into(L, system.A, n)
                for c in range(k):
                    solve_lower_into(X[c], L, n)
                    solve_upper_into(X[c], L, n)
            done += space[0]
    return now_ns() - begin, done


def solves(captured: Captured) -> dict[str, Solve]:
    """The systems of one step, by name."""
    H = captured.recovered.H
    pose, everything = np.arange(3), np.arange(len(H))
    moving, cut = np.concatenate([pose, _rows(captured.active)]), _rows(captured.dropped)
    pose_and_cut = np.concatenate([pose, cut])
    before, three = captured.before.H, Solve(_part(H, pose, pose), np.eye(3), True)
    return {
        "motion": Solve(_part(before, moving, moving), _part(before, moving, moving)),
        "motion_3": Solve(_part(before, pose, pose), _part(before, moving, pose)),
        "motion_3x3": three,
        "sparsify_0": Solve(_part(H, cut, cut), _part(H, everything, cut)),
        "sparsify_x0": Solve(_part(H, pose_and_cut, pose_and_cut), _part(H, everything, pose_and_cut)),
        "sparsify_x": Solve(_part(H, pose, pose), _part(H, everything, pose)),
        "sparsify_00": Solve(_part(H, cut, cut), _part(H, pose, cut)),
        "sparsify_3x3": three,
        "recover": Solve(H, captured.seen.b[None].copy()),
        GATE: Solve(captured.moved.H, np.empty((0, len(H)))),
    }


def _part(H: Floats, rows: Ints, columns: Ints) -> Floats:
    return np.ascontiguousarray(H[np.ix_(rows, columns)])


def _rows(landmarks: Ints) -> Ints:
    return np.column_stack([3 + 2 * landmarks, 4 + 2 * landmarks]).ravel()


def chosen(captured: Captured, names: tuple[str, ...]) -> tuple[Solve, ...]:
    systems = solves(captured)
    return tuple(systems[name] for name in names)


def cost_us(systems: tuple[Solve, ...], repeats: int) -> float:
    """Time of these solves, one after the other, many times over, without the copying of right-hand sides."""
    whole, copying = (solve_ns(repeats, systems, work)[0] for work in (True, False))
    return (whole - copying) * 1e-3 / repeats


def once_us(systems: tuple[Solve, ...]) -> float:
    """The same done once, after other work, as a step has it. The copying is included."""
    return solve_ns(1, systems, True)[0] * 1e-3
