"""The joint map in a terminal, or as JSON lines."""

import asyncio
import json
from collections.abc import Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fleet_seif.client import FleetClient, connect
from fleet_seif.errors import RunError
from fleet_seif.merge_records import MergeReport
from fleet_seif.messages import JointMap, VehicleState
from fleet_seif.signing import load_key_ring
from fusion.mapping import CANDIDATES, REFUSED
from scenarios.watch_merges import merging, merging_dict

FIRST_S = 10.0
MERGES_S = 1.0
DOUBTFUL_MAX = 20
GRID_ROWS = 22
GRID_COLUMNS = 72


@dataclass(frozen=True)
class Source:
    """Whose maps, and how they are reached. key_ring: a file, where the fleet signs them."""

    endpoints: list[str]
    fleet: str
    config: Path | None = None
    insecure: bool = False
    key_ring: Path | None = None

    def connect(self) -> AbstractAsyncContextManager[FleetClient]:
        keys = None if self.key_ring is None else load_key_ring(self.key_ring)
        return connect(self.endpoints, fleet=self.fleet, config=self.config, insecure=self.insecure, keys=keys)


async def watch(source: Source, as_json: bool, console: Console) -> None:
    """Show every map until the run ends, or until interrupted."""
    async with source.connect() as client:
        if as_json:
            async for joint in client.maps():
                print(json.dumps(as_dict(joint, await client.merges(joint.node))), flush=True)  # noqa: T201
            return
        with Live(Text(f"waiting for the map of fleet {source.fleet} ..."), console=console) as live:
            async for joint in client.maps():
                live.update(picture(joint, await client.merges(joint.node)))


async def newest_map(source: Source) -> tuple[JointMap, MergeReport | None]:
    """The map that a fusion node serves now, and what it says of the merges. Raises RunError where no map comes."""
    async with source.connect() as client:
        try:
            joint = await asyncio.wait_for(anext(client.maps()), FIRST_S)
            return joint, await client.merges(joint.node, MERGES_S)
        except TimeoutError:
            raise RunError(f"no map of fleet {source.fleet!r} within {FIRST_S:.0f} s: is that its name?") from None


def state_dict(state: VehicleState) -> dict[str, Any]:
    """The state of a vehicle as JSON values."""
    return {**vars(state), "epoch": list(state.epoch)}


def as_dict(joint: JointMap, report: MergeReport | None = None) -> dict[str, Any]:
    """A map as JSON values, with what its node says of the merges in it."""
    return {
        "fleet": joint.fleet,
        "node": joint.node,
        "version": joint.version,
        "canonical": joint.canonical,
        "final": joint.final,
        "map_digest": joint.map_digest.hex(),
        "ledger_digest": joint.ledger_digest.hex(),
        "cov_version": joint.cov_version,
        "landmarks": [
            {
                "mean_m": joint.landmark_mean[i].tolist(),
                "cov_m2": joint.landmark_cov[i].tolist() if len(joint.landmark_cov) else None,
                "signature": joint.signature[i],
                "seen_by": ["/".join(str(part) for part in name) for name in names],
            }
            for i, names in enumerate(joint.names)
        ],
        "poses": {name: joint.pose_mean[i].tolist() for i, name in enumerate(joint.poses)},
        "vehicles": [state_dict(state) for state in joint.vehicles],
        "counters": joint.counters,
        "merging": None if report is None else merging_dict(report),
    }


def picture(joint: JointMap, report: MergeReport | None = None) -> RenderableType:
    """Map, uncertainty, who saw what, what was kept apart, and the health of each vehicle."""
    deviation = ""
    if len(joint.landmark_cov):
        largest = np.sqrt(np.linalg.eigvalsh(joint.landmark_cov)[:, -1])
        deviation = f", standard deviation median {np.median(largest):.4f} m, worst {largest.max():.4f} m"
    shared = sum(len({name.vehicle for name in names}) > 1 for names in joint.names)
    head = (
        f"fleet {joint.fleet}  map {joint.version}{' final' if joint.final else ''}  "
        f"{len(joint.names)} landmarks ({shared} shared){deviation}"
    )
    counted = joint.counters
    if counted.get(CANDIDATES):
        head += f"  {counted[CANDIDATES]} pairs compared, {counted.get(REFUSED, 0)} kept apart"
    words = [*doubtful(joint.vehicles), *faults(joint.vehicles)]
    return Group(Text(head), grid(joint), *merging(joint, report), vehicle_table(joint.vehicles), *map(Text, words))


