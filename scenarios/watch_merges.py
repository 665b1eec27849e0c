"""Who saw which landmarks, what was kept apart and why, and where nodes differ: for a terminal, or as JSON values."""

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from fleet_seif.merge_records import KeptApart, MergeReport
from fleet_seif.messages import JointMap, LandmarkName

SETS_MAX: Final = 8
"""Sets of vehicles in a table; the others are counted in its last row."""
PAIRS_MAX: Final = 3
"""Pairs named for each reason."""
LANDMARKS_MAX: Final = 5
"""Landmarks named that another node has merged otherwise."""
NAMES_MAX: Final = 6
"""Names of one landmark; of more the others are counted."""


def merging(joint: JointMap, report: MergeReport | None) -> list[RenderableType]:
    """What there is to say: landmarks by who saw them, then what a node says of its merges."""
    said: list[RenderableType] = [seen_table(joint)] if len(joint.names) else []
    if report is not None:
        if report.kept_apart:
            said.append(apart_table(joint, report))
        said += map(Text, differing_words(report))
    return said


def seen_table(joint: JointMap) -> Table:
    """How many landmarks each set of vehicles has seen, the largest sets first."""
    counts = Counter(tuple(sorted({name.vehicle for name in names})) for names in joint.names)
    ordered = sorted(counts.items(), key=lambda item: (-len(item[0]), -item[1], item[0]))
    table = _table("landmarks", "seen by")
    for vehicles, count in ordered[:SETS_MAX]:
        table.add_row(str(count), " ".join(vehicles[:NAMES_MAX]) + _more(len(vehicles) - NAMES_MAX))
    if len(ordered) > SETS_MAX:
        rest = ordered[SETS_MAX:]
        table.add_row(str(sum(count for _, count in rest)), f"{len(rest)} other sets of vehicles")
    return table


def apart_table(joint: JointMap, report: MergeReport) -> Table:
    """Pairs kept apart by reason, the nearest by name with their distance."""
    table = _table("pairs", "kept apart because", "nearest")
    for reason, count in report.kept_apart:
        pairs = [each for each in report.nearest if each.reason is reason][:PAIRS_MAX]
        table.add_row(str(count), str(reason), ", ".join(_pair_words(joint, each) for each in pairs))
    return table


def differing_words(report: MergeReport) -> list[str]:
    """The landmarks that other nodes have merged otherwise, a line each."""
    words = []
    for node, ours, theirs in report.differing[:LANDMARKS_MAX]:
        there = " | ".join(_names(names) for names in theirs[:NAMES_MAX]) + _more(len(theirs) - NAMES_MAX)
        words.append(f"merged otherwise by {node}: {_names(ours)} there {there or 'not at all'}")
    if len(report.differing) > LANDMARKS_MAX:
        words.append(f"merged otherwise: {len(report.differing) - LANDMARKS_MAX} landmarks more")
    return words


def merging_dict(report: MergeReport) -> dict[str, Any]:
    """A report as JSON values."""
    return {
        "version": report.version,
        "kept_apart": {str(reason): count for reason, count in report.kept_apart},
        "nearest": [
            {
                "landmarks": [_text(each.a), _text(each.b)],
                "squared_distance": each.d2,
                "reason": str(each.reason),
            }
            for each in report.nearest
        ],
        "differing": [
            {"node": node, "here": list(map(_text, ours)), "there": [list(map(_text, names)) for names in theirs]}
            for node, ours, theirs in report.differing
        ],
    }


def _pair_words(joint: JointMap, each: KeptApart) -> str:
    """v1/0/3 v2/0/7 (0.021 m, 2.9 sigma); without what is not known."""
    at = [i for i, names in enumerate(joint.names) if each.a in names or each.b in names]
    known = []
    if len(at) == 2:
        known.append(f"{np.linalg.norm(joint.landmark_mean[at[0]] - joint.landmark_mean[at[1]]):.3f} m")
    if each.d2 is not None:
        known.append(f"{math.sqrt(each.d2):.1f} sigma")
    return f"{_text(each.a)} {_text(each.b)}" + (f" ({', '.join(known)})" if known else "")


def _names(names: Iterable[LandmarkName]) -> str:
    texts = [_text(name) for name in names]
    return " ".join(texts[:NAMES_MAX]) + _more(len(texts) - NAMES_MAX)


def _text(name: LandmarkName) -> str:
    return "/".join(map(str, name))


def _more(count: int) -> str:
    return f" and {count} more" if count > 0 else ""


def _table(first: str, *others: str) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(first, justify="right", no_wrap=True)
    for head in others:
        table.add_column(head)
    return table
