"""Random runs of a fleet without signatures: whatever comes in whatever order, nodes of equal content merge alike.

Three vehicles see the same six landmarks, and each something else; what they say is late, corrected and taken back, and
operators force, forbid and retract.
"""

import dataclasses
import os
from collections.abc import Iterable
from functools import cache

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from fleet_seif.information import FrameDelta
from fleet_seif.messages import Action, DeltaMessage, Epoch, FramePart, FrameStatus, Hello, LandmarkName
from fleet_seif.records import Floats
from fleet_seif.wire import encode_message
from fusion.ledger import Ledger
from fusion.merges import Merger, run_digest
from tests import reference
from tests.histories import FLEET
from tests.test_convergence import HEALTH, PHASES

OPENED, CONTINUED, ENDED, CORRECTED = FrameStatus
VEHICLES = ("ann", "bob", "cat")
NODES = ("a", "b")
WORLD = np.array([[0.0, 0.0], [1.3, 0.2], [0.4, 1.1], [1.9, 1.6], [-0.8, 0.9], [0.9, 2.2], [3.0, 3.0], [-2.0, -2.0]])
NOISE_M = 0.02
EPOCH = Epoch(1, 7)
LANDMARKS = [LandmarkName(vehicle, 0, number) for vehicle in VEHICLES for number in (0, 1, 2, 6)]


def seen(numbers: Iterable[int], at: Floats, *, pose: bool = True, sign: float = 1.0) -> FrameDelta:
    """What a frame learns by seeing these landmarks of a vehicle at these places."""
    numbers = sorted(numbers)
    z = np.concatenate([[0.0] * 3 if pose else [], at[numbers].ravel()])
    H = sign * np.diag(np.concatenate([[4000.0] * 3 if pose else [], np.full(2 * len(numbers), NOISE_M**-2)]))
    return reference.quantised(H, H @ z, [*([0] if pose else []), *(n + 1 for n in numbers)])


def part(frame: int, status: FrameStatus, delta: FrameDelta) -> FramePart:
    ends = status in (ENDED, CORRECTED)
    return FramePart(frame=frame, status=status, delta=delta, end_pose=np.zeros(3) if ends else None)


@cache
def history(vehicle: str) -> tuple[bytes, ...]:
    """A stream of seven messages. Landmark 6 is a duplicate of 0; at the end landmark 1 turns out to lie elsewhere for
    bob, and cat is doubtful for a while."""
    k = VEHICLES.index(vehicle)
    rng = np.random.default_rng(k)
    at = np.vstack([WORLD[:6], WORLD[:1], WORLD[6 + k % 2 :][:1]]) + NOISE_M * rng.standard_normal((8, 2))
    elsewhere = at.copy()
    elsewhere[1] += (0.5, 0.0)
    hello = Hello(
        software="t", life=0, placed=True, start_pose=0.03 * rng.standard_normal(3) * (1, 1, 0.1),
        start_pose_cov=np.diag([1e-3, 1e-3, 1e-5]), start_information=5000.0, step_information_max=5000.0,
    )  # fmt: skip
    shift = [
        part(0, CORRECTED, seen([1], at, pose=False, sign=-1.0)),
        part(0, CORRECTED, seen([1], elsewhere, pose=False)),
    ]
    messages = [
        said(vehicle, 0, part(0, OPENED, seen([0, 1, 2], at)), landmarks=range(3), hello=hello),
        said(vehicle, 1, part(0, CONTINUED, seen([3, 4, 5], at)), landmarks=range(3, 6)),
        said(vehicle, 2, part(0, ENDED, FrameDelta.nothing()), part(1, OPENED, seen([6, 7, 2], at)), landmarks=(6, 7)),
        said(vehicle, 3, part(1, CONTINUED, seen([3, 0], at)), aliases=((0, 6, True),), healthy=vehicle != "cat"),
        said(vehicle, 4, part(1, ENDED, FrameDelta.nothing()), healthy=vehicle != "cat"),
        said(vehicle, 5, *(shift if vehicle == "bob" else ())),
        said(vehicle, 6, aliases=((0, 6, vehicle != "ann"),), end=True),
    ]
    return tuple(encode_message(message) for message in messages)


def said(vehicle: str, k: int, *parts: FramePart, landmarks: Iterable[int] = (), **more: object) -> DeltaMessage:
    message = DeltaMessage(
        fleet=FLEET, vehicle=vehicle, epoch=EPOCH, first=k, last=k, step=k, time_s=float(k), parts=parts,
        landmarks=tuple((number, -1) for number in landmarks),
    )  # fmt: skip
    return dataclasses.replace(message, **more)  # type: ignore[arg-type]


