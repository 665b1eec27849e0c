"""Several ledgers of one fleet: whatever reaches them in whatever order, equal content makes them equal to the bit."""

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from fleet_seif.envelope import KIND_SNAPSHOT, kind_of
from fleet_seif.information import FrameDelta, delta_digest, to_information
from fleet_seif.messages import Action, Epoch, Heartbeat, LandmarkName
from fleet_seif.store import MemoryStore
from fleet_seif.wire import decode_snapshot, encode_heartbeat, encode_message
from fusion.compaction import compact
from fusion.ledger import Ledger
from tests.histories import CHECK_POINTS, FLEET, FORK, HONEST, MAIN, WRONG, lies, snapshot

NODES = ("a", "b", "c")
NODE = st.sampled_from(NODES)
STREAMS = {key: [encode_message(m) for m in said] for key, said in HONEST.items() if key[1] not in (FORK, WRONG)}
LIES = [[encode_message(message) for message in lie.messages] for lie in lies()]
SENDER = {encode_message(m): m.vehicle for said in (*HONEST.values(), *(lie.messages for lie in lies())) for m in said}
ONLY = {
    encode_message(lie): ((lie.vehicle, lie.epoch), lie.first)
    for each in lies()
    for lie in each.messages
    if len(each.messages) == 1 and lie.first == lie.last and (lie.vehicle, lie.epoch) in STREAMS
    and lie.first < len(STREAMS[lie.vehicle, lie.epoch])
}  # fmt: skip
"""Lies that can stand in the place of an honest message: where that is."""
EVERYTHING = sorted(HONEST)
PAIRS = [
    (LandmarkName("ann", 0, 0), LandmarkName("bob", 0, 1)),
    (LandmarkName("ann", 0, 1), LandmarkName("ann", 1, 0)),
    (LandmarkName("ann", 0, 0), LandmarkName("bob", 0, 0)),
]
DEFINITE: set[bytes] = set()
"""Digests of frames that have been found positive definite."""


def is_definite(delta: FrameDelta) -> bool:
    """By the eigenvalues of the dense matrix."""
    digest = delta_digest(delta)
    if digest not in DEFINITE:
        if np.linalg.eigvalsh(to_information(delta).H.toarray())[0] <= 0.0:
            return False
        DEFINITE.add(digest)
    return True


