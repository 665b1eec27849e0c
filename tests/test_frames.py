"""A filter cut into frames: what it publishes, against the rules of the ledger, the batch and a run without a break."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from fleet_seif import frame_log
from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.errors import NumericalError
from fleet_seif.frames import FramedFilter
from fleet_seif.information import FrameDelta, FrameTotal, delta_digest, to_information
from fleet_seif.joint import Life, landmark_classes, solve
from fleet_seif.messages import Epoch, FramePart, FrameStatus
from fleet_seif.records import Reading, Sightings
from fleet_seif.wire import decode_message, encode_message, encode_snapshot
from fusion.ledger import Ledger, Receipt
from tests import reference
from tests.drives import FLEET, Drive, drive, landmark_of, put, reading, square
from vehicles.core import Identity, VehicleCore

ADAPTIVE = FilterSettings(frames="adaptive", frame_steps_max=12, active_max=5, close_lag_steps=3)
LOG = drive(square(25, 5.0, 7), steps=130, seed=8)


def run(settings: FilterSettings, log: Drive) -> tuple[FramedFilter, list[tuple[FramePart, ...]]]:
    """A filter after a whole run, and the parts of each message."""
    framed = FramedFilter(settings)
    said = [framed.start(log.start)[1], *(framed.step(each)[1] for each in log.readings)]
    said.append(framed.end())
    framed.localise()
    return framed, said


def sums(said: Sequence[Sequence[FramePart]]) -> list[FrameDelta]:
    totals: dict[int, FrameTotal] = {}
    for parts in said:
        for part in parts:
            totals.setdefault(part.frame, FrameTotal()).add(part.delta)
    return [totals[frame].delta() for frame in sorted(totals)]


def vehicle(settings: FilterSettings) -> VehicleCore:
    identity = Identity(
        fleet=FLEET, vehicle="ann", epoch=Epoch(1, 7), start_pose=LOG.start_pose, start_pose_cov=np.zeros((3, 3))
    )
    return VehicleCore(identity, settings, PublishSettings(window=10_000))


def driven(settings: FilterSettings) -> VehicleCore:
    core = vehicle(settings)
    core.start(0.0, LOG.start)
    for each in LOG.readings:
        core.step(each)
    core.end()
    return core


def test_with_a_single_frame_every_step_goes_on_with_it_and_the_end_ends_it() -> None:
    framed, said = run(FilterSettings(frames="single"), LOG)
    assert [part.status for parts in said for part in parts] == [
        FrameStatus.OPENED, *[FrameStatus.CONTINUED] * len(LOG.readings), FrameStatus.ENDED
    ]  # fmt: skip
    assert {part.frame for parts in said for part in parts} == {0}
    assert delta_digest(sums(said)[0]) == delta_digest(framed.filter.published())


def test_frames_follow_each_other_and_each_is_corrected_a_fixed_number_of_steps_after_it_closed() -> None:
    _, said = run(ADAPTIVE, LOG)
    ended = {p.frame: k for k, parts in enumerate(said) for p in parts if p.status is FrameStatus.ENDED}
    corrected = {p.frame: k for k, parts in enumerate(said) for p in parts if p.status is FrameStatus.CORRECTED}
    opened = {p.frame: k for k, parts in enumerate(said) for p in parts if p.status is FrameStatus.OPENED}
    last = len(said) - 1
    assert sorted(ended) == sorted(corrected) == sorted(opened) == list(range(len(ended)))
    assert len(ended) > 8
    for frame, k in ended.items():
        assert corrected[frame] == min(k + 3, last)
        assert opened[frame] == (ended[frame - 1] + 1 if frame else 0)


def test_what_is_published_adds_up_to_what_the_filter_says_it_has_published() -> None:
    framed, said = run(ADAPTIVE, LOG)
    assert [delta_digest(a) for a in sums(said)] == [delta_digest(b) for b in framed.published()]


def test_the_ledger_takes_every_message_and_every_frame_is_positive_definite() -> None:
    ledger = Ledger(FLEET)
    for data in put(driven(ADAPTIVE)):
        receipt, stream = ledger.accept(data)
        assert receipt is Receipt.FOLDED
        assert stream.fault is None
    assert stream.ended
    for life in ledger.lives():
        for frame in life.frames:
            assert np.linalg.eigvalsh(to_information(frame).H.toarray())[0] > 0.0


def test_the_map_of_the_frames_is_nearer_to_the_truth_than_that_of_a_single_one() -> None:
    """Odometry with 0.1 rad a step: linearised once, in one frame, it is overconfident."""
    truth = np.array([reference.seen_from(LOG.start_pose, y) for y in square(25, 5.0, 7)])
    rng = np.random.default_rng(3)
    noisy = tuple(
        dataclasses.replace(
            each, odometry=each.odometry + [0.0, 0.0, 0.1] * rng.standard_normal(3),
            odometry_cov=each.odometry_cov + np.diag([0.0, 0.0, 0.01]),
        )
        for each in LOG.readings
    )  # fmt: skip
    log = dataclasses.replace(LOG, readings=noisy)
    errors = {}
    for settings in (ADAPTIVE, ADAPTIVE.model_copy(update={"frames": "single"})):
        framed, _ = run(settings, log)
        off = framed.landmarks - truth[[landmark_of(s) for s in framed.signatures]]
        errors[settings.frames] = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    assert errors["adaptive"] < errors["single"]


def test_landmark_numbers_go_on_from_frame_to_frame() -> None:
    framed = FramedFilter(ADAPTIVE)
    results = [framed.start(LOG.start)[0], *(framed.step(each)[0] for each in LOG.readings)]
    named = [signature for result in results for signature in result.new]
    assert named == framed.signatures
    assert len(set(named)) == len(named)
    assert [r.first_new for r in results] == [sum(len(q.new) for q in results[:k]) for k in range(len(results))]
    for result in results:
        assert np.all(result.delta.variables <= len(framed.signatures))


@pytest.mark.parametrize("at", [0, 1, 11, 12, 13, 14, 15, 40, 129])
def test_it_goes_on_from_its_state_to_the_bit(at: int) -> None:
    whole, said = run(ADAPTIVE, LOG)
    begun = FramedFilter(ADAPTIVE)
    begun.start(LOG.start)
    for each in LOG.readings[:at]:
        begun.step(each)
    resumed = FramedFilter(ADAPTIVE)
    resumed.restore(begun.state())
    rest = [*(resumed.step(each)[1] for each in LOG.readings[at:]), resumed.end()]
    assert [[(p.frame, p.status, delta_digest(p.delta)) for p in parts] for parts in rest] == [
        [(p.frame, p.status, delta_digest(p.delta)) for p in parts] for parts in said[at + 1 :]
    ]
    assert resumed.state() == whole.state()


def test_where_the_batch_fails_the_filters_posterior_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*arguments: object, **options: object) -> None:
        raise NumericalError("no")

    monkeypatch.setattr(frame_log, "solve_frame", fails)
    framed, said = run(ADAPTIVE, LOG)
    assert not any(part.status is FrameStatus.CORRECTED for parts in said for part in parts)
    life = Life(
        vehicle="v", life=0, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)), frames=framed.published(),
        signatures=tuple(framed.signatures),
    )  # fmt: skip
    solve([life], landmark_classes([life]))


def test_a_frame_of_one_step_is_opened_and_ended_by_one_message() -> None:
    core = driven(ADAPTIVE.model_copy(update={"frame_steps_max": 1}))
    ledger = Ledger(FLEET)
    for data in put(core):
        assert ledger.accept(data)[0] is Receipt.FOLDED
        assert encode_message(decode_message(data)) == data
    assert len(ledger.lives()[0].frames) == len(LOG.readings)


@pytest.mark.parametrize("limit", [{"frame_landmarks_max": 6}, {"frame_heading_std_max_rad": 0.02}])
def test_a_frame_also_closes_at_its_other_limits(limit: dict[str, float]) -> None:
    framed, said = run(ADAPTIVE.model_copy(update={"frame_steps_max": 1000, **limit}), LOG)
    assert len(framed.ends) > 3
    for frame in sums(said):
        assert len(frame.variables) <= 6 + 5 + 1 or "frame_landmarks_max" not in limit


def test_a_snapshot_of_several_frames_is_what_its_messages_leave_behind() -> None:
    core, ledger = driven(ADAPTIVE), Ledger(FLEET)
    compared = 0
    for k, data in enumerate(put(core)):
        _, stream = ledger.accept(data)
        assert core.outbox.acknowledge("hub", k, stream.prefix_digest)
        if stream.checked == k:
            snapshot = core.outbox.snapshot(core.filter.published, core.filter.signatures)
            assert snapshot is not None
            other = Ledger(FLEET)
            assert other.accept(encode_snapshot(snapshot))[0] is Receipt.FOLDED
            assert (other.map_digest(), other.ledger_digest()) == (ledger.map_digest(), ledger.ledger_digest())
            compared += 1
    assert compared > 20


def test_a_refused_reading_changes_nothing_in_any_frame() -> None:
    framed = FramedFilter(ADAPTIVE)
    framed.start(LOG.start)
    for each in LOG.readings[:20]:
        framed.step(each)
    before = framed.state()
    bad: Reading = dataclasses.replace(reading(1.0, Sightings.none()), odometry_cov=np.zeros((3, 3)))
    with pytest.raises(Exception, match="odometry_cov"):
        framed.step(bad)
    assert framed.state() == before
