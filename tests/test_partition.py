"""A link that fails between two machines: network namespaces, real sockets, nothing simulated.

Run as a program this is one end: `hub` listens and asks, `client` puts and answers; see `Ends`.
"""

import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from fleet_seif.bus import LEASE_MS, open_bus
from tests.netns import ADDRESS, Cable, two_namespaces, unavailable

pytestmark = [pytest.mark.slow, pytest.mark.alone]
HUB = f"tcp/{ADDRESS['a']}:7447"
PATIENCE_S = 10.0
BACK_S = 2.5  # a lost SYN costs OPEN_MS and a wait of RETRY_MS
PERIOD_S = 0.02
FLOOD_BYTES = 2000


def serve_hub() -> None:
    """Say when something arrives: a line `KIND time` for every sample, reply and change of liveliness.

    Samples are numbered from 0; where some are missing there is a line `lost time` for each.
    """
    lock = threading.Lock()
    expected = 0

    def say(kind: str) -> None:
        with lock:
            print(kind, time.monotonic(), flush=True)

    def on_sample(key: str, data: bytes) -> None:
        nonlocal expected
        for _ in range(expected, int(data)):
            say("lost")
        expected = int(data) + 1
        say("sample")

    with open_bus(listen=[HUB], insecure=True) as bus:
        bus.subscribe("sample", on_sample)
        bus.watch("alive/*", lambda key, alive: say("alive" if alive else "dead"))
        while True:
            done = threading.Event()
            bus.ask("ledger", b"", lambda data: say("reply"), done.set)
            done.wait()
            time.sleep(PERIOD_S)


def serve_client(flood: bool) -> None:
    """Put a sample every PERIOD_S, and where told to flood, more than the link carries beside it."""
    with open_bus(connect=[HUB], insecure=True) as bus:
        bus.answer("ledger", lambda key, data: [b"here"])
        bus.announce("alive/client")
        for number in itertools.count():
            bus.put("sample", str(number).encode(), "control")
            for _ in range(20 if flood else 0):
                bus.put("flood", bytes(FLOOD_BYTES), "bulk")
            time.sleep(PERIOD_S)


@dataclass
class Ends:
    """Both processes, and when the hub heard what, on the machine's monotonic clock."""

    cable: Cable
    heard: dict[str, list[float]] = field(default_factory=dict)

    def read(self, lines: Iterator[str]) -> None:
        for line in lines:
            if not line.endswith("\n"):  # it was killed while it wrote this
                return
            kind, _, time_s = line.partition(" ")
            self.heard.setdefault(kind, []).append(float(time_s))

    def after(self, kind: str, since_s: float) -> float:
        """How long after a time something of a kind is first heard, s."""
        while True:
            for time_s in self.heard.get(kind, []):
                if time_s > since_s:
                    return time_s - since_s
            assert time.monotonic() < since_s + PATIENCE_S, f"no {kind}"
            time.sleep(0.01)


@pytest.fixture
def connect() -> Iterator[Callable[..., Ends]]:
    """Start a hub in namespace a and a client in namespace b."""
    if unavailable():
        pytest.skip(f"network namespaces are not permitted here: {unavailable()}")
    with two_namespaces() as cable:
        command = [sys.executable, "-m", "tests.test_partition"]
        ends = Ends(cable)
        hub = cable.start("a", [*command, "hub"])
        assert hub.stdout is not None
        reader = threading.Thread(target=ends.read, args=[hub.stdout])
        reader.start()
        processes = [hub]

        def start_client(*arguments: str) -> Ends:
            processes.append(cable.start("b", [*command, "client", *arguments]))
            ends.after("sample", time.monotonic())
            ends.after("reply", time.monotonic())
            return ends

        try:
            yield start_client
        finally:
            for process in processes:
                process.kill()
                process.wait()
            reader.join()
            for process in processes:
                for pipe in (process.stdin, process.stdout):
                    assert pipe is not None
                    pipe.close()


@pytest.mark.parametrize("silent", [True, False], ids=["silent", "link_down"])
@pytest.mark.parametrize("cut_s", [1, 5, 20, 60])
def test_samples_and_queries_flow_again_after_a_partition(
    connect: Callable[..., Ends], cut_s: int, silent: bool, record_property: Callable[[str, object], None]
) -> None:
    ends = connect()
    cut_at_s = time.monotonic()
    ends.cable.cut(silent=silent)
    time.sleep(cut_s)
    ends.cable.heal()
    healed_s = time.monotonic()
    back_s = {kind: ends.after(kind, healed_s) for kind in ("sample", "reply")}
    print(f"cut {cut_s} s, {'silent' if silent else 'link down'}: {back_s}")
    record_property("back_s", back_s)
    assert max(back_s.values()) < BACK_S
    if cut_s > 2 * LEASE_MS / 1000:
        assert ends.after("dead", cut_at_s) < 1.5 * LEASE_MS / 1000
        ends.after("alive", cut_at_s)


def test_control_messages_pass_a_full_link(connect: Callable[..., Ends]) -> None:
    ends = connect("flood")
    for side in ADDRESS:
        ends.cable.throttle(side, 8000)
    begin_s = time.monotonic()
    time.sleep(3.0)
    passed, lost = ([t for t in ends.heard.get(kind, []) if t > begin_s + 1.0] for kind in ("sample", "lost"))
    assert len(lost) < 0.05 * len(passed)  # of the flood's own priority more than half are lost


if __name__ == "__main__":
    serve_hub() if sys.argv[1] == "hub" else serve_client("flood" in sys.argv)