class Node:
    """A ledger with its store; `kept` is what it was at its last commit, and so what it may have acknowledged."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.store = MemoryStore()
        self.ledger = Ledger(FLEET)
        self.kept = self.state()

    def state(self) -> object:
        """All that must survive, and that nodes of equal content have in common."""
        ledger = self.ledger
        streams = {
            key: (s.next, s.checked, s.quarantine) for key, s in ledger.streams.items() if s.next or s.quarantine
        }
        return ledger.map_digest(), ledger.ledger_digest(), streams

    def commit(self) -> None:
        self.store.commit(self.ledger.take_changes())
        self.kept = self.state()

    def restart(self) -> None:
        self.ledger = Ledger(FLEET)
        self.ledger.restore(self.store.load())
        assert self.state() == self.kept


class Fleet(RuleBasedStateMachine):
    """Three nodes, two vehicles of which one may lie, and everything that has been sent to anybody."""

    def __init__(self) -> None:
        super().__init__()
        self.nodes = {name: Node(name) for name in NODES}
        self.sent: dict[bytes, str] = {}
        self.lies: list[list[bytes]] = []
        self.streams = {key: list(messages) for key, messages in STREAMS.items()}
        self.honest_until = 8

    def may_take_snapshots(self, node: str, key: tuple[str, Epoch]) -> bool:
        """Where a vehicle lies, one node keeps single messages: proof is made of them, and without any there is none.

        That limit is stated in the README.
        """
        return not self.lies or key[0] != "ann" or node != NODES[-1]

    @initialize(chosen=st.lists(st.sampled_from(LIES), max_size=3), instead=st.booleans(), all_is_sent=st.booleans())
    def vehicles(self, chosen: list[list[bytes]], instead: bool, all_is_sent: bool) -> None:
        """instead: the first lie is all that there is for its number; without, there is an honest message too."""
        self.lies = chosen
        if chosen and instead and chosen[0][0] in ONLY:
            key, k = ONLY[chosen[0][0]]
            self.streams[key][k] = chosen[0][0]
            self.honest_until = k if key == ("ann", MAIN) else 8
        if all_is_sent:
            self.sent = {data: SENDER[data] for messages in (*self.streams.values(), *chosen) for data in messages}

    def give(self, node: str, messages: Iterable[bytes]) -> None:
        for data in messages:
            self.sent[data] = SENDER[data]
            self.nodes[node].ledger.accept(data, SENDER[data])

    # What vehicles send, and what the network makes of it.

    @rule(key=st.sampled_from(sorted(STREAMS)), skipped=st.integers(0, 2), count=st.integers(1, 8), node=NODE)
    def the_next_messages_arrive(self, key: tuple[str, Epoch], skipped: int, count: int, node: str) -> None:
        stream = self.nodes[node].ledger.streams.get(key)
        first = (stream.next if stream else 0) + skipped
        self.give(node, self.streams[key][first : first + count])

    @rule(key=st.sampled_from(sorted(STREAMS)), order=st.sampled_from([NODES, NODES[::-1]]))
    def a_whole_stream_arrives_everywhere_but_at_the_last(self, key: tuple[str, Epoch], order: tuple[str, ...]) -> None:
        for node in order[:2]:
            self.give(node, self.streams[key])

    @rule(key=st.sampled_from(sorted(STREAMS)), order=st.permutations(range(8)), node=NODE)
    def some_messages_arrive_out_of_order(self, key: tuple[str, Epoch], order: list[int], node: str) -> None:
        self.give(node, [self.streams[key][k] for k in order[:4] if k < len(self.streams[key])])

    @rule(which=st.integers(0, 2), node=NODE)
    def a_lie_arrives(self, which: int, node: str) -> None:
        if which < len(self.lies):
            self.give(node, self.lies[which])

    @rule(last=st.sampled_from(CHECK_POINTS), node=NODE)
    def a_snapshot_of_its_vehicle_arrives(self, last: int, node: str) -> None:
        """What the snapshot stands for was sent."""
        if last < self.honest_until and self.may_take_snapshots(node, ("ann", MAIN)):
            self.sent.update(dict.fromkeys(STREAMS["ann", MAIN][: last + 1], "ann"))
            self.nodes[node].ledger.accept(snapshot(last), "ann")

    # What operators do.

    @rule(
        node=NODE, operator=st.sampled_from(["op", "oz"]), action=st.sampled_from(Action), pair=st.sampled_from(PAIRS)
    )
    def an_operator_decides(
        self, node: str, operator: str, action: Action, pair: tuple[LandmarkName, LandmarkName]
    ) -> None:
        ledger = self.nodes[node].ledger
        if action in (Action.RETRACT, Action.RESTORE):
            ledger.issue(operator, action, vehicle=pair[1].vehicle)
        else:
            ledger.issue(operator, action, landmarks=pair)

    # What nodes do.

    @rule(giver=NODE, taker=NODE)
    def events_and_evidence_are_exchanged(self, giver: str, taker: str) -> None:
        source, target = self.nodes[giver].ledger, self.nodes[taker].ledger
        for event in source.events.values():
            target.accept_event(event)
        for evidence in [s.evidence for s in source.streams.values() if s.evidence]:
            target.accept_evidence(evidence)

    @rule(giver=NODE, taker=NODE, key=st.sampled_from(EVERYTHING))
    def a_node_catches_up_from_another(self, giver: str, taker: str, key: tuple[str, Epoch]) -> None:
        source, target = self.nodes[giver].ledger.streams.get(key), self.nodes[taker].ledger
        if source is None:
            return
        for data in source.log:
            if kind_of(data) == KIND_SNAPSHOT:
                if not self.may_take_snapshots(taker, key):
                    return
                held = decode_snapshot(data)
                target.stream(*key).announced[held.message.last] = (held.prefix_digest, source.voucher)
            target.accept(data, key[0])

    @rule(node=NODE, key=st.sampled_from([("ann", MAIN), ("bob", MAIN)]))
    def a_node_forgets_single_messages(self, node: str, key: tuple[str, Epoch]) -> None:
        ledger = self.nodes[node].ledger
        stream = ledger.streams.get(key)
        if stream is None or stream.checked < 0 or not self.may_take_snapshots(node, key):
            return
        digest = stream.check_digests[stream.checked]
        beat = Heartbeat(
            fleet=FLEET, vehicle=key[0], epoch=key[1], last=stream.next - 1, prefix_digest=stream.prefix_digest,
            checked=stream.checked, checked_digest=digest, ended=stream.ended,
        )  # fmt: skip
        before = self.nodes[node].state()
        ledger.keep_witness(stream, stream.checked, encode_heartbeat(beat))
        ledger.replace(stream, compact(stream, stream.checked, node, None))
        assert self.nodes[node].state() == before
        assert ledger.bytes_held == sum(len(data) for s in ledger.streams.values() for data in s.log)

    @rule(node=NODE)
    def a_node_commits(self, node: str) -> None:
        self.nodes[node].commit()

    @rule(node=NODE)
    def a_node_is_killed_and_starts_again(self, node: str) -> None:
        self.nodes[node].restart()

    # Laws.

    @invariant()
    def what_maps_rest_on_is_positive_definite(self) -> None:
        for node in self.nodes.values():
            for stream in node.ledger.streams.values():
                if stream.life is not None:
                    assert all(is_definite(delta) for delta in stream.life.checked.frames.values())

    def settle(self) -> None:
        """Everybody gets everything, in another order each, until nothing changes any more."""
        for _ in range(6):
            before = [node.state() for node in self.nodes.values()]
            for i, node in enumerate(NODES):
                sent = list(self.sent)
                self.give(node, sent[i:] + sent[:i] if i < 2 else sent[::-1])
            for giver in NODES:
                for taker in NODES:
                    self.events_and_evidence_are_exchanged(giver, taker)
            if before == [node.state() for node in self.nodes.values()]:
                return
        raise AssertionError("the nodes do not come to rest")

    def teardown(self) -> None:
        self.settle()
        first, *others = [node.state() for node in self.nodes.values()]
        assert all(other == first for other in others)
        for node in self.nodes.values():
            node.commit()
            node.restart()


PHASES = (Phase.explicit, Phase.generate, Phase.shrink)
HEALTH = list(HealthCheck)
Fleet.TestCase.settings = settings(
    deadline=None, derandomize=True, max_examples=150, stateful_step_count=25, phases=PHASES,
    suppress_health_check=HEALTH,
)  # fmt: skip
test_nodes_of_equal_content_are_equal = Fleet.TestCase


class LongRun(Fleet):
    pass


LongRun.TestCase.settings = settings(
    Fleet.TestCase.settings, max_examples=2000, stateful_step_count=50, derandomize=True
)


test_nodes_of_equal_content_are_equal_over_many_runs = pytest.mark.slow(pytest.mark.timeout(900)(LongRun.TestCase))
