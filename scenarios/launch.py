"""Runs a scenario with one process per vehicle and one for fusion, on an isolated loopback network.

Children are told apart by name, speak JSON lines on standard output, begin together when all are ready, and end
when the launcher does: their standard input is a pipe that closes with it. If one fails, all end and its last words
are shown.
"""

import contextlib
import json
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from fleet_seif.errors import RunError
from scenarios import output
from scenarios.config import Scenario
from scenarios.recording import Recording
from scenarios.report import FinishedRun

STOP_S = 5.0
LAST_WORDS = 12

Progress = Callable[[str, int, int], None]


class Children:
    """The processes of one run. `events` yields what they say until all have ended well."""

    def __init__(self) -> None:
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._said: queue.SimpleQueue[tuple[str, dict[str, Any] | None]] = queue.SimpleQueue()
        self._errors: dict[str, deque[str]] = {}

    def start(self, name: str, arguments: list[str]) -> None:
        """Start one; it must not read standard input for anything but its end."""
        process = subprocess.Popen(
            [sys.executable, "-m", "scenarios", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._processes[name] = process
        self._errors[name] = deque(maxlen=LAST_WORDS)
        threading.Thread(target=self._listen, args=(name, process), daemon=True).start()

    def _listen(self, name: str, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        assert process.stderr is not None
        errors = threading.Thread(target=self._errors[name].extend, args=(process.stderr,), daemon=True)
        errors.start()
        for line in process.stdout:
            with contextlib.suppress(json.JSONDecodeError):
                self._said.put((name, json.loads(line)))
        process.wait()
        errors.join()
        self._said.put((name, None))

    def events(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """(child, event) as they come; ends when all children have ended.

        Raises RunError when one ends with an error.
        """
        ended: set[str] = set()
        while ended != set(self._processes):  # a consumer may start more meanwhile
            name, event = self._said.get()
            if event is not None:
                yield name, event
                continue
            ended.add(name)
            if self._processes[name].returncode != 0:
                words = "".join(self._errors[name]).strip() or "(it said nothing)"
                raise RunError(f"process {name} ended with code {self._processes[name].returncode}:\n{words}")

    def go(self, names: Iterable[str]) -> None:
        """Tell processes that wait for it to begin."""
        for name in names:
            pipe = self._processes[name].stdin
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):  # it has just ended: `events` will say so
                pipe.write("\n")
                pipe.flush()

    def stop(self) -> None:
        """End all that still run: ask first, then insist."""
        for process in self._processes.values():
            if process.poll() is None:
                process.terminate()
        deadline = time.monotonic() + STOP_S
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def run_processes(
    name: str,
    arguments: list[str],
    scenario: Scenario,
    recording: Recording,
    out: Path | None,
    say: Callable[[str], None],
    progress: Progress,
) -> FinishedRun:
    """Run it for real.

    Args:
        arguments: what gives a child the same scenario: its name, --seed and --set options.
        out: folder prepared by output.prepare_folder; None: a temporary one.
        progress: called with vehicle (or "fusion"), done and total.

    Raises RunError where a process fails.
    """
    begin = time.monotonic()
    children = Children()
    with contextlib.ExitStack() as stack:
        folder = out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fleet-seif-")))
        (folder / "process").mkdir(exist_ok=True)
        stack.callback(children.stop)
        stack.enter_context(_terminate_as_interrupt())
        expected = str(len(recording.logs))
        common = ["--result", str(folder / "process"), "--supervised"]
        listen = ["--listen", "tcp/127.0.0.1:0", "--expected", expected]
        children.start("fusion", ["fusion", "--scenario", *arguments, *listen, *common])
        ready: set[str] = set()
        for child, event in children.events():
            if event["event"] == "listening":
                say(f"watch it: fleet-seif watch {event['endpoint']} --fleet {scenario.fleet.name}")
                for vehicle in recording.logs:
                    connect = ["--name", vehicle, "--connect", event["endpoint"]]
                    children.start(vehicle, ["vehicle", *arguments, *connect, *common])
            elif event["event"] == "note":
                say(f"{child}: {event['text']}")
            elif event["event"] == "ready":
                ready.add(child)
                if ready == set(recording.logs):
                    children.go(ready)
            elif event["event"] == "progress":
                progress(child, event["done"], event["total"])
        process = folder / "process"
        facts = json.loads((process / "fusion.json").read_text())
        run = FinishedRun(
            name=name,
            scenario=scenario,
            recording=recording,
            ledger=output.read_ledger(process / "ledger.bin", scenario.fleet.name),
            drives={vehicle: output.read_drive(process / f"{vehicle}.npz") for vehicle in recording.logs},
            streams=facts["streams"],
            wall_s=time.monotonic() - begin,
            fusion=facts["fusion"],
        )
    if run.ledger.map_digest().hex() != facts["digest"]:
        raise RunError("the ledger folded again gives another digest than the fusion node had: please report this")
    return run


@contextlib.contextmanager
def _terminate_as_interrupt() -> Iterator[None]:
    """SIGTERM ends a run as Ctrl-C does: through the clean-up of the children."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
