"""The joint solver over whole runs: warm against cold, the tree against dense algebra, frames that contradict."""

import dataclasses
from collections.abc import Sequence
from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif import joint_solver
from fleet_seif.errors import NumericalError
from fleet_seif.frame_deltas import quantised
from fleet_seif.information import B_QUANTUM, FrameDelta, to_information
from fleet_seif.joint import (
    JointSolution,
    JointSolver,
    Life,
    landmark_chi_square,
    landmark_classes,
    marginal_covariances,
    solve,
)
from fleet_seif.joint_assembly import assembled, evaluate_into, turns_into
from fleet_seif.joint_estimate import Estimate
from fleet_seif.joint_records import Classes
from fleet_seif.joint_registry import Records, Registry
from fleet_seif.messages import LandmarkName
from fleet_seif.records import Floats
from fleet_seif.robust import huber_limit
from tests.refresh import Drive, fleet, frame_information
from tests.strategies import settled

FRAMES = 8


@cache
def drives() -> tuple[Drive, ...]:
    """Three vehicles that pass the same landmarks more than once."""
    return tuple(fleet(50, 3, FRAMES, 0.3))


def moved(delta: FrameDelta, by: Floats) -> FrameDelta:
    """The same frame with its mean shifted, (n,) m and rad."""
    b = to_information(delta).H @ by
    return dataclasses.replace(delta, b=delta.b + np.rint(b / B_QUANTUM).astype(np.int64))


def sigmas(a: JointSolution, b: JointSolution) -> float:
    """Largest difference of two means over the same variables, in standard deviations."""
    assert (a.classes, a.poses) == (b.classes, b.poses)
    landmark, pose = marginal_covariances(b)
    variance = [np.diagonal(P, axis1=1, axis2=2).ravel() for P in (landmark, pose)]
    return float(np.max(np.abs(a.mean - b.mean) / np.sqrt(np.concatenate(variance))))


@st.composite
def moments(draw: st.DrawFn) -> tuple[list[Life], Classes]:
    """Some of the vehicles, some of their frames, one of them perhaps corrected since; some merges undone."""
    lives = []
    for drive in draw(st.permutations(drives())):
        count = draw(st.integers(0, FRAMES))
        life = drive.life(count)
        if count and draw(st.booleans()):
            frames, at = list(life.frames), draw(st.integers(0, count - 1))
            frames[at] = moved(frames[at], np.full(len(frames[at].b), 0.01))
            life = dataclasses.replace(life, frames=tuple(frames))
        if draw(st.booleans()):
            life = dataclasses.replace(life, start_pose_cov=np.diag([0.01, 0.01, 1e-4]))
        if draw(st.integers(0, 3)):
            lives.append(life)
    lives.sort(key=lambda life: life.vehicle)
    plain = landmark_classes(lives)
    pairs = [(group[0], group[-1]) for group in plain if len(group) > 1]
    parted = draw(st.lists(st.sampled_from(pairs), max_size=3)) if pairs else []
    return lives, landmark_classes(lives, (), parted)


@given(st.lists(moments(), min_size=2, max_size=5))
@settings(settled, max_examples=15)
def test_a_warm_solution_is_the_cold_one_whatever_came_went_or_changed_before(
    history: list[tuple[list[Life], Classes]],
) -> None:
    warm = JointSolver()
    for lives, classes in history:
        if any(life.frames for life in lives):
            assert sigmas(warm.update(lives, classes), solve(lives, classes)) <= 1e-2
        else:
            with pytest.raises(NumericalError, match="nothing to solve"):
                warm.update(lives, classes)


@given(st.integers(1, FRAMES), st.integers(0, FRAMES), st.floats(0.0, 0.05), st.booleans())
@settings(settled, max_examples=20)
def test_from_any_estimate_near_it_the_map_is_the_cold_one_and_a_function_of_what_is_given(
    count: int, known: int, off: float, other_before: bool
) -> None:
    """known: frames whose estimate is given, the landmarks of later ones are not."""
    life, solver = drives()[0].life(count), JointSolver()
    classes = landmark_classes([life])
    cold = solve([life], classes)
    landmarks, poses = np.full((len(life.signatures), 2), np.nan), cold.pose_mean[:known] + off
    for names, mean in zip(cold.classes, cold.landmark_mean, strict=True):
        if any(names[0].number + 1 in frame.variables for frame in life.frames[:known]):
            landmarks[names[0].number] = mean - off
    if other_before:
        solver.update([drives()[1].life()], landmark_classes([drives()[1].life()]))
    found = solver.solve_from(life, classes, landmarks, poses)
    assert sigmas(found, cold) <= 1e-2
    assert np.array_equal(JointSolver().solve_from(life, classes, landmarks, poses).mean, found.mean)


