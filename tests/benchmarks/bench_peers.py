"""The whole run of the paper's world beside the dense EKF and gtsam's iSAM2: the same readings, in the same process.

The run has 20 N steps. Two windows: all of them, and the last quarter. The EKF's step does not change once the map is
complete; iSAM2 keeps the path, so that its step goes on growing.

A step of iSAM2 takes milliseconds, and on a busy machine other work gets its turn meanwhile: iSAM2 is timed by the CPU
time of this process (it runs in one thread), our step by the wall clock. On a quiet machine the two agree.
"""

import time

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from fleet_seif.ekf import Ekf
from fleet_seif.seif import Seif
from scenarios.experiments import isam2
from scenarios.experiments.worlds import World, paper_world
from tests.benchmarks.conftest import Ratio
from tests.benchmarks.runs import SEED, SETTINGS, Run, median, run_in_turns, started

EKF_LANDMARKS = 50
ISAM2_LANDMARKS = 200
ISAM2_TARGET = 100.0


def compared(benchmark: BenchmarkFixture, seif: Run, peer: Run) -> tuple[float, float]:
    """Median step of the peer over ours: all steps, the last quarter."""
    run_in_turns(benchmark, seif, [peer])
    quarter = len(seif.us) // 4
    windows = {"all steps": slice(None), "last quarter": slice(-quarter, None)}
    us = {name: (median(seif.us[part]), median(peer.us[part])) for name, part in windows.items()}
    benchmark.extra_info["median us of a step, SEIF and the peer"] = us
    return us["all steps"][1] / us["all steps"][0], us["last quarter"][1] / us["last quarter"][0]


@pytest.mark.benchmark(group="SEIF's step beside a peer")
def test_a_step_beside_the_dense_ekf_at_50_landmarks(benchmark: BenchmarkFixture, ratio: Ratio) -> None:
    at = paper_world(EKF_LANDMARKS, SEED)
    seif, ekf = (started(made, at) for made in (Seif(SETTINGS), Ekf(SETTINGS)))
    whole, last = compared(benchmark, seif, ekf)
    ratio("ekf_over_step_at_50_landmarks", whole)
    ratio("ekf_over_step_at_50_landmarks_last_quarter", last)
    assert min(whole, last) > 1.0


@pytest.mark.timeout(900)
@pytest.mark.benchmark(group="SEIF's step beside a peer")
@pytest.mark.parametrize("mild", [False, True], ids=["paper_noise", "mild_noise"])
def test_a_step_beside_isam2_at_200_landmarks(mild: bool, benchmark: BenchmarkFixture, ratio: Ratio) -> None:
    if not isam2.is_installed():
        pytest.skip("gtsam is not installed: pip install -e '.[bench]'")
    at: World = paper_world(ISAM2_LANDMARKS, SEED, mild=mild)
    seif, peer = started(Seif(SETTINGS), at), started(isam2.Isam2(SETTINGS.start_information), at)
    peer.clock = time.process_time_ns
    whole, last = compared(benchmark, seif, peer)
    noise = "mild" if mild else "paper"
    ratio(f"isam2_over_step_at_200_landmarks_{noise}_noise", whole)
    ratio(f"isam2_over_step_at_200_landmarks_{noise}_noise_last_quarter", last)
    if not mild:
        assert min(whole, last) >= ISAM2_TARGET
