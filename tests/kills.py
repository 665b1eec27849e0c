"""kill -9 of real fusion nodes and vehicles at random times: nothing acknowledged is lost, nothing is applied twice.

`python -m tests.kills --kills 300` does it by hand, and says how far it is. Processes are killed at any moment of their
lives, while they start or read their stores too, and started again with what these hold.
"""

import argparse
import contextlib
import itertools
import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from fleet_seif.bus import open_bus
from fleet_seif.envelope import KIND_SNAPSHOT, body_digest, kind_of
from fleet_seif.keys import Keys
from fleet_seif.messages import Ack, Epoch
from fleet_seif.streams import EMPTY_PREFIX, extend_prefix
from fleet_seif.wire import decode_ack, decode_snapshot
from fusion.ledger import Ledger
from fusion.stream import Stream
from scenarios.output import read_ledger
from tests.fleets import run_virtual
from tests.processes import Child, Fleet, fleet_of

SCENARIO = "fleet"
NAME = "fleet"
NODES = ("fusion", "fusion2")
VEHICLES = ("v1", "v2", "v3")
STEPS = 1000
RATE_HZ = 20.0
PER_RUN = 30
PAUSE_S = (0.2, 2.8)  # between two kills
AT_WORK = 0.7  # share of kills that hit somebody who is at work, and not just starting, where there is one
DOWN_S = (0.0, 0.5)
END_S = 120.0
END_STEPS = 40
UNREACHABLE = "cannot reach a fusion node"


