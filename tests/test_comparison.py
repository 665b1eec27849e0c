"""Nodes with equal ledgers that decide merges otherwise: they say in which landmarks, and nothing is called a fault."""

import dataclasses
from functools import cache

from fleet_seif.merge_records import Considered, Differing, MergeReport, Merges, Reason
from fleet_seif.merge_wire import decode_merges
from fleet_seif.messages import JointMap, LandmarkName
from fusion.comparison import NODES_MAX, Comparison, differing
from fusion.core import CLASSES_DIFFERING, NODES_DIFFERING, FusionCore, PutMerges
from fusion.mapping import make_map, map_input
from fusion.merges import merges_of
from scenarios.config import load_scenario
from scenarios.simulation import SimNode, Simulation
from scenarios.source import record

A, B, C, D = (LandmarkName(vehicle, 0, 0) for vehicle in ("a", "b", "c", "d"))
SETTINGS = ("fleet.vehicles=2", "fleet.nodes=2", "world.landmarks=12", "world.steps=20", "run.rate_hz=0")
FAULTS = ("forks", "malformed", "messages_refused")


def settled_fleet() -> tuple[Simulation, SimNode, SimNode]:
    """Two nodes that hold all of a run."""
    scenario = load_scenario("fleet", (*SETTINGS, "fusion.required_acks=['fusion','fusion2']"))
    fleet = Simulation(scenario, record(scenario))
    while not fleet.settled:
        fleet.advance()
    one, other = fleet.nodes.values()
    return fleet, one, other


def core_of(node: SimNode) -> FusionCore:
    assert node.core is not None
    return node.core


def serve(node: SimNode, *, apart: bool = False) -> JointMap:
    """A node's canonical map; apart: decided otherwise in one landmark of two vehicles."""
    core = core_of(node)
    taken, merges = map_input(core, node.clock_s), merges_of(core.ledger)
    if apart:
        pair = next(names for names in merges.classes if len(names) == 2)
        taken = dataclasses.replace(taken, decisions=dataclasses.replace(taken.decisions, forbidden=(pair,)))
    joint = make_map(taken, 0, final=True)
    node.serve(joint, merges)
    return joint


def go_on(fleet: Simulation, for_s: float = 2.0) -> None:
    end_s = fleet.now_s + for_s
    while fleet.now_s < end_s:
        fleet.advance()


def report_of(node: SimNode) -> MergeReport:
    (data,) = [each.data for each in core_of(node)._tell_merges() if isinstance(each, PutMerges)]
    return decode_merges(data)


def test_a_landmark_that_another_node_has_merged_otherwise_is_told_by_both_and_is_no_fault() -> None:
    fleet, one, other = settled_fleet()
    ours, theirs = serve(one), serve(other, apart=True)
    assert ours.ledger_digest == theirs.ledger_digest
    assert ours.map_digest != theirs.map_digest
    go_on(fleet)
    (joined,) = set(ours.names) - set(theirs.names)
    split = tuple((name,) for name in joined)
    assert report_of(one).differing == (Differing("fusion2", joined, split),)
    assert report_of(other).differing == tuple(Differing("fusion", names, (joined,)) for names in split)
    assert [core_of(one).counters[name] for name in (NODES_DIFFERING, CLASSES_DIFFERING)] == [1, 1]
    assert [core_of(other).counters[name] for name in (NODES_DIFFERING, CLASSES_DIFFERING)] == [1, 2]
    for node in (one, other):
        assert not any(core_of(node).counters[name] for name in FAULTS)
        assert not any(state.fault for state in core_of(node).states(node.clock_s))


def test_nodes_that_decide_alike_again_say_so_no_more() -> None:
    fleet, one, other = settled_fleet()
    serve(one)
    serve(other, apart=True)
    go_on(fleet)
    serve(other)
    go_on(fleet)
    for node in (one, other):
        assert report_of(node).differing == ()
        assert not {NODES_DIFFERING, CLASSES_DIFFERING} & set(core_of(node).counters)


def test_maps_that_differ_though_all_landmarks_are_the_same_are_counted_as_a_fork() -> None:
    fleet, one, other = settled_fleet()
    ours = serve(one)
    other.serve(dataclasses.replace(ours, node="fusion2", map_digest=bytes(32)), Merges(ours.names))
    go_on(fleet)
    assert core_of(one).counters["forks"] == core_of(other).counters["forks"] == 1
    assert core_of(one).counters[CLASSES_DIFFERING] == 0


@cache
def any_map() -> JointMap:
    return serve(settled_fleet()[1])


def heard(node: str = "n") -> MergeReport:
    """What a node says that has another map of the same ledger."""
    comparison = Comparison()
    comparison.serve(dataclasses.replace(any_map(), node=node, map_digest=bytes(32)), Merges(()))
    report = comparison.report()
    assert report is not None
    return report


def test_live_maps_and_maps_of_other_ledgers_are_not_compared() -> None:
    comparison = Comparison()
    comparison.serve(any_map(), Merges(()))
    assert not comparison.hear(dataclasses.replace(heard(), canonical=False))
    assert not comparison.hear(dataclasses.replace(heard(), ledger_digest=bytes(32)))
    assert comparison.nodes == 0
    assert comparison.hear(heard())


def test_a_map_is_fetched_until_it_has_come_and_then_no_more() -> None:
    comparison = Comparison()
    assert not comparison.hear(heard())  # there is nothing to compare with yet
    comparison.serve(any_map(), Merges(()))
    assert comparison.hear(heard())
    assert comparison.hear(heard())
    assert comparison.nodes == 1
    comparison.learn(dataclasses.replace(any_map(), node="n", map_digest=bytes(32), names=any_map().names[1:]))
    assert not comparison.hear(heard())
    assert comparison.landmarks == 1


def test_more_nodes_than_the_limit_are_not_heard() -> None:
    comparison = Comparison()
    comparison.serve(any_map(), Merges(()))
    assert all(comparison.hear(heard(f"n{i}")) for i in range(NODES_MAX))
    assert not comparison.hear(heard("one-more"))
    assert comparison.nodes == NODES_MAX


def test_each_landmark_of_ours_that_differs_comes_with_what_is_there_instead() -> None:
    ours = ((A, B), (C,), (D,))
    assert differing("n", ours, ours) == ()
    assert differing("n", ours, ((A,), (B, C), (D,))) == (
        Differing("n", (A, B), ((A,), (B, C))),
        Differing("n", (C,), ((B, C),)),
    )
    assert differing("n", ours, ((A, B), (C,))) == (Differing("n", (D,), ()),)


def test_a_report_counts_all_pairs_kept_apart_and_names_the_nearest_of_each_reason() -> None:
    few = [Considered(A, LandmarkName("b", 0, k), 20.0 - k, Reason.FEW) for k in range(12)]
    rest = [Considered(A, C, float("inf"), Reason.UNSOLVED), Considered(A, D, 1.0, Reason.MERGED)]
    comparison = Comparison()
    comparison.serve(any_map(), Merges((), considered=(*few, *rest)))
    report = comparison.report()
    assert report is not None
    assert report.kept_apart == ((Reason.FEW, 12), (Reason.UNSOLVED, 1))
    assert [(each.b.number, each.d2) for each in report.nearest if each.reason is Reason.FEW] == [
        (k, 20.0 - k) for k in range(11, 3, -1)
    ]
    assert [each.d2 for each in report.nearest if each.reason is Reason.UNSOLVED] == [None]