def near_solver(monkeypatch: pytest.MonkeyPatch, share: float) -> JointSolver:
    """A solver for which the map of these drives is large."""
    monkeypatch.setattr(joint_solver, "NEAR_FRAMES_LEAST", 0)
    monkeypatch.setattr(joint_solver, "PENDING_SHARE", share)
    return JointSolver()


def lives_of(*frames: int) -> list[Life]:
    return [drive.life(count) for drive, count in zip(drives(), frames, strict=True)]


def test_in_a_large_map_a_new_frame_moves_what_it_is_about_to_the_best_place_and_nothing_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solver = near_solver(monkeypatch, 1.0)
    before = solver.replay(lives_of(7, 7, 6), landmark_classes(lives_of(7, 7, 6)))
    lives = lives_of(8, 7, 6)
    after = solver.update(lives, landmark_classes(lives))
    known = {name: mean for names, mean in zip(before.classes, before.landmark_mean, strict=True) for name in names}
    seen = {LandmarkName("v0", 0, n - 1) for n in lives[0].frames[7].variables[1:].tolist()}
    about = [not seen.isdisjoint(names) for names in after.classes]
    for names, mean, own in zip(after.classes, after.landmark_mean, about, strict=True):
        if not own:
            np.testing.assert_array_equal(mean, known[names[0]])
    rows = np.concatenate(
        [np.repeat(about, 2), np.repeat([(v, k) in (("v0", 7), ("v0", -1)) for v, _, k in after.poses], 3)]
    )
    step = np.linalg.solve(after.H[rows][:, rows].toarray(), gradient_at(after)[rows])
    assert np.abs(gradient_at(after)[~rows]).max() > 1.0  # what is elsewhere would like to follow
    assert step @ after.H[rows][:, rows] @ step < 1e-3