class Acks:
    """What nodes have acknowledged, as heard on the bus."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._best: dict[tuple[str, str, Epoch], Ack] = {}
        self.heard = 0

    def take(self, key: str, data: bytes) -> None:
        ack = decode_ack(data)
        with self._lock:
            self.heard += 1
            who = (ack.node, ack.vehicle, ack.epoch)
            if who not in self._best or self._best[who].last < ack.last:
                self._best[who] = ack

    def of(self, node: str) -> list[Ack]:
        """The furthest of each stream."""
        with self._lock:
            return [ack for (name, _, _), ack in self._best.items() if name == node]


def check_kept(ledger: Ledger, acks: list[Ack]) -> None:
    """Fail where a ledger lacks what was acknowledged, or holds something else in its place."""
    for ack in acks:
        stream = ledger.streams.get((ack.vehicle, ack.epoch))
        assert stream is not None, f"{ack.node} acknowledged {ack}, and holds nothing of it"
        assert stream.next > ack.last, f"{ack.node} acknowledged {ack.last} of {ack.vehicle}, holds {stream.next - 1}"
        known = dict(_digests(stream))
        assert known.get(ack.last, ack.prefix_digest) == ack.prefix_digest, f"{ack.node} holds another history: {ack}"


def _digests(stream: Stream) -> Iterator[tuple[int, bytes]]:
    """The prefix digest at every message that is held; a snapshot brings its own."""
    digest = EMPTY_PREFIX
    ends = [*(first - 1 for first in stream.firsts[1:]), stream.next - 1]
    for last, data in zip(ends, stream.log, strict=True):
        whole = kind_of(data) == KIND_SNAPSHOT
        digest = decode_snapshot(data).prefix_digest if whole else extend_prefix(digest, body_digest(data))
        yield last, digest


class Killer:
    """A fleet whose processes are killed and started again, one at a time."""

    def __init__(self, fleet: Fleet, rng: random.Random, steps: int) -> None:
        self.acks = Acks()
        self.killed = dict.fromkeys([*NODES, *VEHICLES], 0)
        self._fleet = fleet
        self._rng = rng
        self._near_the_end = steps - END_STEPS
        self._running: dict[str, Child] = {}
        self._endpoints: dict[str, str] = {}

    def start(self, listen: Callable[[str], None]) -> None:
        """Start everybody; `listen` is told where each node is."""
        for name in [*NODES, *VEHICLES]:
            self._start(name)
            if name in NODES:
                self._endpoints[name] = self._running[name].endpoint
                listen(self._endpoints[name])

    def _start(self, name: str) -> None:
        others = [endpoint for node, endpoint in self._endpoints.items() if node != name]
        if name in NODES:
            self._running[name] = self._fleet.node("--expected", str(len(VEHICLES)), name=name, connect=others)
        else:
            self._running[name] = self._fleet.vehicle(name, list(self._endpoints.values()))

    def _is_nearly_done(self, name: str) -> bool:
        """Whether a vehicle may end while it is down: then the nodes, having everything, may end before it is back."""
        told = self._running[name].find("progress")
        return name in VEHICLES and bool(told and told["done"] >= self._near_the_end)

    def _start_again(self) -> None:
        """Vehicles that found no node when they started, because both were down: what a supervisor is there for."""
        for name in VEHICLES:
            child = self._running[name]
            if not child.running and child.end() != 0 and any(UNREACHABLE in line for line in child.errors):
                self._start(name)

    def kill_one(self) -> bool:
        """Kill somebody who has not finished, look at what a node then has, and start it again.

        False, with nobody killed, where the run is nearly over.
        """
        self._start_again()
        if all(self._is_nearly_done(name) for name in VEHICLES):
            return False
        running = [n for n, child in self._running.items() if child.running and not self._is_nearly_done(n)]
        at_work = [name for name in running if self._running[name].find("progress")]
        name = self._rng.choice(at_work if at_work and self._rng.random() < AT_WORK else running)
        self._running[name].kill()
        self.killed[name] += 1
        if name in NODES:
            check_kept(read_ledger(self._fleet.store(name), NAME), self.acks.of(name))
        time.sleep(self._rng.uniform(*DOWN_S))
        self._start(name)
        return True

    def finish(self) -> None:
        """Wait until all have ended well, the vehicles first: nodes wait for them."""
        self._start_again()
        for name in [*VEHICLES, *NODES]:
            self._running[name].finish(END_S)


def survive(kills: int, seed: int, folder: Path, steps: int) -> dict[str, int]:
    """A run with up to so many kills; returns who was killed how often.

    Fails where a process ends badly, where something acknowledged is gone, or where the map is another.
    """
    rng = random.Random(seed)
    settings = (
        f"fleet.vehicles={len(VEHICLES)}", f"fleet.nodes={len(NODES)}", f"world.steps={steps}", "world.landmarks=60",
        f"run.rate_hz={RATE_HZ}", f"run.seed={seed}", f"fusion.required_acks={list(NODES)}",
    )  # fmt: skip
    expected = run_virtual(SCENARIO, *settings).ledger.map_digest()
    with fleet_of(SCENARIO, folder, *settings) as fleet, contextlib.ExitStack() as stack:
        killer = Killer(fleet, rng, steps)

        def listen(endpoint: str) -> None:
            stack.enter_context(open_bus(connect=[endpoint])).subscribe(Keys(NAME).acks("*"), killer.acks.take)

        killer.start(listen)
        for _ in range(kills):
            time.sleep(rng.uniform(*PAUSE_S))
            if not killer.kill_one():
                break
        killer.finish()
        for node in NODES:
            ledger = read_ledger(fleet.store(node), NAME)
            check_kept(ledger, killer.acks.of(node))
            assert ledger.map_digest() == expected, f"{node} has another map"
    assert killer.acks.heard > 0
    return killer.killed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    begin_s, done, total = time.monotonic(), 0, dict.fromkeys([*NODES, *VEHICLES], 0)
    for seed in itertools.count(asked.seed):
        if done >= asked.kills:
            break
        with tempfile.TemporaryDirectory(prefix="fleet-seif-kills-") as folder:
            killed = survive(min(PER_RUN, asked.kills - done), seed, Path(folder), STEPS)
        done += sum(killed.values())
        total = {name: total[name] + count for name, count in killed.items()}
        print(f"{done} kills, {time.monotonic() - begin_s:.0f} s, seed {seed}: same map, nothing lost", flush=True)
    print(total)


if __name__ == "__main__":
    main()
