"""Merges in the terminal: who saw what, what was kept apart and why, where nodes differ; all of it bounded."""

import dataclasses
import json

import numpy as np
import pytest
from rich.console import Console, Group

from fleet_seif.merge_records import Differing, KeptApart, MergeReport, Reason
from fleet_seif.messages import Epoch, JointMap, LandmarkName, VehicleState
from fusion.mapping import empty_map
from scenarios import watch
from scenarios.watch_merges import LANDMARKS_MAX, PAIRS_MAX, SETS_MAX

A, B, C = LandmarkName("ann", 0, 3), LandmarkName("bob", 0, 7), LandmarkName("cat", 1, 0)


def map_of(*names: tuple[LandmarkName, ...]) -> JointMap:
    """Landmarks three centimetres apart."""
    mean = np.column_stack([0.03 * np.arange(len(names)), np.zeros(len(names))])
    return dataclasses.replace(
        empty_map("f", "fusion", 1), names=names, landmark_mean=mean, signature=(-1,) * len(names)
    )


def report(**changes: object) -> MergeReport:
    empty = MergeReport(
        fleet="f", node="fusion", version=1, canonical=True, map_digest=bytes(32), ledger_digest=bytes(32),
        kept_apart=(), nearest=(),
    )  # fmt: skip
    return dataclasses.replace(empty, **changes)  # type: ignore[arg-type]


def shown(joint: JointMap, said: MergeReport | None = None) -> str:
    console = Console(width=160, record=True, quiet=True)
    with console.capture() as capture:
        console.quiet = False
        console.print(Group(watch.picture(joint, said)))
    return capture.get()


def test_landmarks_are_counted_by_who_saw_them() -> None:
    text = shown(map_of((A, B), (C,), (A._replace(number=4), B._replace(number=8)), (A._replace(number=5),)))
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines[lines.index("landmarks seen by") + 1 :][:3] == ["2 ann bob", "1 ann", "1 cat"]


def test_pairs_kept_apart_are_counted_by_reason_and_the_nearest_named_with_their_distance() -> None:
    pairs = tuple(KeptApart(A._replace(number=k), B, Reason.FEW, 4.0) for k in range(PAIRS_MAX + 2))
    told = report(
        kept_apart=((Reason.FEW, 12), (Reason.UNSOLVED, 1)), nearest=(*pairs, KeptApart(A, C, Reason.UNSOLVED, None))
    )
    text = shown(map_of((A._replace(number=0),), (B,), (A,)), told)
    assert f"12 {Reason.FEW} ann/0/0 bob/0/7 (0.030 m, 2.0 sigma), ann/0/1 bob/0/7 (2.0 sigma)" in " ".join(
        text.split()
    )
    assert f"1 {Reason.UNSOLVED} ann/0/3 cat/1/0" in " ".join(text.split())
    assert f"ann/0/{PAIRS_MAX} bob" not in text


def test_landmarks_merged_otherwise_are_named_with_what_the_other_node_has() -> None:
    text = shown(map_of((A, B)), report(differing=(Differing("fusion2", (A, B), ((A,), (B,))),)))
    assert "merged otherwise by fusion2: ann/0/3 bob/0/7 there ann/0/3 | bob/0/7" in text


def test_tables_end_where_their_limits_are() -> None:
    many = tuple((A._replace(vehicle=f"v{k:02}"),) for k in range(SETS_MAX + 4))
    others = tuple(Differing("n", (A._replace(number=k),), ()) for k in range(LANDMARKS_MAX + 2))
    text = shown(map_of(*many), report(differing=others))
    assert "4 other sets of vehicles" in text
    assert "merged otherwise: 2 landmarks more" in text
    assert text.count("merged otherwise by n") == LANDMARKS_MAX


def state(name: str, *, healthy: bool, fault: str = "") -> VehicleState:
    return VehicleState(
        name=name, life=0, epoch=Epoch(0, 0), cut=5, checked=5, behind=0, parked=0, duplicates=0, gaps_repaired=0,
        refused=0, placed=False, stalled=False, ended=False, healthy=healthy, fault=fault,
    )  # fmt: skip


def test_doubtful_vehicles_are_named_and_those_in_quarantine_are_not_among_them() -> None:
    states = (state("ann", healthy=True), state("bob", healthy=False), state("cat", healthy=False, fault="lies"))
    joint = dataclasses.replace(map_of(), vehicles=states)
    assert "doubtful, not fused: bob\n" in shown(joint).replace(" \n", "\n")
    assert watch.doubtful(states[:1]) == []


@pytest.mark.parametrize("said", [None, report(kept_apart=((Reason.FEW, 1),), differing=(Differing("n", (A,), ()),))])
def test_a_map_with_what_is_said_of_its_merges_is_json(said: MergeReport | None) -> None:
    told = json.loads(json.dumps(watch.as_dict(map_of((A, B)), said), allow_nan=False))["merging"]
    if said is None:
        assert told is None
    else:
        assert told["kept_apart"] == {str(Reason.FEW): 1}
        assert told["differing"] == [{"node": "n", "here": ["ann/0/3"], "there": []}]
