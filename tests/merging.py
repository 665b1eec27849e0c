"""Merging by place alone, scored by signatures: python -m tests.merging --scenario NAME --seeds 1..20 [--set T.K=V].

Vehicles map with signatures, so each vehicle's own map is associated as it should be. Then the signatures are taken
away, and what the fleet finds to be one is compared with what they say. Other worlds are made by hand:

--made N: three vehicles that have driven through N landmarks, one a square metre (tests.refresh), to see how long it
takes. --drift D: two maps of 30 landmarks each in 7 by 7 metres, 20 of them the same, that begin D metres from where
they say, anywhere, even a few centimetres from each other.
"""

import argparse
import dataclasses
import pickle
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleet_seif.joint import Life, Pair, landmark_classes
from fleet_seif.joint_records import Classes
from fleet_seif.merging import MergeRules, Merges, merged
from fleet_seif.records import UNKNOWN_SIGNATURE
from scenarios.chaos_runs import seed_range
from tests.fleets import run_virtual
from tests.made_lives import made_life
from tests.refresh import fleet

HEAD = f"{'seed':>8} {'true':>6} {'wrong':>6} {'missed':>7} {'found %':>8} {'refused':>8} {'s':>7}"


class Score(NamedTuple):
    """Pairs of different lives' landmarks: one in truth, merged wrongly, missed; refused: pairs kept apart; seconds."""

    true: int
    wrong: int
    missed: int
    refused: int
    spent_s: float


def without_signatures(lives: Sequence[Life]) -> list[Life]:
    return [dataclasses.replace(life, signatures=(UNKNOWN_SIGNATURE,) * len(life.signatures)) for life in lives]


def pairs_in(classes: Classes) -> set[Pair]:
    """Pairs of different lives' landmarks that are one."""
    return {
        (a, b)
        for names in classes
        for i, a in enumerate(names)
        for b in names[i + 1 :]
        if (a.vehicle, a.life) != (b.vehicle, b.life)
    }


def score(lives: Sequence[Life], rules: MergeRules) -> tuple[Score, Merges]:
    truth = pairs_in(landmark_classes(lives))
    blank = without_signatures(lives)
    begin = time.perf_counter()
    merges = merged(blank, rules=rules)
    spent_s = time.perf_counter() - begin
    found = pairs_in(merges.classes)
    return Score(len(truth), len(found - truth), len(truth - found), len(merges.refused), spent_s), merges


def lives_of(scenario: str, seed: int, settings: tuple[str, ...], kept: Path | None) -> tuple[Life, ...]:
    """What a virtual run leaves; `kept`: a folder where it is kept for the next time."""
    file = None if kept is None else kept / f"{'_'.join([scenario, str(seed), *settings])}.pkl"
    if file is not None and file.exists():
        lives: tuple[Life, ...] = pickle.loads(file.read_bytes())
        return lives
    lives = run_virtual(scenario, *settings, seed=seed).ledger.lives()
    if file is not None:
        file.write_bytes(pickle.dumps(lives))
    return lives


def made_lives(landmarks: int) -> list[Life]:
    """Three vehicles of 120 frames each, more where there are more landmarks."""
    return [drive.life() for drive in fleet(landmarks, 3, max(landmarks * 120 // 1000, 4), 0.3)]


def drifted_lives(drift_m: float, seed: int) -> list[Life]:
    rng = np.random.default_rng(seed)
    world = rng.uniform(0.0, 7.0, (40, 2))
    return [
        made_life(
            name, world[seen], rng, drift_m=drift_m, noise_m=0.02, turn_rad=0.02,
            signatures=range(seen.start or 0, seen.stop),
        )
        for name, seen in (("a", slice(0, 30)), ("b", slice(10, 40)))
    ]  # fmt: skip


def line(name: str, s: Score) -> str:
    found = 100.0 * (s.true - s.missed) / max(s.true, 1)
    return f"{name:>8} {s.true:6d} {s.wrong:6d} {s.missed:7d} {found:8.2f} {s.refused:8d} {s.spent_s:7.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="three_air_vehicles_mild")
    parser.add_argument("--seeds", default="1..20", type=seed_range)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="TABLE.KEY=VALUE")
    parser.add_argument("--by", default="joint", choices=["joint", "clique"])
    parser.add_argument("--made", type=int, metavar="N")
    parser.add_argument("--drift", type=float, metavar="D")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the lives of each run here, for the next time")
    parser.add_argument("--quiet", action="store_true", help="only the sum")
    asked = parser.parse_args()
    rules = MergeRules(by=asked.by)
    name = f"made {asked.made}" if asked.made else f"drift {asked.drift}" if asked.drift else asked.scenario
    print(f"{name} by {asked.by} {' '.join(asked.settings)}\n{HEAD}")
    rows: list[Score] = []
    for seed in asked.seeds:
        if asked.made:
            lives: Sequence[Life] = made_lives(asked.made)
        elif asked.drift:
            lives = drifted_lives(asked.drift, seed)
        else:
            lives = lives_of(asked.scenario, seed, tuple(asked.settings), asked.keep)
        if not rows:
            score(lives, rules)  # kernels are loaded
        rows.append(score(lives, rules)[0])
        if not asked.quiet:
            print(line(str(seed), rows[-1]), flush=True)
    print(line("all", Score(*(sum(column) for column in zip(*rows, strict=True)))))


if __name__ == "__main__":
    main()
