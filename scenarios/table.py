"""A report as a table for the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text


def _number(value: Any, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def association_words(scored: Mapping[str, Any]) -> str:
    """How well the fleet told which landmark each sighting is of. scored: has `Association.fields`."""
    return (
        f"association: precision {_number(scored['association_precision'], 4)}, "
        f"recall {_number(scored['association_recall'], 4)}, "
        f"duplicate landmarks {scored['duplicate_landmarks']}, spurious {scored['spurious_landmarks']}"
    )


def report_table(report: dict[str, Any]) -> Group:
    """Vehicles in rows, then the fused map in words."""
    title = f"{report['scenario']}, seed {report['seed']}, {report['steps']} steps, {report['wall_s']:.1f} s"
    table = Table(title=title, box=None, padding=(0, 1))
    for head in ("vehicle", "map m", "pose m", "step us", "p99", "put us", "bytes", "folded", "twice", "repaired"):
        table.add_column(head, no_wrap=True, justify="left" if head == "vehicle" else "right")
    for name, row in report["vehicles"].items():
        table.add_row(
            name,
            _number(row["landmark_rmse_m"], 4),
            _number(row["pose_rmse_m"], 4),
            _number(row["step_us_p50"], 0),
            _number(row["step_us_p99"], 0),
            _number(row["publish_us_p50"], 0),
            _number(row["bytes_per_step_mean"], 0),
            *(str(row[key]) for key in ("deltas_folded", "duplicates", "gaps_repaired")),
        )
    refused = {name: row["readings_refused"] for name, row in report["vehicles"].items() if row["readings_refused"]}
    lines = [
        f"fused map: {report['fused_landmarks']} landmarks ({report['truth_landmarks']} seen in truth), "
        f"error {_number(report['landmark_rmse_m'], 4)} m, aligned {_number(report['landmark_rmse_aligned_m'], 4)} m, "
        f"NEES per dof {_number(report['nees_per_dof'], 2)}",
        association_words(report),
        f"merges {report['merges']}, wrong {report['wrong_merges']}, missed {report['missed_merges']}",
        *(f"{n} readings of {name} were refused: its map lacks them" for name, n in refused.items()),
        *(f"{n} is doubtful: it says that its filter has failed" for n in report["doubtful_vehicles"]),
        *(f"{n} is quarantined: {row['quarantine']}" for n, row in report["vehicles"].items() if row["quarantine"]),
        f"digest {report['digest'][:16]}",
    ]
    return Group(table, Text("\n".join(lines)))
