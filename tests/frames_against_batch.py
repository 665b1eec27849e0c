"""Fused maps against the batch over many seeds: python -m tests.frames_against_batch --seeds 1..20 [--set T.K=V]."""

import argparse
from functools import cache

import numpy as np

from scenarios.batch import BatchSolution, solve_batch
from scenarios.chaos_runs import seed_range
from scenarios.config import load_scenario
from scenarios.evaluate import Comparison, ratio_to_batch
from scenarios.source import record
from tests.fleets import run_virtual

HEAD = f"{'seed':>8} {'ours m':>9} {'batch m':>9} {'ratio':>7} {'aligned':>7} {'NEES':>7} {'batch':>6}"


@cache
def batch_of(scenario: str, seed: int) -> BatchSolution:
    """The batch of a shipped world: filter settings do not change its readings."""
    return solve_batch(record(load_scenario(scenario, (), seed)))


def compare(scenario: str, seed: int, settings: tuple[str, ...]) -> Comparison:
    """One run beside its batch."""
    run = run_virtual(scenario, *settings, seed=seed)
    changed = any(not setting.startswith(("filter.", "publish.", "fusion.", "link.")) for setting in settings)
    return ratio_to_batch(run, None if changed else batch_of(scenario, seed))


def numbers(found: Comparison) -> tuple[float, ...]:
    """A row of the table."""
    ours, batch = found.ours, found.batch
    values = (ours.rmse_m, batch.rmse_m, found.ratio, found.ratio_aligned, ours.nees_per_dof, batch.nees_per_dof)
    return tuple(float("nan") if value is None else value for value in values)


def line(name: str, row: tuple[float, ...]) -> str:
    ours, batch, ratio, aligned, nees, batch_nees = row
    return f"{name:>8} {ours:9.5f} {batch:9.5f} {ratio:7.3f} {aligned:7.3f} {nees:7.2f} {batch_nees:6.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="three_air_vehicles_mild")
    parser.add_argument("--seeds", default="1..20", type=seed_range)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="TABLE.KEY=VALUE")
    parser.add_argument("--quiet", action="store_true", help="only medians and worst")
    asked = parser.parse_args()
    print(f"{asked.scenario} {' '.join(asked.settings)}\n{HEAD}")
    rows = []
    for seed in asked.seeds:
        rows.append(numbers(compare(asked.scenario, seed, tuple(asked.settings))))
        if not asked.quiet:
            print(line(str(seed), rows[-1]), flush=True)
    table = np.array(rows)
    print(line("median", tuple(np.median(table, axis=0))))
    print(line("worst", tuple(np.max(table, axis=0))))


if __name__ == "__main__":
    main()
