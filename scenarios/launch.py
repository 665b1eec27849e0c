"""Runs a scenario with one process per vehicle and one for fusion, on an isolated loopback network.

Children are told apart by name, speak JSON lines on standard output, begin together when all are ready, and end
when the launcher does: their standard input is a pipe that closes with it. If one fails, all end and its last words
are shown; one that is killed on purpose ([faults]) is started again with what it had stored.
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
from fusion.merges import run_digest
from scenarios import output
from scenarios.config import Scenario
from scenarios.faults import Fault
from scenarios.recording import Recording
from scenarios.report import FinishedRun

STOP_S = 5.0
LAST_WORDS = 12

Progress = Callable[[str, int, int], None]


class Children:
    """The processes of one run. `events` yields what they say until all have ended well."""

    def __init__(self) -> None:
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._said: queue.SimpleQueue[tuple[str, subprocess.Popen[str], dict[str, Any] | None]] = queue.SimpleQueue()
        self._errors: dict[str, deque[str]] = {}
        self._ended: set[str] = set()
        self._killed: set[int] = set()
        self._lock = threading.Lock()
        self._stopping = False

    def start(self, name: str, arguments: list[str]) -> None:
        """Start one, or start it again; it must not read standard input for anything but what `go` writes."""
        with self._lock:
            if self._stopping:
                return
            process = subprocess.Popen(
                [sys.executable, "-m", "scenarios", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
            self._processes[name] = process
        threading.Thread(target=self._listen, args=(name, process), daemon=True).start()

    def _listen(self, name: str, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        assert process.stderr is not None
        words = self._errors[name] = deque(maxlen=LAST_WORDS)
        errors = threading.Thread(target=words.extend, args=(process.stderr,), daemon=True)
        errors.start()
        for line in process.stdout:
            with contextlib.suppress(json.JSONDecodeError):
                self._said.put((name, process, json.loads(line)))
        process.wait()
        errors.join()
        self._said.put((name, process, None))

    def events(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """(child, event) as they come; ends when all children have ended.

        Raises RunError when one ends with an error.
        """
        while self._ended != set(self._processes):  # a consumer may start more meanwhile
            name, process, event = self._said.get()
            if event is not None:
                yield name, event
                continue
            if process.pid in self._killed:
                continue
            self._ended.add(name)
            if process.returncode != 0:
                words = "".join(self._errors[name]).strip() or "(it said nothing)"
                raise RunError(f"process {name} ended with code {process.returncode}:\n{words}")

    def go(self, names: Iterable[str], run_s: float) -> None:
        """Tell processes that wait for it to begin; run_s: how long the run has been going on."""
        for name in names:
            pipe = self._processes[name].stdin
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):  # it has just ended: `events` will say so
                pipe.write(f"{run_s}\n")
                pipe.flush()

    def release(self, names: Iterable[str]) -> None:
        """Tell processes that nobody needs them any more."""
        for name in names:
            pipe = self._processes[name].stdin
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):
                pipe.write("release\n")
                pipe.flush()

    def kill(self, name: str) -> bool:
        """Kill one that is to be started again; False where it has ended already."""
        with self._lock:
            process = self._processes.get(name)
            if process is None or process.poll() is not None or self._stopping:
                return False
            self._killed.add(process.pid)
            process.kill()
        process.wait()
        return True

    def signal(self, name: str, number: int) -> None:
        process = self._processes.get(name)
        if process is not None and process.poll() is None:
            process.send_signal(number)

    def stop(self) -> None:
        """End all that still run: ask first, then insist."""
        with self._lock:
            self._stopping = True
        for process in self._processes.values():
            if process.poll() is None:
                process.terminate()
                process.send_signal(signal.SIGCONT)  # one that is paused would not hear it
        deadline = time.monotonic() + STOP_S
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


class _Run:
    """One run: who is started with which arguments, when, and what is done to whom."""

    def __init__(
        self, arguments: list[str], scenario: Scenario, recording: Recording, folder: Path, say: Callable[[str], None]
    ) -> None:
        self.children = Children()
        self._scenario = scenario
        self._arguments = arguments
        self._vehicles = list(recording.logs)
        self._folder = folder
        self._say = say
        self._endpoints: dict[str, str] = {}
        self._ready: set[str] = set()
        self._done: set[str] = set()
        self._begin_s: float | None = None
        self._over = threading.Event()

    def start_nodes(self) -> None:
        """Start the first fusion node; the others follow when it listens."""
        self._start(self._scenario.fleet.node_names[0])

    def _start(self, name: str) -> None:
        """Start a process, or start it again."""
        process = self._folder / "process"
        common = ["--result", str(process), "--supervised"]
        connect = [part for node, at in self._endpoints.items() if node != name for part in ("--connect", at)]
        if name in self._scenario.fleet.node_names:
            store = ["--store", str(process / f"{name}.ledger"), "--expected", str(len(self._vehicles))]
            listen = ["--name", name, "--listen", "tcp/127.0.0.1:0"]
            self.children.start(name, ["fusion", "--scenario", *self._arguments, *listen, *connect, *store, *common])
        else:
            store = ["--name", name, "--store", str(process / f"{name}.outbox")]
            self.children.start(name, ["vehicle", *self._arguments, *connect, *store, *common])

    def on_event(self, child: str, event: dict[str, Any], progress: Progress) -> None:
        """What a process says."""
        match event["event"]:
            case "listening":
                self._listening(child, event["endpoint"])
            case "note":
                self._say(f"{child}: {event['text']}")
            case "ready":
                self._ready.add(child)
                self._begin()
            case "progress":
                progress(child, event["done"], event["total"])
            case "done" if child in self._vehicles:
                self._done.add(child)
                if self._done == set(self._vehicles):
                    self.children.release(self._endpoints)

    def _listening(self, node: str, endpoint: str) -> None:
        first = node not in self._endpoints
        self._endpoints[node] = endpoint
        if self._begin_s is not None:
            self.children.go([node], time.monotonic() - self._begin_s)
        if self._done == set(self._vehicles):
            self.children.release([node])
        if not first:
            return
        self._say(f"watch it: fleet-seif watch {endpoint} --fleet {self._scenario.fleet.name}")
        faults = self._scenario.faults
        early = [name for name in self._scenario.fleet.node_names if not faults.joins_s(name)]
        missing = [name for name in early if name not in self._endpoints]
        if missing:
            self._start(missing[0])
        elif node in early:
            for vehicle in self._vehicles:
                if not faults.joins_s(vehicle):
                    self._start(vehicle)

    def _begin(self) -> None:
        """Let everybody begin once all who take part from the start are ready; who comes later begins at once."""
        if self._begin_s is not None:
            self.children.go(self._ready, time.monotonic() - self._begin_s)
            self._ready.clear()
        elif self._ready == {name for name in self._vehicles if not self._scenario.faults.joins_s(name)}:
            self._begin_s = time.monotonic()
            self.children.go([*self._endpoints, *self._ready], 0.0)
            self._ready.clear()
            for fault in self._scenario.faults.events:
                threading.Thread(target=self._happen, args=(fault, self._begin_s), daemon=True).start()

    def _happen(self, fault: Fault, begin_s: float) -> None:
        if self._over.wait(max(0.0, begin_s + fault.at_s - time.monotonic())):
            return
        if fault.what == "join":
            self._start(fault.who)
        elif fault.what == "pause":
            self.children.signal(fault.who, signal.SIGSTOP)
            self._over.wait(fault.for_s)
            self.children.signal(fault.who, signal.SIGCONT)
        elif fault.what in ("kill", "wipe") and self.children.kill(fault.who):
            if fault.what == "wipe":
                for file in (self._folder / "process").glob(f"{fault.who}.*"):
                    file.unlink()
            if not self._over.wait(fault.for_s):
                self._start(fault.who)

    def stop(self) -> None:
        self._over.set()
        self.children.stop()


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
    nodes = scenario.fleet.node_names
    with contextlib.ExitStack() as stack:
        folder = out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fleet-seif-")))
        process = folder / "process"
        process.mkdir(exist_ok=True)
        run = _Run(arguments, scenario, recording, folder, say)
        stack.callback(run.stop)
        stack.enter_context(_terminate_as_interrupt())
        run.start_nodes()
        for child, event in run.children.events():
            run.on_event(child, event, progress)
        facts = [json.loads((process / f"{node}.json").read_text()) for node in nodes]
        finished = FinishedRun(
            name=name,
            scenario=scenario,
            recording=recording,
            ledger=output.read_ledger(process / f"{nodes[0]}.ledger", scenario.fleet.name),
            drives={vehicle: output.read_drive(process / f"{vehicle}.npz") for vehicle in recording.logs},
            streams=facts[0]["streams"],
            wall_s=time.monotonic() - begin,
            fusion=facts[0]["fusion"],
        )
    for node, fact in zip(nodes, facts, strict=True):
        if run_digest(finished.ledger).hex() != fact["digest"]:
            raise RunError(f"{node} had another map at the end than its ledger gives now: please report this")
    return finished


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