class Merging(RuleBasedStateMachine):
    """Two nodes, one of which remembers its merges from map to map; at the end they hold the same."""

    def __init__(self) -> None:
        super().__init__()
        self.ledgers = {name: Ledger(FLEET) for name in NODES}
        self.merger = Merger()

    @initialize(first=st.integers(0, 7))
    def something_is_known(self, first: int) -> None:
        for ledger in self.ledgers.values():
            self.give(ledger, [history(v)[k] for v in VEHICLES for k in range(first)])

    def give(self, ledger: Ledger, messages: Iterable[bytes]) -> None:
        for data in messages:
            ledger.accept(data)

    @rule(vehicle=st.sampled_from(VEHICLES), order=st.permutations(range(7)), count=st.integers(1, 7),
          node=st.sampled_from(NODES))  # fmt: skip
    def messages_arrive_in_any_order(self, vehicle: str, order: list[int], count: int, node: str) -> None:
        self.give(self.ledgers[node], [history(vehicle)[k] for k in order[:count]])

    @rule(vehicle=st.sampled_from(VEHICLES), node=st.sampled_from(NODES))
    def a_whole_stream_arrives(self, vehicle: str, node: str) -> None:
        self.give(self.ledgers[node], history(vehicle))

    @rule(node=st.sampled_from(NODES), action=st.sampled_from([Action.FORCE, Action.FORBID, Action.RELEASE]),
          pair=st.lists(st.sampled_from(LANDMARKS), min_size=2, max_size=2, unique=True))  # fmt: skip
    def an_operator_decides_about_landmarks(self, node: str, action: Action, pair: list[LandmarkName]) -> None:
        first, second = sorted(pair)
        self.ledgers[node].issue(f"of_{node}", action, landmarks=(first, second))

    @rule(node=st.sampled_from(NODES), action=st.sampled_from([Action.RETRACT, Action.RESTORE]),
          vehicle=st.sampled_from(VEHICLES))  # fmt: skip
    def an_operator_decides_about_a_vehicle(self, node: str, action: Action, vehicle: str) -> None:
        self.ledgers[node].issue(f"of_{node}", action, vehicle=vehicle)

    @rule()
    def a_map_is_made(self) -> None:
        ledger = self.ledgers["a"]
        self.merger.of(ledger.lives(), ledger.decisions)

    def teardown(self) -> None:
        a, b = self.ledgers["a"], self.ledgers["b"]
        sent = [data for stream in (*a.streams.values(), *b.streams.values()) for data in everything(stream)]
        self.give(a, sent)
        self.give(b, sent[::-1])
        for giver, taker in ((a, b), (b, a)):
            for event in giver.events.values():
                taker.accept_event(event)
        assert a.ledger_digest() == b.ledger_digest()
        merges = self.merger.of(a.lives(), a.decisions)
        digest = a.map_digest(merges.classes)
        assert digest == run_digest(b)
        apart = a.decisions.forbidden
        assert not any(p in names and q in names for names in merges.classes for p, q in apart)
        self.without(a, sent)

    def without(self, ledger: Ledger, sent: list[bytes]) -> None:
        """Retracting a vehicle gives the map of a ledger that never heard of it, and restoring it the one before."""
        vehicle = VEHICLES[len(sent) % 3]
        other = Ledger(FLEET)
        self.give(other, [data for data in sent if data not in history(vehicle)])
        for event in ledger.events.values():
            other.accept_event(event)
        before, gone = run_digest(ledger), vehicle in ledger.decisions.retracted
        ledger.issue("z", Action.RETRACT, vehicle=vehicle)
        assert run_digest(ledger) == run_digest(other)
        ledger.issue("z", Action.RETRACT if gone else Action.RESTORE, vehicle=vehicle)
        assert run_digest(ledger) == before


def everything(stream: object) -> list[bytes]:
    return [*stream.log, *(parked.data for parked in stream.parked.values())]  # type: ignore[attr-defined]


Merging.TestCase.settings = settings(
    deadline=None, derandomize=True, max_examples=60, stateful_step_count=8, phases=PHASES,
    suppress_health_check=HEALTH,
)  # fmt: skip
test_nodes_of_equal_content_merge_alike = Merging.TestCase


class LongRun(Merging):
    pass


RUNS = int(os.environ.get("FLEET_SEIF_MERGE_RUNS", "500"))
"""Of the long run, about an eighth of a second each: more of them by hand."""
LongRun.TestCase.settings = settings(Merging.TestCase.settings, max_examples=RUNS)
test_nodes_of_equal_content_merge_alike_in_many_runs = pytest.mark.slow(pytest.mark.timeout(7200)(LongRun.TestCase))


def test_the_history_holds_what_it_is_meant_to() -> None:
    """Five landmarks are found by place, the sixth has a duplicate; what is corrected and taken back is apart again."""
    ledger = Ledger(FLEET)
    for vehicle in VEHICLES:
        for data in history(vehicle)[:3]:
            ledger.accept(data)
    sizes = sorted(len(names) for names in Merger().of(ledger.lives(), ledger.decisions).classes)
    assert sizes.count(3) == 5
    for vehicle in VEHICLES:
        for data in history(vehicle):
            ledger.accept(data)
    classes = Merger().of(ledger.lives(), ledger.decisions).classes
    assert (LandmarkName("bob", 0, 1),) in classes
    assert any({LandmarkName("bob", 0, 0), LandmarkName("bob", 0, 6)} <= set(names) for names in classes)
    assert not any({LandmarkName("ann", 0, 0), LandmarkName("ann", 0, 6)} <= set(names) for names in classes)
