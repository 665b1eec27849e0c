"""How often vehicles find a way back from doubt, and what it is worth: python -m tests.ways_back --seeds 1..45.

Vehicle v1 of three_air_vehicles_unknown with noise half way to the paper's, by itself, for STEPS steps. A line for each
seed on which it takes a way back: with it and without it.
"""

import argparse
from unittest import mock

from fleet_seif import frames as frames_module
from fleet_seif.config import FilterSettings
from fleet_seif.frames import FramedFilter
from scenarios.association import Association, associate
from scenarios.chaos_runs import seed_range
from scenarios.config import load_scenario
from scenarios.recording import Log
from scenarios.source import record
from tests.identities import HALFWAY

STEPS = 220


def flown(log: Log) -> FramedFilter:
    """One vehicle's filter after a whole drive."""
    framed = FramedFilter(FilterSettings(identities="associated"))
    framed.start(log.sightings_at(0))
    for reading in log.readings():
        framed.step(reading)
    framed.end()
    return framed


def said(found: Association, doubtful: bool) -> str:
    return (
        f"{found.duplicate_landmarks:3d} duplicates, precision {found.precision or 0.0:.4f}, recall"
        f" {found.recall or 0.0:.4f}{', doubtful' if doubtful else '          '}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="1..45", type=seed_range)
    for seed in parser.parse_args().seeds:
        scenario = load_scenario("three_air_vehicles_unknown", (f"world.steps={STEPS}", *HALFWAY), seed)
        log = record(scenario, "v1").logs["v1"]
        with mock.patch.object(FramedFilter, "_take_back", autospec=True, side_effect=FramedFilter._take_back) as taken:
            framed = flown(log)
        if not taken.called:
            continue
        with mock.patch.object(frames_module, "told_anew", return_value=None):
            without = flown(log)
        ours, other = (said(associate(log, each.assigned), each.doubtful) for each in (framed, without))
        print(f"seed {seed:3d}, {taken.call_count} taken: {ours}; without: {other}", flush=True)


if __name__ == "__main__":
    main()
