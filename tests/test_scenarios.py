"""What the shipped scenarios must reach, as whole fleets on a virtual clock."""

import numpy as np
import pytest

from fleet_seif.joint import solve
from fleet_seif.wire import decode_message
from scenarios.report import Outcome
from tests import real_data
from tests.fleets import outcome_of, run_virtual

SEEDS = range(1, 21)
FRAMES = ("single", "adaptive")
LOSSY = ("link.loss=0.3", "link.duplication=0.2", "link.jitter_s=2.0")


def is_good(outcome: Outcome) -> bool:
    """The paper's findings: all landmarks, right merges, uncertainty drops at both meetings, fusion helps."""
    score, report = outcome.score, outcome.report
    singles = [vehicle["landmark_rmse_m"] for vehicle in report["vehicles"].values()]
    drops = [m["uncertainty_after_m2"] < m["uncertainty_before_m2"] for m in report["meetings"][:2]]
    assert score.landmark_rmse_m is not None
    return (
        score.fused_landmarks == score.truth_landmarks == score.matched_landmarks == 50
        and score.wrong_merges == score.missed_merges == 0
        and drops == [True, True]
        and bool(score.landmark_rmse_m < np.mean(singles))
    )


@pytest.mark.parametrize("frames", FRAMES)
def test_three_air_vehicles_reproduces_the_papers_findings(frames: str) -> None:
    outcome = outcome_of("three_air_vehicles", f"filter.frames={frames}")
    assert is_good(outcome), outcome.report
    steps = [(m["vehicles"], m["step"]) for m in outcome.report["meetings"][:2]]
    assert steps[0][0] == ["v1", "v2"]
    assert 62 <= steps[0][1] <= 64
    assert steps[1][0] == ["v2", "v3"]
    assert 85 <= steps[1][1] <= 89


@pytest.mark.slow
@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("name", ["three_air_vehicles", "three_air_vehicles_mild"])
def test_at_least_18_of_20_seeds_reproduce_the_papers_findings(name: str, frames: str) -> None:
    outcomes = {seed: outcome_of(name, f"filter.frames={frames}", seed=seed) for seed in SEEDS}
    errors = [outcome.report["landmark_rmse_m"] for outcome in outcomes.values()]
    bad = [seed for seed, outcome in outcomes.items() if not is_good(outcome)]
    print(f"{name}, {frames}: error median {np.median(errors):.4f} m, worst {max(errors):.4f} m, seeds not good {bad}")
    assert len(bad) <= 2


def digest_of(*settings: str, seed: int) -> bytes:
    return run_virtual("three_air_vehicles_mild", *settings, seed=seed).ledger.map_digest()


def test_a_lossy_link_leaves_the_map_of_a_perfect_one_to_the_bit() -> None:
    steps = "world.steps=120"
    perfect, lossy = run_virtual("three_air_vehicles", steps), run_virtual("lossy_link", steps)
    assert lossy.ledger.map_digest() == perfect.ledger.map_digest()
    facts = lossy.streams.values()
    assert sum(f["duplicates"] for f in facts) > 0
    assert sum(f["gaps_repaired"] for f in facts) > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_lossy_link_leaves_the_map_of_a_perfect_one_over_seeds(seed: int) -> None:
    assert digest_of(*LOSSY, seed=seed) == digest_of(seed=seed)


def test_the_same_seed_gives_the_same_run_and_another_seed_another() -> None:
    digests = [digest_of("world.steps=100", seed=seed) for seed in (5, 5, 6)]
    assert digests[0] == digests[1] != digests[2]


def test_a_rate_does_not_change_the_map() -> None:
    fast, paced = digest_of("world.steps=100", seed=3), digest_of("world.steps=100", "run.rate_hz=20", seed=3)
    assert fast == paced


def test_a_small_window_and_a_small_outbox_do_not_change_the_map() -> None:
    """A full outbox coalesces what has not been sent: the sum stays."""
    plain = run_virtual("three_air_vehicles_mild", "world.steps=150", seed=2)
    tight = run_virtual(
        "three_air_vehicles_mild", "world.steps=150", "publish.window=4", "publish.outbox_max=16", "run.rate_hz=1000",
        "link.delay_s=0.5", seed=2,
    )  # fmt: skip
    assert tight.ledger.map_digest() == plain.ledger.map_digest()
    assert max(len(s.log) for s in tight.ledger.streams.values()) < 100


@pytest.mark.parametrize("frames", FRAMES)
def test_messages_of_several_steps_give_the_same_map_with_fewer_bytes(frames: str) -> None:
    """A message ends where a frame does, so that none covers more than a frame."""
    settings = ("world.steps=150", f"filter.frames={frames}")
    runs = [run_virtual("three_air_vehicles_mild", *settings, f"publish.every_steps={n}", seed=2) for n in (1, 5, 100)]
    assert len({run.ledger.map_digest() for run in runs}) == 1
    put = [sum(each.bytes_put for each in run.drives.values()) for run in runs]
    assert put[0] > 2 * put[1] > 2 * put[2]
    messages = [decode_message(data) for s in runs[-1].ledger.streams.values() for data in s.log]
    covered = [message.last - message.first + 1 for message in messages]
    assert max(covered) == (25 if frames == "adaptive" else 100)


def test_bytes_per_step_do_not_grow_with_the_map() -> None:
    means = []
    for landmarks in (50, 500, 5000):
        run = run_virtual(
            "fleet", "fleet.vehicles=1", f"world.landmarks={landmarks}", "world.steps=400", "run.rate_hz=0"
        )
        means.append(next(iter(run.drives.values())).bytes_put / 400)
    assert max(means) < 1.5 * min(means), means


def test_joint_map_is_solved_from_nothing_to_the_same_bits() -> None:
    run = run_virtual("three_air_vehicles", "world.steps=100")
    lives = run.ledger.lives()
    first, second = (solve(lives, run.ledger.classes(lives)) for _ in range(2))
    assert np.array_equal(first.mean, second.mean)
    assert np.array_equal(first.H.toarray(), second.H.toarray())


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("number", "absolute_m", "aligned_m"), [(2, 0.09, 0.03), (6, 0.19, 0.045)])
def test_five_real_robots_do_not_diverge(
    number: int, absolute_m: float, aligned_m: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = real_data.mrclam(number, tmp_path_factory)
    outcome = outcome_of("mrclam", f"dataset.path={folder}")
    report = outcome.report
    print(
        f"MR.CLAM {number}: absolute {report['landmark_rmse_m']:.3f}, aligned {report['landmark_rmse_aligned_m']:.3f}"
    )
    assert report["fused_landmarks"] == 15
    assert report["wrong_merges"] == report["missed_merges"] == 0
    assert report["landmark_rmse_m"] < absolute_m
    assert report["landmark_rmse_aligned_m"] < aligned_m
    assert all(v["pose_rmse_m"] < 4.0 for v in report["vehicles"].values())
