"""Runs without identities against what is asked of them: python -m tests.associating --seeds 1..50 [--set T.K=V].

Each seed is run twice, as it is and told which landmark each sighting is of; what the columns mean stands at the head
of `tests.identities`. --ceiling runs neither: it lets the gates and the joint decision choose among the true landmarks,
seen from the true poses.
"""

import argparse
from collections.abc import Sequence
from typing import Final

from scenarios.association import Association
from scenarios.chaos_runs import seed_range
from scenarios.config import load_scenario
from scenarios.source import record
from tests.association_ceiling import ceiling
from tests.identities import (
    DUPLICATES_MAX,
    OFF_M,
    OFF_RATIO,
    PRECISION_LEAST,
    Errors,
    SeedScore,
    pooled_association,
    pooled_errors,
    score,
)

HEAD: Final = (
    f"{'seed':>5} {'div':>3} {'flag':>4} {'found':>5} {'wrong':>5} {'miss':>4} {'known':>5} "
    f"{'precision':>9} {'recall':>7} {'dup':>3} {'spur':>4} {'error m':>8} {'known m':>8} {'ratio':>6}"
)
RULES: Final = (
    f"diverged: precision below {PRECISION_LEAST}, {DUPLICATES_MAX} duplicates or more, or own map off: error above "
    f"{OFF_M} m and {OFF_RATIO} times that with identities\n"
    "found, wrong, missed merges; known: merges with identities; of vehicles that are not flagged, as all that follows"
)


def share(value: float | None) -> float:
    return float("nan") if value is None else value


def line(name: str, rows: Sequence[SeedScore]) -> str:
    """One seed, or several together."""
    of, at = pooled_association(rows), pooled_errors(rows)
    counts = [sum(getattr(row, field) for row in rows) for field in ("diverged", "flagged", "found", "wrong", "missed")]
    diverged, flagged, found, wrong, missed = counts
    return (
        f"{name:>5} {diverged:3d} {flagged:4d} {found:5d} {wrong:5d} {missed:4d} {sum(r.known for r in rows):5d} "
        f"{share(of.precision):9.4f} {share(of.recall):7.4f} {of.duplicate_landmarks:3d} {of.spurious_landmarks:4d} "
        f"{at.ours_m:8.5f} {at.known_m:8.5f} {at.ratio:6.3f}"
    )


def targets(rows: Sequence[SeedScore]) -> str:
    """What is asked of all seeds together, what came out, and whether that is enough."""
    vehicles = [each for row in rows for each in row.vehicles]
    sound, diverged = sum(not row.diverged for row in rows), sum(each.diverged for each in vehicles)
    silent = sum(each.diverged and not each.flagged for each in vehicles)
    blamed = sum(each.flagged and not each.diverged for each in vehicles)
    found, wrong, missed = (sum(getattr(row, field) for row in rows) for field in ("found", "wrong", "missed"))
    of, ratio = pooled_association(rows), pooled_errors(rows).ratio
    worst = max(rows, key=lambda row: row.fused.ratio if row.fused.known else 0.0)
    precision, recall, true = share(of.precision), share(of.recall), found / max(found + missed, 1)
    table = (
        ("seeds without a diverged vehicle", ">= 47/50", f"{sound}/{len(rows)}", 50 * sound >= 47 * len(rows)),
        ("diverged vehicles, not flagged", "0", f"{silent} of {diverged}", silent == 0),
        ("healthy vehicles, flagged", "0", f"{blamed} of {len(vehicles) - diverged}", blamed == 0),
        ("wrong merges", "0", f"{wrong}", wrong == 0),
        ("true merges found", ">= 0.99", f"{true:.4f} ({found} of {found + missed})", true >= 0.99),
        ("precision", ">= 0.998", f"{precision:.5f}", precision >= 0.998),
        ("recall", ">= 0.98", f"{recall:.5f}", recall >= 0.98),
        ("error ratio", "<= 1.05", f"{ratio:.4f}", ratio <= 1.05),
        ("error ratio of the worst seed", "<= 1.25", f"{worst.fused.ratio:.4f} (seed {worst.seed})",
         worst.fused.ratio <= 1.25),
    )  # fmt: skip
    lines = [f"{what:<34} {asked:>9}   {'ok' if good else 'MISSED':<6}  {out}" for what, asked, out, good in table]
    everyone = sum((row.fused_all for row in rows), start=Errors()).ratio
    return "\n".join([*lines, f"{'error ratio, flagged ones known':<34} {'':>9}   {'':<6}  {everyone:.4f}"])


def ceilings(scenario: str, seeds: Sequence[int], settings: tuple[str, ...]) -> None:
    """A line for each seed, and all together."""
    print(f"{'seed':>5} {'precision':>9} {'recall':>7}")
    total = Association()
    for seed in seeds:
        loaded = load_scenario(scenario, settings, seed)
        found = ceiling(record(loaded), loaded.filter.association)
        total += found
        print(f"{seed:>5} {share(found.precision):9.4f} {share(found.recall):7.4f}", flush=True)
    print(f"{'all':>5} {share(total.precision):9.5f} {share(total.recall):7.5f}")


def runs(scenario: str, seeds: Sequence[int], settings: tuple[str, ...]) -> None:
    """A line for each seed, what is to be said of its vehicles, and all together."""
    print(f"{RULES}\n{HEAD}")
    rows = []
    for seed in seeds:
        row = score(scenario, load_scenario(scenario, settings, seed))
        rows.append(row)
        print(line(str(seed), [row]), flush=True)
        for remark in row.remarks:
            print(f"      {remark}", flush=True)
    print(f"{line('all', rows)}\n\n{targets(rows)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="three_air_vehicles_unknown")
    parser.add_argument("--seeds", default="1..50", type=seed_range)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="TABLE.KEY=VALUE")
    parser.add_argument("--ceiling", action="store_true", help="with the true poses and the true map")
    asked = parser.parse_args()
    print(f"{asked.scenario} {' '.join(asked.settings)}", flush=True)
    (ceilings if asked.ceiling else runs)(asked.scenario, asked.seeds, tuple(asked.settings))


if __name__ == "__main__":
    main()
