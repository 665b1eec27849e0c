"""What one life adds up to: messages wholly or not at all, the rules, and what has been checked."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.information import H_QUANTUM, FrameDelta, delta_digest, to_information
from fleet_seif.messages import DeltaMessage, FrameStatus
from fleet_seif.streams import Coalescer, is_check_point
from fusion.life import Checked, LifeTotal
from tests import strategies
from tests.histories import CONTINUED, CORRECTED, ENDED, HELLO, HONEST, MAIN, OPENED, instead, part
from tests.reference import summed
from tests.strategies import STEP_INFORMATION, STRONG, pose_block, settled


def state(life: LifeTotal) -> object:
    """All that is known of a life, as values."""
    frames = {
        number: (delta_digest(frame.total.delta()), None if frame.end_pose is None else frame.end_pose.tobytes())
        for number, frame in life.frames.items()
    }
    checked = {number: delta_digest(delta) for number, delta in life.checked.frames.items()}
    return frames, tuple(life.signatures), life.healthy, life.hello, checked, life.checked.names, life.checked.healthy


def lived(messages: list[DeltaMessage]) -> LifeTotal:
    life = LifeTotal()
    assert [life.fold(message) for message in messages] == [None] * len(messages)
    return life


@given(strategies.streams())
@settled
def test_frames_are_the_sums_of_their_deltas(messages: list[DeltaMessage]) -> None:
    life = lived(messages)
    for number, frame in life.frames.items():
        parts = [p for m in messages for p in m.parts if p.frame == number]
        total = frame.total.delta()
        H, _ = summed([p.delta for p in parts])
        got, _ = summed([total])
        assert {k: v.tolist() for k, v in got.items()} == {k: v.tolist() for k, v in H.items() if v.any()}
        ends = [p.end_pose for p in parts if p.end_pose is not None]
        assert (frame.end_pose is None) == (not ends)
        if ends:
            assert np.array_equal(frame.end_pose, ends[-1])  # type: ignore[arg-type]
    assert life.signatures == [signature for m in messages for _, signature in m.landmarks]


@given(strategies.streams())
@settled
def test_what_is_checked_is_the_sum_at_the_last_check_point_and_positive_definite(messages: list[DeltaMessage]) -> None:
    life = LifeTotal()
    at_check: tuple[dict[int, bytes], int, bool] = {}, 0, True
    for message in messages:
        assert life.fold(message) is None
        if is_check_point(message):
            frames = {number: delta_digest(frame.total.delta()) for number, frame in life.frames.items()}
            at_check = frames, len(life.signatures), message.healthy
        checked = {n: delta_digest(delta) for n, delta in life.checked.frames.items()}
        assert (checked, life.checked.names, life.checked.healthy) == at_check
        for delta in life.checked.frames.values():
            assert np.linalg.eigvalsh(to_information(delta).H.toarray())[0] > 0.0


@given(strategies.broken_streams())
@settings(settled, max_examples=100)
def test_a_message_that_breaks_a_rule_changes_nothing_that_counts(case: tuple[list[DeltaMessage], int]) -> None:
    messages, bad = case
    life = lived(messages[:bad])
    before, checked = state(life), life.checked
    reason = life.fold(messages[bad])
    assert reason is not None
    assert reason.startswith(f"message {bad}: ")
    assert life.checked is checked
    if "positive definite" not in reason:  # found by looking at the sum, so that the sum has it
        assert state(life) == before


def test_a_sum_that_fails_its_check_names_the_frame() -> None:
    life = lived(HONEST["ann", MAIN][:3])
    assert life.fold(instead(MAIN, 3, parts=(part(1, CONTINUED, (0, -2 * STRONG)),))) is None
    reason = life.fold(HONEST["ann", MAIN][4])
    assert reason == "message 4: the information in frame 1 is not positive definite"


def test_a_frame_that_is_too_large_to_check_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fleet_seif.definite.VARIABLES_MAX", 1)
    reason = LifeTotal().fold(HONEST["ann", MAIN][0])
    assert reason is not None
    assert reason.startswith("message 0: frame 0: ")


def test_only_what_has_changed_is_checked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[bytes] = []

    def look(delta: FrameDelta) -> bool:
        looked_at.append(delta_digest(delta))
        return True

    monkeypatch.setattr("fusion.life.is_positive_definite", look)
    life = LifeTotal()
    counts = []
    for message in HONEST["ann", MAIN]:
        life.fold(message)
        counts.append(len(looked_at))
    assert np.diff([0, *counts]).tolist() == [1, 0, 2, 0, 2, 2, 0, 0]


@pytest.mark.parametrize("status", [OPENED, CONTINUED, ENDED])
@pytest.mark.parametrize("steps", [1, 5])
def test_a_message_may_bring_what_the_hello_allows_for_its_steps_and_no_more(status: FrameStatus, steps: int) -> None:
    """An opening frame may bring the start information too; numbers are exact in quanta."""
    quanta = int(STEP_INFORMATION / H_QUANTUM)
    most = quanta * (steps + (status is OPENED))
    for value, fine in ((most, True), (most + 1, False)):
        life = lived(HONEST["ann", MAIN][:1])
        mine = dataclasses.replace(part(1 if status is OPENED else 0, status, (0, 0)), delta=pose_block(value))
        parts = (part(0, ENDED, (0, 0)), mine) if status is OPENED else (mine,)
        reason = life.fold(instead(MAIN, 1, last=steps, parts=parts, landmarks=()))
        assert (reason is None) == fine
        assert fine or "more information" in str(reason)


def test_a_correction_may_bring_anything() -> None:
    life = lived(HONEST["ann", MAIN][:4])
    huge = dataclasses.replace(part(0, CORRECTED, (0, 0)), delta=pose_block(2**59))
    assert life.fold(instead(MAIN, 4, parts=(huge,))) is None


def test_an_epoch_that_goes_on_does_not_change_the_number_of_its_life() -> None:
    life = lived(HONEST["ann", MAIN])
    message = instead(MAIN, 0, hello=dataclasses.replace(HELLO, life=3), parts=(), landmarks=())
    assert "as life 3" in str(life.fold(message))
    assert life.number == 0


def test_a_check_can_be_asked_for_anywhere() -> None:
    life = lived(HONEST["ann", MAIN][:1])
    second = HONEST["ann", MAIN][1]
    assert not is_check_point(second)
    assert life.fold(second, check=True) is None
    assert life.checked.names == 2


@st.composite
def said_aliases(draw: st.DrawFn) -> list[tuple[tuple[int, int, bool], ...]]:
    """What a vehicle with five landmarks says about pairs of them, in each of six messages."""
    numbers = st.integers(0, 4)
    pairs = st.tuples(numbers, numbers, st.booleans()).filter(lambda item: item[0] != item[1])
    return draw(st.lists(st.lists(pairs, max_size=3).map(tuple), min_size=6, max_size=6))


def with_aliases(said: list[tuple[tuple[int, int, bool], ...]]) -> list[DeltaMessage]:
    messages = HONEST["ann", MAIN][:6]
    five = tuple((k, -1) for k in range(5))
    changed = [
        dataclasses.replace(m, aliases=aliases, landmarks=(), innovation=0.1 * k + 0.3, innovation_dof=2 * k)
        for k, (m, aliases) in enumerate(zip(messages, said, strict=True))
    ]  # fmt: skip
    changed[0] = dataclasses.replace(changed[0], landmarks=five)
    return changed


@given(said_aliases())
@settled
def test_an_alias_counts_until_it_is_taken_back(said: list[tuple[tuple[int, int, bool], ...]]) -> None:
    messages = with_aliases(said)
    life = lived(messages)
    held: set[frozenset[int]] = set()
    for message in messages:
        for a, b, added in message.aliases:
            (held.add if added else held.discard)(frozenset((a, b)))
    assert {frozenset(pair) for pair in life.newest.aliases} == held
    assert list(life.newest.aliases) == sorted(life.newest.aliases)
    assert life.checked.aliases == life.newest.aliases  # message 5 is a check point


@given(said_aliases(), st.integers(1, 5))
@settled
def test_several_messages_as_one_leave_the_same_aliases_and_innovations_to_the_bit(
    said: list[tuple[tuple[int, int, bool], ...]], count: int
) -> None:
    messages = with_aliases(said)
    whole = Coalescer(messages[0])
    for message in messages[1:count]:
        whole.add(message)
    one, other = lived(messages), LifeTotal()
    assert other.fold(whole.message(), check=True) is None
    for message in messages[count:]:
        assert other.fold(message) is None
    for a, b in ((one.newest, other.newest), (one.checked, other.checked)):
        assert (a.aliases, a.innovation.hex(), a.dof) == (b.aliases, b.innovation.hex(), b.dof)


def test_a_message_that_is_refused_leaves_no_alias() -> None:
    life = lived(with_aliases([()] * 6)[:1])
    wrong = dataclasses.replace(HONEST["ann", MAIN][1], aliases=((0, 1, True), (0, 9, True)), landmarks=())
    assert "an alias of a landmark" in str(life.fold(wrong))
    assert life.newest.aliases == ()


@pytest.mark.parametrize(("mean", "fits"), [(1.0, True), (1.4, True), (1.7, False), (10.0, False)])
def test_a_vehicle_whose_innovations_are_far_larger_than_it_says_is_not_consistent(mean: float, fits: bool) -> None:
    dof = 2000
    assert Checked(innovation=mean * dof, dof=dof).consistent is fits


def test_before_anything_is_sighted_again_a_vehicle_counts_as_consistent() -> None:
    assert Checked().consistent
    assert Checked(innovation=12.0, dof=2).consistent
