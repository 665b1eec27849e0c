"""Two network namespaces joined by a cable that can be cut: what a real partition looks like to real sockets.

`silent` cuts as a radio does: packets vanish, no socket is told. The other way takes the interface down, so that new
connections fail at once. Linux and root only; everything is removed at the end.
"""

import contextlib
import functools
import secrets
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Side = Literal["a", "b"]
ADDRESS: dict[Side, str] = {"a": "10.77.0.1", "b": "10.77.0.2"}
OTHER: dict[Side, Side] = {"a": "b", "b": "a"}
NOWHERE = "02:00:00:00:00:ff"  # a MAC address that nobody has


def _ip(*arguments: str) -> str:
    return subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True, timeout=10).stdout


@functools.cache
def unavailable() -> str:
    """Why namespaces cannot be used here, '' where they can."""
    try:
        with two_namespaces():
            return ""
    except FileNotFoundError:
        return "no `ip` command"
    except subprocess.CalledProcessError as error:
        return f"`{' '.join(error.cmd)}`: {error.stderr.strip()}"


@dataclass(frozen=True)
class Cable:
    """Two namespaces and what joins them. Address of side s: ADDRESS[s]."""

    names: dict[Side, str]

    def command(self, side: Side, arguments: Sequence[str]) -> list[str]:
        """A command line that runs another one inside a namespace, under the same process id."""
        return ["ip", "netns", "exec", self.names[side], *arguments]

    def start(self, side: Side, arguments: Sequence[str], **popen: Any) -> "subprocess.Popen[str]":
        """Start a process inside a namespace, talked to in lines of text."""
        return subprocess.Popen(
            self.command(side, arguments), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **popen
        )

    def cut(self, *, silent: bool = True) -> None:
        """Let nothing through until `heal`."""
        if not silent:
            _ip("-n", self.names["b"], "link", "set", "cable", "down")
            return
        for side in ADDRESS:
            self._neighbour(side, NOWHERE)

    def heal(self) -> None:
        """Undo `cut`."""
        _ip("-n", self.names["b"], "link", "set", "cable", "up")
        for side in ADDRESS:
            self._neighbour(side, self._mac(OTHER[side]))

    def throttle(self, side: Side, rate_kbit_s: int) -> None:
        """Limit what a side sends."""
        shape = ["tbf", "rate", f"{rate_kbit_s}kbit", "burst", "16kb", "limit", "60000"]
        subprocess.run(
            self.command(side, ["tc", "qdisc", "add", "dev", "cable", "root", *shape]),
            check=True,
            capture_output=True,
            text=True,
            timeout=10,
        )

    def _mac(self, side: Side) -> str:
        words = _ip("-n", self.names[side], "-o", "link", "show", "cable").split()
        return words[words.index("link/ether") + 1]

    def _neighbour(self, side: Side, mac: str) -> None:
        """Where a side sends what is meant for the other."""
        to = ADDRESS[OTHER[side]]
        _ip("-n", self.names[side], "neigh", "replace", to, "lladdr", mac, "dev", "cable", "nud", "permanent")


@contextlib.contextmanager
def two_namespaces() -> Iterator[Cable]:
    """Namespaces `a` and `b`, joined. Raises CalledProcessError where they are not permitted."""
    tag = secrets.token_hex(4)
    cable = Cable({"a": f"seif-{tag}-a", "b": f"seif-{tag}-b"})
    made = []
    try:
        for name in cable.names.values():
            _ip("netns", "add", name)
            made.append(name)
        a, b = cable.names.values()
        _ip("-n", a, "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", b)
        for side, name in cable.names.items():
            _ip("-n", name, "address", "add", f"{ADDRESS[side]}/24", "dev", "cable")
            _ip("-n", name, "link", "set", "lo", "up")
            _ip("-n", name, "link", "set", "cable", "up")
        cable.heal()
        yield cable
    finally:
        for name in made:
            _ip("netns", "delete", name)
