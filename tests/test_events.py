"""Decisions of operators: the largest id on a subject counts, on every node, in whatever order they come."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.errors import WireError
from fleet_seif.messages import Action, LandmarkName, OperatorEvent
from fleet_seif.node_wire import encode_event
from fleet_seif.wire import encode_message
from fusion.events import Decisions, decide
from fusion.ledger import Ledger
from tests.histories import FLEET, HONEST, MAIN
from tests.strategies import settled

A, B, C, D = (
    LandmarkName("ann", 0, 0),
    LandmarkName("ann", 0, 1),
    LandmarkName("bob", 0, 0),
    LandmarkName("bob", 0, 1),
)
PAIRS = [(A, C), (A, D), (B, D)]
ABOUT_PAIRS = (Action.FORCE, Action.FORBID, Action.RELEASE)


@st.composite
def events(draw: st.DrawFn) -> OperatorEvent:
    action = draw(st.sampled_from(Action))
    about_pair = action in ABOUT_PAIRS
    return OperatorEvent(
        fleet=FLEET,
        number=draw(st.integers(1, 9)),
        operator=draw(st.sampled_from(["x", "y"])),
        action=action,
        landmarks=draw(st.sampled_from(PAIRS)) if about_pair else None,
        vehicle="" if about_pair else draw(st.sampled_from(["ann", "bob"])),
    )


def some_events() -> st.SearchStrategy[list[OperatorEvent]]:
    """Each id once."""
    return st.lists(events(), max_size=8, unique_by=lambda e: (e.number, e.operator))


@given(some_events(), st.data())
@settled
def test_decisions_do_not_depend_on_the_order_of_events(given: list[OperatorEvent], data: st.DataObject) -> None:
    assert decide(data.draw(st.permutations(given))) == decide(given)


@given(some_events())
@settled
def test_of_several_events_on_a_subject_the_one_with_the_largest_id_counts(given: list[OperatorEvent]) -> None:
    decisions = decide(given)
    for pair in PAIRS:
        last = max((e for e in given if e.landmarks == pair), key=lambda e: (e.number, e.operator), default=None)
        action = None if last is None else last.action
        assert (pair in decisions.forced, pair in decisions.forbidden) == (
            action is Action.FORCE, action is Action.FORBID
        )  # fmt: skip
    for vehicle in ("ann", "bob"):
        last = max((e for e in given if e.vehicle == vehicle), key=lambda e: (e.number, e.operator), default=None)
        assert (vehicle in decisions.retracted) == (last is not None and last.action is Action.RETRACT)


@given(some_events())
@settled
def test_pairs_come_in_the_order_of_the_ids_that_decide(given: list[OperatorEvent]) -> None:
    ids = {e.landmarks: (e.number, e.operator) for e in sorted(given, key=lambda e: (e.number, e.operator))}
    for pairs in (decide(given).forced, decide(given).forbidden):
        assert [ids[p] for p in pairs] == sorted(ids[p] for p in pairs)


def test_nothing_is_decided_at_first() -> None:
    assert decide([]) == Decisions() == Ledger(FLEET).decisions


# In a ledger.


def filled() -> Ledger:
    ledger = Ledger(FLEET)
    for vehicle in ("ann", "bob"):
        for message in HONEST[vehicle, MAIN]:
            ledger.accept(encode_message(message))
    return ledger


@given(some_events(), st.data())
@settled
def test_ledgers_with_the_same_events_are_equal(given: list[OperatorEvent], data: st.DataObject) -> None:
    ledgers = filled(), filled()
    for event in given:
        assert ledgers[0].accept_event(encode_event(event))
        assert not ledgers[0].accept_event(encode_event(event))
    for event in data.draw(st.permutations([*given, *given])):
        ledgers[1].accept_event(encode_event(event))
    assert ledgers[0].map_digest() == ledgers[1].map_digest()
    assert ledgers[0].ledger_digest() == ledgers[1].ledger_digest()


def test_of_two_events_with_one_id_every_node_keeps_the_same() -> None:
    one = OperatorEvent(fleet=FLEET, number=1, operator="x", action=Action.RETRACT, vehicle="ann")
    pair = [encode_event(one), encode_event(dataclasses.replace(one, vehicle="bob"))]
    ledgers = filled(), filled()
    for ledger, data in zip(ledgers, (pair, pair[::-1]), strict=True):
        for each in data:
            ledger.accept_event(each)
    assert ledgers[0].events == ledgers[1].events
    assert ledgers[0].map_digest() == ledgers[1].map_digest()


def classes_with(ledger: Ledger, name: LandmarkName) -> list[LandmarkName]:
    (group,) = [group for group in ledger.classes(ledger.lives()) if name in group]
    return list(group)


def test_landmarks_are_joined_parted_and_left_to_their_signatures() -> None:
    """A and C carry one signature; B has a signature of its own, D none."""
    ledger = filled()
    digests = [ledger.map_digest()]
    assert (classes_with(ledger, A), classes_with(ledger, B)) == ([A, C], [B])
    ledger.issue("x", Action.FORCE, landmarks=(B, D))
    digests.append(ledger.map_digest())
    assert classes_with(ledger, B) == [B, D]
    ledger.issue("x", Action.FORBID, landmarks=(A, C))
    digests.append(ledger.map_digest())
    assert (classes_with(ledger, A), classes_with(ledger, C)) == ([A], [C])
    ledger.issue("x", Action.RELEASE, landmarks=(B, D))
    assert classes_with(ledger, B) == [B]
    ledger.issue("x", Action.RELEASE, landmarks=(A, C))
    assert classes_with(ledger, A) == [A, C]
    assert len(set(digests)) == 3
    assert ledger.map_digest() == digests[0]
    assert ledger.ledger_digest() != filled().ledger_digest()


def test_a_vehicle_that_is_retracted_is_left_out_with_what_it_says_later_and_can_come_back() -> None:
    whole = filled().map_digest()
    ledger = Ledger(FLEET)
    for message in HONEST["ann", MAIN]:
        ledger.accept(encode_message(message))
    alone = ledger.map_digest()
    ledger.issue("x", Action.RETRACT, vehicle="bob")
    for message in HONEST["bob", MAIN]:
        ledger.accept(encode_message(message))
    assert [s.vehicle for s in ledger.placed()] == ["ann"]
    assert ledger.map_digest() == alone
    ledger.issue("x", Action.RESTORE, vehicle="bob")
    assert ledger.map_digest() == whole


def test_the_events_of_a_ledger_have_a_limit_and_those_held_can_come_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.ledger.EVENTS_MAX", 2)
    ledger = filled()
    held = [ledger.issue("x", Action.RETRACT, vehicle="bob") for _ in range(2)]
    with pytest.raises(WireError, match="at most 2"):
        ledger.issue("x", Action.RETRACT, vehicle="ann")
    assert not ledger.accept_event(held[0])


def test_events_of_another_fleet_are_refused() -> None:
    event = OperatorEvent(fleet="other", number=1, operator="x", action=Action.RETRACT, vehicle="ann")
    with pytest.raises(WireError, match="fleet"):
        filled().accept_event(encode_event(event))
