"""How many messages a fusion node takes in, printed (run with -s); what is asserted are ratios within one run."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fleet_seif.config import FilterSettings, FusionSettings, PublishSettings
from fleet_seif.envelope import KIND_DELTA, unseal
from fleet_seif.messages import Epoch
from fleet_seif.signing import KeyRing, Role, Signer, generate_signer
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.warm_up import warm_up
from fusion import records
from fusion.ledger import Ledger, Receipt
from scenarios.config import load_scenario
from scenarios.source import record
from vehicles.core import Identity, VehicleCore

pytestmark = [pytest.mark.slow, pytest.mark.alone]
GROUP = 256
STEPS = 2000


@cache
def signers() -> tuple[Signer, ...]:
    return tuple(generate_signer("f", Role.VEHICLE, f"v{i}") for i in (1, 2, 3))


@cache
def messages(signed: bool) -> list[tuple[str, bytes]]:
    """What three vehicles publish in 2,000 steps among 50 landmarks, in turn: 1.3 kB a message."""
    warm_up()
    scenario = load_scenario("three_air_vehicles_mild", (f"world.steps={STEPS}", "filter.active_max=6"))
    streams = []
    for signer, (name, log) in zip(signers(), record(scenario).logs.items(), strict=True):
        identity = Identity(
            fleet="f", vehicle=name, epoch=Epoch(1, 1), start_pose=log.start_pose, start_pose_cov=log.start_pose_cov
        )
        core = VehicleCore(
            identity, FilterSettings(active_max=6), PublishSettings(window=10**5), signer=signer if signed else None
        )
        core.start(0.0, log.sightings_at(0))
        for reading in log.readings():
            core.step(reading)
        core.end()
        core.note_commit(core.take_changes()[1])
        streams.append([(name, data) for data in core.release()])
    return [each for turn in zip(*streams, strict=True) for each in turn]


def rate(run: Callable[[], Iterator[object]]) -> float:
    """Messages a second, the best of three runs: machines are shared."""
    seconds = []
    count = 0
    for _ in range(3):
        begin = time.perf_counter()
        count = sum(1 for _ in run())
        seconds.append(time.perf_counter() - begin)
    return count / min(seconds)


def folded(ledger: Ledger, signed: bool) -> Iterator[object]:
    for name, data in messages(signed):
        receipt, stream = ledger.accept(data, name)
        assert receipt is Receipt.FOLDED, stream.fault
        yield receipt


def opened() -> Iterator[object]:
    """The least that a message costs: digest checked, msgpack opened."""
    for _, data in messages(False):
        yield unseal(KIND_DELTA, data)


def test_folding_a_message_costs_little_beside_opening_it() -> None:
    """Measured: an eighth on one machine, a fifteenth to a twentieth on another; a signature makes it half to a quarter
    as fast. The limits are twice the worst of that."""
    bare = rate(opened)
    plain = rate(lambda: folded(Ledger("f"), False))
    ring = KeyRing("f", {(Role.VEHICLE, s.name): s.public_key() for s in signers()})
    signed = rate(lambda: folded(Ledger("f", keys=ring), True))
    size = np.mean([len(data) for _, data in messages(False)])
    print(f"decoded, validated, folded, {size:.0f} bytes each: {plain:.0f} a second, signed {signed:.0f}")
    print(f"opened {bare / plain:.1f} times as many; a signed one costs {plain / signed:.1f} times an unsigned one")
    assert plain > bare / 40
    assert signed > plain / 10


def test_making_messages_durable_keeps_a_fifth_of_the_rate(tmp_path: Path) -> None:
    number = iter(range(100))

    def durable() -> Iterator[object]:
        store = SqliteStore.open(tmp_path / f"{next(number)}.ledger", records.KIND, records.SCHEMA)
        ledger = Ledger("f", FusionSettings())
        for k, receipt in enumerate(folded(ledger, False), start=1):
            if k % GROUP == 0:
                store.commit(ledger.take_changes())
            yield receipt
        store.commit(ledger.take_changes())
        store.close()

    plain, found = rate(lambda: folded(Ledger("f"), False)), rate(durable)
    print(f"folded and durable, {GROUP} a commit: {found:.0f} a second, {plain:.0f} in memory")
    assert found > plain / 5


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("frames", "behind_s"), [("single", 0.5), ("adaptive", 1.5)])
def test_ten_vehicles_at_twenty_hertz_for_a_minute_leave_no_gap_and_a_fresh_map(
    frames: str, behind_s: float, tmp_path: Path
) -> None:
    """All vehicles cross one small world in step: with frames most of the joint system changes with every map."""
    settings = (
        "fleet.vehicles=10", "world.landmarks=170", "world.steps=1200", "run.rate_hz=20", f"filter.frames={frames}",
    )  # fmt: skip
    arguments = [part for item in settings for part in ("--set", item)]
    command = [sys.executable, "-m", "scenarios", "run", "fleet", *arguments, "--out", str(tmp_path), "--quiet"]
    subprocess.run(command, check=True)
    report = json.loads((tmp_path / "report.json").read_text())
    print(f"10 vehicles at 20 Hz for 60 s, {frames}:", report["fusion"])
    assert all(v["deltas_folded"] == v["deltas_published"] and v["parked"] == 0 for v in report["vehicles"].values())
    pause_s = report["fusion"]["final_map_s"]  # a canonical map, should there be a pause to begin one in
    assert report["fusion"]["map_behind_s_p99"] < behind_s + pause_s
