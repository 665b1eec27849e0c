"""The kinds of filter and their options, each against the obvious dense computation."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif import seif_arrays
from fleet_seif import seif_step as kernels
from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.errors import ReadingRefused
from fleet_seif.information import FrameTotal, delta_digest
from fleet_seif.local_updates import KL, NORMALISED, RAW, forget_pose_into, link_strengths, sparsify_into, weakest_links
from fleet_seif.messages import Epoch
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats, Sightings
from fleet_seif.seif import Seif
from tests import reference
from tests.drives import Drive, drive, reading, square
from tests.strategies import settled, spd, vectors
from vehicles.core import Identity, VehicleCore

OPEN = {"gate": 1e300}
LANDMARKS = 4
N = 3 + 2 * LANDMARKS


def run(settings: FilterSettings, log: Drive, model: int = RANGE_BEARING) -> Seif:
    seif = Seif(settings, model)
    seif.start(log.start)
    for each in log.readings:
        seif.step(each)
    return seif


def corridor(length: int) -> Drive:
    """Straight ahead, a landmark on either side every metre, those within 2.5 m in view."""
    places = np.column_stack([np.repeat(np.arange(length), 2), np.tile([0.7, -0.7], length)]).astype(float)
    rng = np.random.default_rng(5)

    def look(k: int) -> Sightings:
        near = np.flatnonzero(np.abs(places[:, 0] - k) < 2.5)
        z = np.array([reference.expected(RANGE_BEARING, np.array([k, 0.0, 0.0]), y) for y in places[near]])
        cov = np.tile(np.diag([1e-4, 4e-4]), (len(near), 1, 1))
        return Sightings(z=z + rng.normal(size=z.shape) * [0.01, 0.02], cov=cov, signature=near)

    readings = tuple(reading(float(k), look(k), (1.0, 0.0, 0.0)) for k in range(1, length))
    return Drive(np.zeros(3), look(0), readings, np.zeros((0, 3)))


def dense(seif: Seif) -> tuple[Floats, Floats]:
    H, b = seif.information()
    return H.toarray(), b


# Strength of a link.


@given(spd(N))
@settled
def test_the_cost_of_a_link_is_the_information_that_pose_and_landmark_share_given_the_others(H: Floats) -> None:
    """Mutual information by the definition, from conditional covariances: 1/2 log (|P_x| |P_a| / |P_xa|)."""
    H = (H + H.T) / 2
    strength = link_strengths(H, KL)
    for i in range(LANDMARKS):
        rows = [0, 1, 2, 3 + 2 * i, 4 + 2 * i]
        P = np.linalg.inv(H[np.ix_(rows, rows)])
        determinant = [np.linalg.det(P[:3, :3]), np.linalg.det(P[3:, 3:]), np.linalg.det(P)]
        expected = 0.5 * np.log(determinant[0] * determinant[1] / determinant[2])
        assert abs(strength[i] - expected) < 1e-6 * max(1.0, abs(expected))


@given(spd(N))
@settled
def test_the_raw_strength_is_the_sum_of_squares_and_the_normalised_one_has_no_unit(H: Floats) -> None:
    H = (H + H.T) / 2
    raw, normalised = link_strengths(H, RAW), link_strengths(H, NORMALISED)
    scale = np.array([1.0, 1.0, 100.0, *[10.0] * (2 * LANDMARKS)])
    scaled = H * np.outer(scale, scale)
    for i in range(LANDMARKS):
        assert np.isclose(raw[i], np.sum(H[:3, 3 + 2 * i : 5 + 2 * i] ** 2), rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(link_strengths(scaled, NORMALISED), normalised, rtol=1e-9)


def test_a_landmark_without_a_link_has_no_strength_and_is_never_cut() -> None:
    H = np.eye(N)
    H[0, 3] = H[3, 0] = 0.5
    for measure in (NORMALISED, RAW, KL):
        strength = link_strengths(H, measure)
        assert strength[0] > 0.0
        assert not np.any(strength[1:])
        assert weakest_links(strength, 0).tolist() == [0]


# Soft sparsification.


@given(spd(N), vectors(N, 3.0), vectors(N, 1.0), st.floats(0.05, 1.0))
@settled
def test_soft_sparsification_is_the_mixture_of_before_and_after(
    H: Floats, mu: Floats, residual: Floats, rho: float
) -> None:
    H = (H + H.T) / 2
    b = H @ mu + residual
    hard_H, hard_b = reference.sparsified(H, b, mu, [3, 4, 5, 6], [7, 8, 9, 10])
    soft_H, soft_b = H.copy(), b.copy()
    assert sparsify_into(soft_H, soft_b, mu, np.array([2, 3]), rho)
    scale = np.max(np.abs(H))
    np.testing.assert_allclose(soft_H, (1 - rho) * H + rho * hard_H, atol=1e-9 * scale)
    np.testing.assert_allclose(soft_b, (1 - rho) * b + rho * hard_b, atol=1e-8 * scale)
    assert np.array_equal(soft_H, soft_H.T)
    assert np.linalg.eigvalsh(soft_H)[0] > 0.0


def test_weakened_links_are_cut_in_the_end_and_their_number_stays_bounded() -> None:
    log = drive(square(25, 5.0, 7), steps=300, seed=8)
    soft = Seif(FilterSettings(active_max=4, soften=0.5))
    most = max([soft.start(log.start).active, *(soft.step(each).active for each in log.readings)])
    assert 4 < most < 25
    H, _ = dense(soft)
    assert np.linalg.eigvalsh(H)[0] > 0.0


# Exactly sparse: the pose is forgotten and found again.


@given(spd(N), vectors(N, 3.0))
@settled
def test_forgetting_the_pose_keeps_the_marginal_of_the_map(H: Floats, b: Floats) -> None:
    H = (H + H.T) / 2
    P, mean = np.linalg.inv(H), np.linalg.solve(H, b)
    assert forget_pose_into(H, b, RANGE_BEARING)
    assert not np.any(H[:3])
    assert not np.any(b[:3])
    scale = np.max(np.abs(H))
    np.testing.assert_allclose(H[3:, 3:], np.linalg.inv(P[3:, 3:]), atol=1e-8 * scale)
    np.testing.assert_allclose(b[3:], H[3:, 3:] @ mean[3:], atol=1e-7 * scale * max(1.0, np.max(np.abs(mean))))


def test_with_a_compass_the_heading_is_kept_and_a_linked_one_is_not_forgotten() -> None:
    H = np.diag(np.arange(1.0, N + 1))
    H[0, 3] = H[3, 0] = 0.5
    b = np.arange(float(N))
    linked = H.copy()
    linked[2, 3] = linked[3, 2] = 0.1
    assert not forget_pose_into(linked, b.copy(), COMPASS_XY)
    assert forget_pose_into(H, b, COMPASS_XY)
    assert (H[2, 2], b[2]) == (3.0, 2.0)
    assert not np.any(H[:2])


class DenseEseif(reference.DenseEif):
    """ESEIF in its plainest form: dense, in long double, the sightings it holds back chosen by the same rule."""

    def __init__(self, model: int, start_information: float, active_max: int) -> None:
        super().__init__(model, start_information)
        self.active_max = active_max
        self.forgotten = 0

    def see(self, seen: Sightings) -> None:
        known = list(self._at)
        scale = np.sqrt(np.diag(self.H))
        strength = np.abs(self.H) / np.outer(scale, scale)
        linked = {s for s, at in self._at.items() if np.any(strength[:3, at : at + 2] > 1e-14)}
        held: list[int] = []
        if len(linked | set(seen.signature.tolist())) > self.active_max:
            for s in seen.signature.tolist():
                if s in known and s not in held and len(held) < self.active_max:
                    held.append(s)
        rows = 2 if self.model == COMPASS_XY else 3
        if len(held) < rows - 1:
            super().see(seen)
            return
        now = np.array([s not in held for s in seen.signature.tolist()], bool)
        before = self.mu
        super().see(Sightings(z=seen.z[now], cov=seen.cov[now], signature=seen.signature[now]))
        first = {s: z for s, z in reversed(list(zip(seen.signature.tolist(), seen.z, strict=True))) if s not in known}
        mu = np.concatenate(
            [before, *(reference.placed(self.model, before[:3], first[s]) for s in self._at if s in first)]
        )
        at = [self._at[s] for s in seen.signature[~now].tolist()]
        everything = reference.measurement_update(self.H, self.b, mu, self.model, seen.z[~now], seen.cov[~now], at)
        self.mu = reference.solve(*everything).astype(float)
        self.forgotten += 1
        W = self.H[:, :rows].copy()
        X = reference.solve(W[:rows], np.column_stack([W.T, self.b[:rows]]))
        self.b = self.b - W @ X[:, -1]
        self.H = self.H - W @ X[:, :-1]
        self.H[:rows] = self.H[:, :rows] = 0.0
        self.b[:rows] = 0.0
        super().see(Sightings(z=seen.z[~now], cov=seen.cov[~now], signature=seen.signature[~now]))


@pytest.mark.parametrize("model", [COMPASS_XY, RANGE_BEARING])
def test_eseif_is_the_dense_filter_that_forgets_its_pose(model: int) -> None:
    """The filter solves for the block given the rest, the dense one for everything: with range and bearing they
    linearise alike only where the block is the whole map, so there everything is in view."""
    if model == COMPASS_XY:
        log, active_max = drive(square(25, 5.0, 7), steps=150, seed=8, model=model), 4
    else:
        log, active_max = drive(square(9, 2.5, 7), steps=150, seed=8, range_m=9.0, most=9), 6
    seif = Seif(FilterSettings(kind="eseif", active_max=active_max, mean="exact", **OPEN), model)
    plain = DenseEseif(model, seif.settings.start_information, active_max)
    seif.start(log.start)
    plain.see(log.start)
    for each in log.readings:
        seif.step(each)
        plain.step(each)
    assert plain.forgotten > 20
    H, _ = dense(seif)
    scale = np.sqrt(np.diag(plain.H)).astype(float)
    assert np.max(np.abs(H - plain.H) / np.outer(scale, scale)) < 1e-5
    sigma = np.sqrt(np.diag(np.linalg.inv(plain.H.astype(float))))
    assert np.max(np.abs(seif.mean() - plain.mu) / sigma) < 1e-3


def test_eseif_is_never_more_confident_than_the_filter_that_forgets_nothing() -> None:
    """In the linear world both linearise alike: H of the one minus H of the other has no negative eigenvalue."""
    log = drive(square(25, 5.0, 7), steps=150, seed=8, model=COMPASS_XY)
    exact = Seif(FilterSettings(kind="eif", **OPEN), COMPASS_XY)
    sparse = Seif(FilterSettings(kind="eseif", active_max=4, **OPEN), COMPASS_XY)
    for each in (exact, sparse):
        each.start(log.start)
    lost = 0.0
    for step in log.readings:
        exact.step(step)
        sparse.step(step)
        less, more = dense(sparse)[0], dense(exact)[0]
        scale = 1.0 / np.sqrt(np.diag(more))
        values = np.linalg.eigvalsh((more - less) * np.outer(scale, scale))
        assert values[0] > -1e-9
        lost = max(lost, values[-1])
    assert lost > 1e-3


@pytest.mark.parametrize("model", [RANGE_BEARING, COMPASS_XY])
def test_eseif_keeps_its_bound_where_landmarks_are_in_view_and_says_where_it_does_not(model: int) -> None:
    log = drive(square(40, 4.0, 3), steps=200, seed=4, model=model)
    seif = Seif(FilterSettings(kind="eseif", active_max=5, **OPEN), model)
    seif.start(log.start)
    beyond = 0
    for each in log.readings:
        known = set(seif.signatures)
        result = seif.step(each)
        in_view = len(known & set(each.sightings.signature.tolist()))
        assert result.active == len(seif.active)
        assert result.active <= 5 or in_view < (2 if model == RANGE_BEARING else 1)
        beyond += result.active > 5
    blind = seif.step(reading(999.0, Sightings.none()))
    assert blind.active <= 5


def test_eseif_yields_where_it_sees_new_landmarks_only() -> None:
    log = drive(square(40, 4.0, 3), steps=3, seed=4)
    seif = Seif(FilterSettings(kind="eseif", active_max=1, **OPEN))
    result = seif.start(log.start)
    assert result.active == len(log.start.z) > 1


def test_a_vehicle_counts_the_steps_after_which_its_bound_did_not_hold() -> None:
    """ESEIF cannot find its pose again from landmarks that it has never seen."""
    identity = Identity(
        fleet="f", vehicle="v", epoch=Epoch(1, 1), start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3))
    )
    core = VehicleCore(identity, FilterSettings(kind="eseif", active_max=1), PublishSettings())
    assert core.start(0.0, drive(square(40, 4.0, 3), steps=0, seed=4).start).active > 1
    assert core.counters.steps_beyond_active_max == 1


# Mean and covariances on request.


def test_recovering_solves_the_whole_map_and_leaves_nothing_waiting() -> None:
    seif = run(FilterSettings(active_max=4), drive(square(40, 5.0, 7), steps=200, seed=8))
    H, b = dense(seif)
    assert np.max(np.abs(H @ seif.mean() - b)) > 1e-6 * np.max(np.abs(b))
    seif.recover()
    np.testing.assert_allclose(seif.mean(), np.linalg.solve(H, b), atol=1e-9)
    assert seif.waiting == 0


def test_with_the_exact_mean_the_mean_is_exact_after_every_step() -> None:
    log = drive(square(25, 5.0, 7), steps=40, seed=8)
    seif = Seif(FilterSettings(active_max=4, mean="exact"))
    seif.start(log.start)
    for each in log.readings:
        seif.step(each)
        H, b = dense(seif)
        np.testing.assert_allclose(seif.mean(), np.linalg.solve(H, b), atol=1e-9)


def test_what_waits_is_worked_off_in_steps_that_change_nothing_until_the_mean_is_close_to_exact() -> None:
    """After loops the queue is long; a vehicle that sees nothing any more relaxes on."""
    seif = run(FilterSettings(active_max=4, relax_others=2), drive(square(40, 5.0, 7), steps=200, seed=8))
    H, b = dense(seif)
    sigma = np.sqrt(np.diag(np.linalg.inv(H)))[3:]
    off = np.abs(seif.mean() - np.linalg.solve(H, b))[3:] / sigma
    assert seif.waiting > 10
    for k in range(400):
        seif.step(reading(1000.0 + k, Sightings.none()))
        if not seif.waiting:
            break
    H, b = dense(seif)
    exact = np.linalg.solve(H, b)
    settled_off = np.abs(seif.mean() - exact)[3:] / sigma
    assert seif.waiting == 0
    assert np.max(settled_off) < max(0.5 * np.max(off), 0.3)


@pytest.mark.parametrize("kind", ["seif", "eif", "eseif"])
def test_a_covariance_is_a_block_of_the_dense_inverse(kind: str) -> None:
    seif = run(FilterSettings.model_validate({"kind": kind}), drive(square(25, 5.0, 7), steps=100, seed=8))
    P = np.linalg.inv(dense(seif)[0])
    rows = [0, 1, 2, 11, 12, 3, 4]
    np.testing.assert_allclose(seif.covariance_of([4, 0]), P[np.ix_(rows, rows)], rtol=1e-8, atol=1e-14)


def test_a_covariance_from_the_neighbourhood_is_its_dense_conditional_and_at_most_the_exact_one() -> None:
    seif = run(FilterSettings(active_max=4), corridor(80))
    H, _ = dense(seif)
    linked = {
        y: {o for o in range(len(seif.landmarks)) if np.any(H[3 + 2 * y : 5 + 2 * y, 3 + 2 * o : 5 + 2 * o])}
        for y in range(len(seif.landmarks))
    }
    apart = 0
    for number in range(len(seif.landmarks)):
        blanket = set(seif.active.tolist()) | linked[number] | {number}
        got = seif.blanket_covariance([number])
        assert np.linalg.eigvalsh(seif.covariance_of([number]) - got)[0] > -1e-9 * np.max(np.abs(got))
        if not linked[number] & set(seif.active.tolist()):
            apart += 1  # the path between them belongs to it too
            assert np.linalg.norm(got[:3, 3:]) > 0.0
            continue
        ids = sorted(blanket)
        rows = [0, 1, 2, *(3 + 2 * y + axis for y in ids for axis in (0, 1))]
        own = [0, 1, 2, *(3 + 2 * ids.index(number) + axis for axis in (0, 1))]
        expected = np.linalg.inv(H[np.ix_(rows, rows)])[np.ix_(own, own)]
        np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-13)
    assert apart > 0


def neighbours(seif: Seif) -> dict[int, set[int]]:
    """Of each landmark, by the blocks of H that are not zero."""
    H, _ = dense(seif)
    rows = [slice(3 + 2 * y, 5 + 2 * y) for y in range(len(seif.landmarks))]
    return {a: {b for b in range(len(rows)) if b != a and np.any(H[rows[a], rows[b]])} for a in range(len(rows))}


def links_between(linked: dict[int, set[int]], start: int, ends: set[int], within: set[int]) -> int:
    """Links on a shortest way from a landmark to one of `ends`."""
    front, links = {start}, 0
    while not front & ends:
        front |= {b for a in front for b in linked[a]} & within
        links += 1
        assert links <= len(linked), "there is no way"
    return links


FAR_APART = ([59], [40, 41, 44], [0, 1, 2, 3], [20, 3, 58], [7, 6, 30, 31, 57])


@pytest.mark.parametrize("numbers", FAR_APART)
def test_the_neighbourhood_of_several_landmarks_is_theirs_and_shortest_paths_between(numbers: list[int]) -> None:
    seif = run(FilterSettings(active_max=4), corridor(30))
    linked, before = neighbours(seif), set(seif.active.tolist())
    for k, number in enumerate(numbers):
        after = set(kernels.blanket(seif._s, np.array(numbers[: k + 1])).tolist())
        own, links = {number} | linked[number], links_between(linked, number, before, set(linked))
        assert before | own <= after
        assert len(after - before - own) == max(links - 2, 0)
        assert links_between(linked, number, before, after) == links
        before = after


@pytest.mark.parametrize("numbers", FAR_APART)
def test_a_joint_covariance_from_the_neighbourhood_is_the_dense_one_given_the_rest_of_the_map(
    numbers: list[int],
) -> None:
    seif = run(FilterSettings(active_max=4), corridor(30))
    P, blanket = np.linalg.inv(dense(seif)[0]), kernels.blanket(seif._s, np.array(numbers)).tolist()
    rows = [0, 1, 2, *(3 + 2 * y + axis for y in blanket for axis in (0, 1))]
    rest = np.setdiff1d(np.arange(len(P)), rows)
    given_rest = P[np.ix_(rows, rows)] - P[np.ix_(rows, rest)] @ np.linalg.solve(
        P[np.ix_(rest, rest)], P[np.ix_(rest, rows)]
    )
    own = [0, 1, 2, *(rows.index(3 + 2 * y + axis) for y in numbers for axis in (0, 1))]
    got = seif.blanket_covariance(numbers)
    np.testing.assert_allclose(got, given_rest[np.ix_(own, own)], rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(seif.covariance_of(numbers) - got)[0] > -1e-9 * np.max(np.abs(got))


def test_the_neighbourhood_does_not_grow_with_the_map() -> None:
    """Landmarks around the pose at the end of a way that is four times as long."""
    sizes = []
    for length in (20, 80):
        seif = run(FilterSettings(active_max=4), corridor(length))
        near = np.argsort(np.hypot(*(seif.landmarks - seif.pose[:2]).T))[:8]
        sizes.append(len(kernels.blanket(seif._s, near)))
    assert sizes[0] == sizes[1] < 20


# Limits.


def test_a_landmark_beyond_the_limit_is_refused_and_leaves_the_filter_as_it_was() -> None:
    log = drive(square(40, 4.0, 3), steps=50, seed=4)
    seif = Seif(FilterSettings(landmarks_max=8))
    seif.start(log.start)
    wide = drive(square(40, 4.0, 3), steps=0, seed=5, range_m=9.0, most=9).start
    before = seif.state()
    with pytest.raises(ReadingRefused, match=r"landmarks_max in \[filter\] is 8"):
        seif.step(reading(1.0, wide))
    assert seif.state() == before


def test_a_landmark_with_all_the_neighbours_it_may_have_takes_no_more_and_the_vehicle_goes_on() -> None:
    log = drive(square(60, 4.0, 3), steps=300, seed=4)
    seif = Seif(FilterSettings(active_max=4, neighbours_max=12))
    seif.start(log.start)
    refused = sum(seif.step(each).refused for each in log.readings)
    H, _ = dense(seif)
    assert refused > 10
    assert int(seif._s.counts[seif_arrays.DEGREE_MAX]) <= 12 + 4 + 5
    assert np.linalg.eigvalsh(H)[0] > 0.0
    truth = np.array([reference.seen_from(log.start_pose, y) for y in square(60, 4.0, 3)])
    known = [(9000 - s) // 7 for s in seif.signatures]
    assert np.median(np.hypot(*(seif.landmarks - truth[known]).T)) < 0.1


@pytest.mark.parametrize("kind", ["seif", "eif", "eseif"])
@pytest.mark.parametrize("soften", [1.0, 0.3])
def test_a_filter_goes_on_from_its_state_to_the_bit(kind: str, soften: float) -> None:
    log = drive(square(25, 5.0, 7), steps=120, seed=8)
    settings = FilterSettings.model_validate({"kind": kind, "soften": soften, "active_max": 4})
    whole, begun = run(settings, log), run(settings, dataclasses.replace(log, readings=log.readings[:60]))
    resumed = Seif(settings)
    resumed.restore(begun.state())
    for each in log.readings[60:]:
        resumed.step(each)
    assert resumed.state() == whole.state()
    assert delta_digest(resumed.published()) == delta_digest(whole.published())


@pytest.mark.parametrize("kind", ["seif", "eif", "eseif"])
@pytest.mark.parametrize("strength", ["normalised", "raw", "kl"])
def test_the_sum_of_the_deltas_is_what_every_kind_holds(kind: str, strength: str) -> None:
    log = drive(square(15, 4.0, 7), steps=80, seed=8)
    seif = Seif(FilterSettings.model_validate({"kind": kind, "strength": strength, "soften": 0.5, "active_max": 3}))
    total = FrameTotal()
    total.add(seif.start(log.start).delta)
    for each in log.readings:
        total.add(seif.step(each).delta)
    assert delta_digest(total.delta()) == delta_digest(seif.published())
    assert np.linalg.eigvalsh(dense(seif)[0])[0] > 0.0


def test_no_step_leaves_a_mark_in_the_scratch() -> None:
    seif = run(FilterSettings(active_max=4), drive(square(40, 5.0, 7), steps=50, seed=8))
    seif.blanket_covariance([0, 7, 12])
    assert not np.any(seif._s.local[:100])
    assert kernels.block_ids(np.array([3, 5]), np.array([4, 3, 9])).tolist() == [3, 4, 5, 9]
