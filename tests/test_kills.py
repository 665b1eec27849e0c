"""kill -9 of real processes: the run ends as if nothing had happened."""

import json
import random
from collections import Counter
from pathlib import Path

import pytest

from fleet_seif.messages import Ack, Epoch
from fusion.ledger import Ledger
from tests import kills
from tests.fleets import run_virtual
from tests.processes import command, toml

RATE_HZ = 40
STEPS = 240
Event = dict[str, object]


def kill(who: str, at_s: float, for_s: float = 0.1) -> Event:
    return {"at_s": round(at_s, 3), "what": "kill", "who": who, "for_s": round(for_s, 3)}


def digest_of_run(folder: Path, settings: list[str], events: list[Event]) -> tuple[str, Counter[str]]:
    """Digest of a launched run with faults, and how often each vehicle was started again."""
    arguments = [part for each in [*settings, f"faults.events={toml(events)}"] for part in ("--set", each)]
    done = command("run", "fleet", *arguments, "--out", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    streams = json.loads((folder / "process" / "fusion.json").read_text())["streams"]
    assert "Traceback" not in done.stderr
    starts = Counter({name: facts["epochs"] - 1 for name, facts in streams.items()})
    return json.loads((folder / "report.json").read_text())["digest"], starts


def expected_digest(settings: list[str]) -> str:
    return run_virtual("fleet", *settings).ledger.map_digest().hex()


def test_a_killed_vehicle_and_a_killed_fusion_node_change_nothing(tmp_path: Path) -> None:
    settings = ["fleet.vehicles=1", "world.steps=40", "world.landmarks=30", f"run.rate_hz={RATE_HZ}"]
    digest, starts = digest_of_run(tmp_path, settings, [kill("v1", 0.4), kill("fusion", 0.6)])
    assert digest == expected_digest(settings)
    assert starts == Counter(v1=1)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_ten_kills_of_a_launched_fleet_change_nothing(tmp_path: Path) -> None:
    rng = random.Random(3)
    names = ["v1", "v2", "v3", "fusion", "fusion2"]
    victims = [*rng.sample(names, 5), *rng.sample(names, 5)]
    events = [kill(who, 0.3 + 1.1 * i + rng.uniform(0, 1), rng.uniform(0, 0.5)) for i, who in enumerate(victims)]
    settings = ["fleet.vehicles=3", "fleet.nodes=2", f"world.steps={STEPS}", f"run.rate_hz={RATE_HZ / 2}"]
    digest, starts = digest_of_run(tmp_path, settings, events)
    assert digest == expected_digest(settings)
    print(f"10 kills by the launcher, vehicles started again: {dict(starts)}")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_ten_kills_lose_nothing_that_was_acknowledged(tmp_path: Path) -> None:
    killed = kills.survive(10, 11, tmp_path, 2 * STEPS)
    print(f"10 kills by hand: {killed}")
    assert sum(killed.values()) == 10


def test_the_check_after_a_kill_notices_what_is_gone_or_another() -> None:
    ledger = run_virtual("fleet", "fleet.vehicles=1", "world.steps=10", "world.landmarks=10").ledger
    (stream,) = ledger.streams.values()

    def ack(**changes: object) -> Ack:
        right = {"last": stream.next - 1, "prefix_digest": stream.prefix_digest, "epoch": stream.epoch}
        return Ack(fleet="fleet", node="fusion", vehicle="v1", **(right | changes))  # type: ignore[arg-type]

    kills.check_kept(ledger, [ack()])
    wrong = {"last": stream.next}, {"prefix_digest": bytes(32)}, {"epoch": Epoch(99, 0)}
    for changes in wrong:
        with pytest.raises(AssertionError):
            kills.check_kept(ledger, [ack(**changes)])
    with pytest.raises(AssertionError):
        kills.check_kept(Ledger("fleet"), [ack()])


@pytest.mark.slow
def test_a_vehicle_that_is_killed_after_its_last_step_finds_a_node_when_it_starts_again(tmp_path: Path) -> None:
    settings = ["fleet.vehicles=1", "world.steps=40", "world.landmarks=30", f"run.rate_hz={RATE_HZ}", "link.delay_s=1"]
    # it takes its last step at 1 s, the node has all of it at 2 s, and it hears so at 3 s
    digest, _ = digest_of_run(tmp_path, settings, [kill("v1", 2.5, for_s=2.0)])
    assert digest == expected_digest(settings)