def gradient_at(solution: JointSolution) -> Floats:
    """Minus half the gradient of the whole cost at a solution's mean, by its rows."""
    system = solution.system
    X, count = system.at.X, 2 * len(solution.classes)
    g, numbers = np.zeros_like(X), np.arange(len(system.frames.start))
    z, chi, weight, turns = np.zeros(len(system.frames.mean)), *np.zeros((2, len(numbers))), np.zeros((len(numbers), 2))
    turns_into(turns, system.frames, numbers, X)
    evaluate_into(g, z, chi, weight, system.frames, numbers, X, turns)
    variable = system.variable
    return np.concatenate([g[variable[: count // 2], :2].ravel(), g[variable[count // 2 :]].ravel()])


def test_in_a_large_map_all_is_solved_once_enough_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_solver, "DISAGREEMENT", np.inf)
    solver = near_solver(monkeypatch, 0.5 / 20)  # none but the newest may wait
    solver.replay(lives_of(6, 7, 6), landmark_classes(lives_of(6, 7, 6)))
    off = []
    for counts in ((7, 7, 6), (8, 7, 6), (8, 8, 6)):
        lives = lives_of(*counts)
        classes = landmark_classes(lives)
        off.append(sigmas(solver.update(lives, classes), solve(lives, classes)))
    assert min(off[0], off[2]) > 1e-2
    assert off[1] <= 1e-2
    assert max(off) < 1.0


def test_in_a_large_map_all_is_solved_when_a_frame_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop closes: what is held is far off."""
    life, _ = loop(30, 0.1, 0)
    solver, early = near_solver(monkeypatch, 1.0), dataclasses.replace(life, frames=life.frames[:-2])
    solver.replay([early], classes_of(life, 2))
    assert sigmas(solver.update([life], classes_of(life)), solve([life], classes_of(life))) <= 1e-2


@given(st.lists(moments(), min_size=1, max_size=4))
@settings(settled, max_examples=8)
def test_a_tree_with_any_history_is_the_factor_of_the_dense_matrix(
    history: list[tuple[list[Life], Classes]],
) -> None:
    """Solutions and blocks of the inverse."""
    registry = Registry(Records())
    estimate = Estimate(registry)
    for lives, classes in history:
        estimate.follow(registry.register(lives, classes))
        at = estimate.settle(2)[1]
        tree = estimate.tree
        tree.relinearise(list(tree.pieces))
        tree.factor(registry.frames, at)
        pieces = list(tree.pieces.values())
        used = np.unique(np.concatenate([np.empty(0, np.int64), *(piece.variables for piece in pieces)]))
        if not len(used):
            continue
        rows = np.zeros(len(tree.size), np.int64)
        rows[used] = np.cumsum(tree.size[used]) - tree.size[used]
        n = int(tree.size[used].sum())
        own, members = np.array([piece[:3] for piece in pieces], np.int64), [piece.variables for piece in pieces]
        H = assembled(registry.frames, own, members, at, rows, tree.size, n).toarray()
        scale = np.sqrt(np.diag(np.linalg.inv(H)))
        g = np.random.default_rng(0).normal(size=n) / scale
        spread, x = np.zeros((len(tree.size), 3)), np.linalg.solve(H, g)
        for v in used.tolist():
            spread[v, : tree.size[v]] = g[rows[v] : rows[v] + tree.size[v]]
        found, blocks = tree.solve(spread), tree.inverse_blocks()
        P = np.linalg.inv(H)
        for v in used.tolist():
            k = slice(rows[v], rows[v] + tree.size[v])
            assert np.all(np.abs(found[v, : tree.size[v]] - x[k]) <= 1e-6 * scale[k])
            error = blocks[v, : tree.size[v], : tree.size[v]] - P[k, k]
            assert np.all(np.abs(error) <= 1e-7 * np.outer(scale[k], scale[k]))


@given(moments(), st.data())
@settings(settled, max_examples=15)
def test_a_joint_covariance_is_a_block_of_the_dense_inverse(
    moment: tuple[list[Life], Classes], data: st.DataObject
) -> None:
    lives, classes = moment
    if not any(life.frames for life in lives):
        return
    solver = JointSolver()
    solution = solver.replay(lives, classes)
    count, some = len(classes), partial(st.lists, max_size=5, unique=True)
    landmarks = np.array(data.draw(some(st.integers(0, count - 1))), np.int64)
    poses = np.array(data.draw(some(st.integers(0, len(solution.poses) - 1))), np.int64)
    if not len(landmarks) + len(poses):
        return
    found = solver.joint_covariance(solution, landmarks, poses)
    rows = [2 * count + 3 * p + a for p in poses for a in range(3)] + [2 * j + a for j in landmarks for a in range(2)]
    P = np.linalg.inv(solution.H.toarray())[np.ix_(rows, rows)]
    scale = np.sqrt(np.diag(P))
    assert np.all(np.abs(found - P) <= 0.05 * np.outer(scale, scale))  # frames are linearised where they were last


def test_only_the_nodes_above_a_frame_that_was_linearised_anew_are_redone() -> None:
    registry = Registry(Records())
    estimate = Estimate(registry)
    lives = [drive.life() for drive in drives()]
    estimate.follow(registry.register(lives, landmark_classes(lives)))
    at, tree = estimate.settle(20)[1], estimate.tree
    tree.factor(registry.frames, at)
    assert tree.factor(registry.frames, at) == 0
    nodes = tree.nodes()
    for leaf in (node for node in nodes if not node.children):
        above, node = 0, leaf
        while node.parent is not None:
            above, node = above + 1, node.parent
        tree.relinearise(leaf.pieces[:1])
        assert tree.factor(registry.frames, at) == above + 1
    assert above + 1 < len(nodes)


@given(st.lists(moments(), min_size=1, max_size=2), moments())
@settings(settled, max_examples=15)
def test_a_replay_depends_on_nothing_but_lives_and_classes(
    history: list[tuple[list[Life], Classes]], last: tuple[list[Life], Classes]
) -> None:
    """To the bit, whatever the solver has seen before."""
    used = JointSolver()
    for lives, classes in [*history, history[0]]:
        if any(life.frames for life in lives):
            used.update(lives, classes)
    if any(life.frames for life in last[0]):
        first, again = JointSolver().replay(*last), used.replay(*last)
        assert first.mean.tobytes() == again.mean.tobytes() == used.replay(*last).mean.tobytes()
        assert first.weight.tobytes() == again.weight.tobytes()
        assert np.array_equal(first.H.toarray(), again.H.toarray())


def contradicted(by_m: float) -> tuple[list[Life], Classes]:
    """All lives; the last frame of one has its first landmark elsewhere."""
    lives = [drive.life() for drive in drives()]
    frames = list(lives[1].frames)
    by = np.zeros(len(frames[-1].b))
    by[3] = by_m
    frames[-1] = moved(frames[-1], by)
    lives[1] = dataclasses.replace(lives[1], frames=tuple(frames))
    return lives, landmark_classes(lives)


@pytest.mark.parametrize("by_m", [1.0, 10.0])
def test_a_frame_that_contradicts_the_others_is_weighted_down_alone(by_m: float) -> None:
    clean, solution = solve(*contradicted(0.0)), solve(*contradicted(by_m))
    assert clean.weight.min() > 0.9
    down = {solution.frames[f] for f in np.flatnonzero(solution.weight < 0.9).tolist()}
    assert down == {("v1", 0, FRAMES - 1)}
    assert solution.weight.min() < 0.6
    n = 2 * len(solution.classes)
    assert np.max(np.abs(solution.mean[:n] - clean.mean[:n])) < 0.1 * by_m


def test_a_weight_is_hubers_and_the_joint_matrix_holds_the_frames_information_by_it() -> None:
    """H is the sum of w_f J_f' H_f J_f; the newest pose is in one frame only."""
    lives, classes = contradicted(1.0)
    solution, frame = solve(lives, classes), lives[1].frames[-1]
    f = solution.frames.index(("v1", 0, FRAMES - 1))
    limit = huber_limit(len(frame.b))
    np.testing.assert_allclose(solution.weight[f], np.sqrt(limit / solution.chi_square[f]))
    end = 2 * len(classes) + 3 * solution.poses.index(("v1", 0, -1))
    start = solution.pose_mean[solution.poses.index(("v1", 0, FRAMES - 1)), 2]
    turn = np.array([[np.cos(start), -np.sin(start)], [np.sin(start), np.cos(start)]])
    expected = solution.weight[f] * turn @ to_information(frame).H[:2, :2].toarray() @ turn.T
    np.testing.assert_allclose(solution.H[end : end + 2][:, end : end + 2].toarray(), expected, rtol=1e-9)


@pytest.mark.parametrize("seed", [2, 7, 11, 13])
def test_a_frame_of_each_vehicle_that_is_nonsense_does_not_keep_the_map_from_settling(seed: int) -> None:
    """Metres and turns off. With whole turns of headings chosen at each step these four did not settle."""
    rng = np.random.default_rng(seed)
    lives = []
    for drive in drives():
        life, f = drive.life(), int(rng.integers(FRAMES))
        delta = life.frames[f]
        b = delta.b + (1e4 / B_QUANTUM * rng.normal(size=len(delta.b))).astype(np.int64)
        frames = (*life.frames[:f], dataclasses.replace(delta, b=b), *life.frames[f + 1 :])
        lives.append(dataclasses.replace(life, frames=frames))
    assert np.count_nonzero(solve(lives, landmark_classes(lives)).weight < 0.5) >= 1


def test_single_frames_with_given_start_poses_are_never_weighted_down() -> None:
    """The paper's system is linear: two filters that contradict each other give their weighted mean."""
    lives = [drive.life(1) for drive in drives()[:1]] * 2
    lives[1] = dataclasses.replace(lives[1], vehicle="w", frames=(moved(lives[1].frames[0], np.full(
        len(lives[1].frames[0].b), 1.0)),))  # fmt: skip
    classes = landmark_classes(lives)
    solution, alone = solve(lives, classes), solve(lives[:1], landmark_classes(lives[:1]))
    other = solve(lives[1:], landmark_classes(lives[1:]))
    assert np.array_equal(solution.weight, [1.0, 1.0])
    assert solution.chi_square.max() > 5 * huber_limit(len(lives[0].frames[0].b))
    n = 2 * len(classes)
    marginal = [landmark_information(each) for each in (alone, other)]
    b = sum(H @ each.mean[:n] for H, each in zip(marginal, (alone, other), strict=True))
    np.testing.assert_allclose(solution.mean[:n], np.linalg.solve(marginal[0] + marginal[1], b), atol=1e-6)


def landmark_information(solution: JointSolution) -> Floats:
    n = 2 * len(solution.classes)
    return np.asarray(np.linalg.inv(np.linalg.inv(solution.H.toarray())[:n, :n]))


def loop(frames: int, heading_std_rad: float, seed: int) -> tuple[Life, Floats]:
    """A life that drives once round a circle and sees its first landmarks again; the landmarks by number."""
    rng = np.random.default_rng(seed)
    looks, radius = 5, 6.0
    angles = np.linspace(0.0, 2 * np.pi * (frames + 1) / frames, (frames + 1) * looks + 1)
    poses = np.column_stack([radius * np.sin(angles), radius * (1 - np.cos(angles)), angles])
    around = np.repeat(np.linspace(0.0, 2 * np.pi, 40, endpoint=False), 2)
    away = radius + np.tile([-0.7, 0.7], 40)
    landmarks = np.column_stack([away * np.sin(around), radius - away * np.cos(around)])
    number: dict[int, int] = {}
    deltas = []
    for f in range(frames + 1):
        H, z, seen = frame_information(poses[f * looks : (f + 1) * looks + 1], landmarks, rng)
        H = H.copy()
        z[2] += heading_std_rad * rng.normal()
        H[2, 2] += 1e-9
        for j in seen:
            number.setdefault(j, len(number))
        order = np.argsort([number[j] for j in seen])
        rows = np.concatenate([np.arange(3), (3 + 2 * order[:, None] + np.arange(2)).ravel()])
        variables = np.array([0, *(1 + number[seen[i]] for i in order)], np.int64)
        H = H[np.ix_(rows, rows)]
        H[2], H[:, 2], H[2, 2] = 0.0, 0.0, 1.0 / heading_std_rad**2
        deltas.append(quantised(variables, H, H @ z[rows], z[rows]))
    life = Life(
        vehicle="a", life=0, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)), frames=tuple(deltas),
        signatures=tuple(number),
    )  # fmt: skip
    return life, landmarks[list(number)]


@pytest.mark.parametrize("seed", range(4))
def test_a_loop_is_closed_from_far_off(seed: int) -> None:
    """Frames whose end heading is known to 0.1 rad put the end of the loop metres away."""
    life, landmarks = loop(30, 0.1, seed)
    open_end = solve([dataclasses.replace(life, frames=life.frames[:-2])], classes_of(life, 2))
    closed = solve([life], classes_of(life))
    assert np.linalg.norm(open_end.pose_mean[-1, :2]) > 1.0
    error = closed.landmark_mean - landmarks[[names[0].number for names in closed.classes]]
    assert landmark_chi_square(closed, error) / error.size < 3.0


def classes_of(life: Life, without: int = 0) -> Classes:
    return landmark_classes([dataclasses.replace(life, frames=life.frames[: len(life.frames) - without])])


def wrong(what: str) -> tuple[Sequence[Life], Classes]:
    life = drives()[0].life(2)
    classes = landmark_classes([life])
    if what == "nothing":
        return [dataclasses.replace(life, frames=())], ()
    if what == "no pose":
        nothing = dataclasses.replace(life, frames=(life.frames[0], FrameDelta.nothing()))
        return [nothing], classes
    if what == "indefinite":
        H = life.frames[1].H.copy()
        H[0] = -H[0]
        return [dataclasses.replace(life, frames=(life.frames[0], dataclasses.replace(life.frames[1], H=H)))], classes
    return [life], (*classes, (LandmarkName("v0", 0, len(life.signatures) - 1),))


@pytest.mark.parametrize(
    ("what", "text"),
    [
        ("nothing", "no vehicle has contributed"),
        ("no pose", "frame 1 of v0: .* no information about its pose"),
        ("indefinite", "frame 1 of v0: .* not positive definite: a delta is missing or wrong"),
        ("idle", "1 landmarks or poses are in no frame"),
    ],
)
def test_what_cannot_be_solved_says_why_and_leaves_the_solver_usable(what: str, text: str) -> None:
    solver, life = JointSolver(), drives()[0].life(3)
    classes = landmark_classes([life])
    before = solver.replay([life], classes)
    for call in (solver.update, solver.replay):
        with pytest.raises(NumericalError, match=text):
            call(*wrong(what))
    np.testing.assert_allclose(solver.update([life], classes).mean, before.mean, atol=1e-6)


def test_a_landmark_in_no_class_is_refused() -> None:
    life = drives()[0].life(3)
    with pytest.raises(ValueError, match="frame 0 of v0 has a landmark that is in no class"):
        solve([life], landmark_classes([life])[1:])
