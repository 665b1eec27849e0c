"""Real processes for tests: the commands a user types, what they say, and how they are stopped, paused and killed."""

import contextlib
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from scenarios.cli import app

COMMAND = [sys.executable, "-m", "scenarios"]
PATIENCE_S = 60.0
LOOK_S = 0.02


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A whole fleet-seif command."""
    return subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def wait_until(condition: Callable[[], object], what: str, patience_s: float = PATIENCE_S) -> None:
    """Wait for a condition; fails with `what` where it never holds."""
    end_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < end_s, f"never: {what}"
        time.sleep(LOOK_S)


def invoke(*arguments: str) -> Result:
    """The same in this process, which saves starting one."""
    return CliRunner().invoke(app, list(arguments))


def refused(code: int, *arguments: str) -> str:
    """What a command says, run in this process, that is refused: a sentence, no traceback; without the box round it,
    which breaks lines where the paths in them end."""
    done = invoke(*arguments)
    assert done.exit_code == code, (done.output, done.stderr, done.exception)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.replace("│", " ").split())


class Child:
    """A supervised process: what it says is in `said`, its words on standard error in `errors`."""

    def __init__(self, arguments: Sequence[str], prefix: Sequence[str] = ()) -> None:
        self.process = subprocess.Popen(
            [*prefix, *COMMAND, *arguments, "--supervised"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdin is not None
        self.process.stdin.write("0\n")  # begin when ready
        self.process.stdin.flush()
        self.said: list[dict[str, Any]] = []
        self.errors: list[str] = []
        self._readers = [threading.Thread(target=self._listen), threading.Thread(target=self._listen_to_errors)]
        for reader in self._readers:
            reader.start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with contextlib.suppress(json.JSONDecodeError):  # the last line of one that is killed
                self.said.append(json.loads(line))

    def _listen_to_errors(self) -> None:
        assert self.process.stderr is not None
        self.errors.extend(self.process.stderr)

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def find(self, event: str) -> dict[str, Any] | None:
        """The last event of a kind that it said."""
        return next((each for each in reversed(self.said) if each["event"] == event), None)

    def wait_for(self, event: str) -> dict[str, Any]:
        """The same, once there is one; fails where the process ends before."""
        wait_until(lambda: self.find(event) or not self.running, f"{event} of {self.process.args!r}")
        found = self.find(event)
        if found is None:
            self.end()  # all of its words
            found = self.find(event)
        assert found is not None, "".join(self.errors)
        return found

    @property
    def endpoint(self) -> str:
        """Where a fusion node listens."""
        return str(self.wait_for("listening")["endpoint"])

    def notes(self) -> list[str]:
        return [str(each["text"]) for each in self.said if each["event"] == "note"]

    def kill(self) -> None:
        """kill -9."""
        self.process.kill()
        self.end()

    def pause(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def end(self, patience_s: float = PATIENCE_S) -> int:
        """Its exit code, once it has ended by itself."""
        code = self.process.wait(patience_s)
        for reader in self._readers:
            reader.join()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
        return code

    def finish(self, patience_s: float = PATIENCE_S) -> None:
        """Say that nobody needs it any more, and wait for a good end."""
        with contextlib.suppress(BrokenPipeError, ValueError):
            assert self.process.stdin is not None
            self.process.stdin.write("release\n")
            self.process.stdin.flush()
        assert self.end(patience_s) == 0, "".join(self.errors)

    def terminate(self) -> int:
        """Ask it to end; its exit code."""
        self.process.terminate()
        return self.end()


class Fleet:
    """Processes of one fleet, started by hand; all that still run are killed at the end. See `fleet_of`.

    folder: where stores are. settings: what every process is started with.
    """

    def __init__(self, scenario: str, folder: Path, settings: Sequence[str]) -> None:
        self.folder = folder
        self.children: list[Child] = []
        self._scenario = scenario
        self._settings = [part for each in settings for part in ("--set", each)]

    def start(self, *arguments: str, prefix: Sequence[str] = ()) -> Child:
        child = Child(arguments, prefix)
        self.children.append(child)
        return child

    def store(self, name: str) -> Path:
        return self.folder / f"{name}.store"

    def node(
        self, *arguments: str, name: str = "fusion", listen: str = "tcp/127.0.0.1:0", connect: Sequence[str] = (),
        prefix: Sequence[str] = (),
    ) -> Child:  # fmt: skip
        """A fusion node with its store; `endpoint` of what this returns waits until it listens."""
        who = ["fusion", "--scenario", self._scenario, *self._settings, "--name", name, "--listen", listen]
        links = [part for endpoint in connect for part in ("--connect", endpoint)]
        return self.start(*who, *links, "--store", str(self.store(name)), *arguments, prefix=prefix)

    def vehicle(self, name: str, connect: Sequence[str], *arguments: str, prefix: Sequence[str] = ()) -> Child:
        """A vehicle with its store."""
        links = [part for endpoint in connect for part in ("--connect", endpoint)]
        who = ["vehicle", self._scenario, *self._settings, "--name", name, "--store", str(self.store(name))]
        return self.start(*who, *links, *arguments, prefix=prefix)

    def close(self) -> None:
        for child in self.children:
            if child.running:
                child.process.kill()
                child.resume()
        for child in self.children:
            child.end()


@contextlib.contextmanager
def fleet_of(scenario: str, folder: Path, *settings: str) -> Iterator[Fleet]:
    """Start processes of a scenario by hand."""
    fleet = Fleet(scenario, folder, settings)
    try:
        yield fleet
    finally:
        fleet.close()


def toml(events: Sequence[dict[str, object]]) -> str:
    """A list of inline tables, as --set takes it."""
    tables = (", ".join(f"{key} = {json.dumps(value)}" for key, value in event.items()) for event in events)
    return "[" + ", ".join(f"{{ {table} }}" for table in tables) + "]"
