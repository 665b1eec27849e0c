"""How long things take, printed; the limits are wide, machines are shared. Run with -s to see the figures."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from fleet_seif.config import FilterSettings
from fleet_seif.records import Floats, Ints
from scenarios.config import load_scenario
from scenarios.source import record
from tests.bytes_per_step import table
from vehicles import Vehicle

pytestmark = [pytest.mark.slow, pytest.mark.alone]


def timed_drive(landmarks: int, frames: Literal["single", "adaptive"]) -> tuple[Floats, Ints]:
    """Seconds of each step of one vehicle, its map not solved meanwhile, and how many sightings it had."""
    settings = ("fleet.vehicles=1", f"world.landmarks={landmarks}", "world.steps=4000")
    (log,) = record(load_scenario("fleet", settings)).logs.values()
    vehicle = Vehicle("v1", settings=FilterSettings(frames=frames, active_max=6, localise_steps=10_000))
    vehicle.start(log.sightings_at(0), time_s=0.0)
    seconds, seen = [], []
    for reading in log.readings():
        vehicle.step(reading.odometry, reading.odometry_cov, reading.sightings, time_s=reading.time_s)
        seconds.append(vehicle.filter_s)
        seen.append(len(reading.sightings.z))
    return np.array(seconds), np.array(seen)


def test_a_step_with_six_sightings_takes_tens_of_microseconds_at_any_map_size() -> None:
    medians: dict[str, dict[int, float]] = {"single": {}, "adaptive": {}}
    frames: Literal["single", "adaptive"]
    for landmarks in (50, 500, 5000):
        for frames in ("single", "adaptive"):
            seconds, seen = timed_drive(landmarks, frames)
            medians[frames][landmarks] = round(float(np.median(seconds[seen == 6]) * 1e6), 1)
    print("step with 6 sightings, 6 active landmarks, delta and message included, median us by map size:", medians)
    for sizes in medians.values():
        assert max(sizes.values()) < 2 * min(sizes.values())
    ratio = np.median([medians["adaptive"][size] / single for size, single in medians["single"].items()])
    print(f"with frames over a single frame: {ratio:.2f}")
    assert ratio < 1.5


def test_a_vehicle_is_ready_in_five_seconds_with_cached_kernels() -> None:
    code = "from fleet_seif.warm_up import warm_up; import fleet_seif.bus, vehicles, scenarios.source; warm_up()"
    subprocess.run([sys.executable, "-c", code], check=True)
    begin = time.monotonic()
    subprocess.run([sys.executable, "-c", code], check=True)
    seconds = time.monotonic() - begin
    print(f"imports and warm-up with cached kernels: {seconds:.1f} s")
    assert seconds < 5


def test_bytes_per_step_stay_flat_from_50_to_5000_landmarks() -> None:
    rows = table()
    print("bytes a step by landmarks in the map:", rows)
    assert max(rows.values()) < 1.5 * min(rows.values())


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("frames", "behind_s"), [("single", 1.0), ("adaptive", 2.0)])
def test_twenty_vehicles_at_ten_hertz_leave_no_gap_and_a_fresh_map(
    frames: str, behind_s: float, tmp_path: Path
) -> None:
    settings = ["fleet.vehicles=20", "world.landmarks=340", "world.steps=200", "run.rate_hz=10"]
    settings.append(f"filter.frames={frames}")
    arguments = [part for item in settings for part in ("--set", item)]
    command = [sys.executable, "-m", "scenarios", "run", "fleet", *arguments, "--out", str(tmp_path), "--quiet"]
    subprocess.run(command, check=True)
    report = json.loads((tmp_path / "report.json").read_text())
    print(f"20 vehicles at 10 Hz, {frames}:", report["fusion"])
    assert all(v["deltas_folded"] == v["deltas_published"] and v["parked"] == 0 for v in report["vehicles"].values())
    assert report["fusion"]["map_behind_s_p99"] < behind_s