def vehicle_table(states: Sequence[VehicleState]) -> Table:
    """How every epoch of every vehicle is; a vehicle's epochs are numbered as they followed each other."""
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    heads = ["vehicle", "life", "epoch", "folded", "behind", "parked", "twice", "repaired", "refused", "state"]
    for head in heads:
        table.add_column(head, no_wrap=head != "state", justify="left" if head in ("vehicle", "state") else "right")
    for s in states:
        epoch = 1 + sum(other.name == s.name and other.epoch < s.epoch for other in states)
        counts = (s.life, epoch, s.cut + 1, s.behind, s.parked, s.duplicates, s.gaps_repaired, s.refused)
        table.add_row(s.name, *(str(count) for count in counts), state_words(s, states))
    return table


def faults(states: Sequence[VehicleState]) -> list[str]:
    """Why vehicles are quarantined, a line each."""
    return [f"{s.name} is quarantined: {s.fault}" for s in states if s.fault]


def doubtful(states: Sequence[VehicleState]) -> list[str]:
    """Which vehicles say that they are doubtful, in a line; none: no line."""
    names = sorted({s.name for s in states if not s.healthy and not s.fault})
    more = f" and {len(names) - DOUBTFUL_MAX} more" if len(names) > DOUBTFUL_MAX else ""
    return [f"doubtful, not fused: {', '.join(names[:DOUBTFUL_MAX])}{more}"] if names else []


def state_words(s: VehicleState, states: Sequence[VehicleState]) -> str:
    """A state in words. An epoch that stopped short and was followed by one that does not continue it has a gap."""
    if s.fault:
        return f"quarantined, stays at {s.checked}"
    later = [other for other in states if other.name == s.name and other.epoch > s.epoch]
    if s.ended:
        words = "ended"
    elif any(other.life == s.life and other.placed == s.placed and other.cut >= 0 for other in later):
        words = "continued"
    elif later and s.behind:
        words = f"outbox lost: {s.behind} messages after {s.cut} are missing"
    else:
        words = "stalled" if s.stalled else "mapping"
    return words + ("" if s.healthy else ", doubtful") + ("" if s.placed else ", not placed")


def grid(joint: JointMap) -> Text:
    """The map as characters: . a landmark, o one that several vehicles saw, 1 2 3 ... the vehicles."""
    points = np.vstack([joint.landmark_mean, joint.pose_mean[:, :2]])
    if not len(points):
        return Text("")
    low, high = points.min(axis=0), points.max(axis=0)
    scale = max((high[0] - low[0]) / (GRID_COLUMNS - 1), (high[1] - low[1]) / (GRID_ROWS - 1) / 2, 1e-9)
    rows = min(GRID_ROWS, int((high[1] - low[1]) / scale / 2) + 1)
    cells = [[" "] * GRID_COLUMNS for _ in range(rows)]

    def put(point: np.ndarray[Any, np.dtype[np.float64]], mark: str) -> None:
        column, row = int((point[0] - low[0]) / scale), int((high[1] - point[1]) / scale / 2)
        cells[min(row, rows - 1)][min(column, GRID_COLUMNS - 1)] = mark

    for point, names in zip(joint.landmark_mean, joint.names, strict=True):
        put(point, "o" if len({name.vehicle for name in names}) > 1 else ".")
    for i, pose in enumerate(joint.pose_mean):
        put(pose[:2], str((i + 1) % 10))
    return Text("\n".join("".join(row) for row in cells))
