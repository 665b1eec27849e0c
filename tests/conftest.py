"""Fixtures shared by tests: isolated Zenoh networks on loopback, each on a port the system chooses."""

from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from fleet_seif.bus import ZenohBus, open_bus


@dataclass(frozen=True)
class Network:
    """A router's bus, and where others connect."""

    bus: ZenohBus
    endpoint: str


@pytest.fixture
def network() -> Iterator[Network]:
    """A Zenoh network of its own."""
    with open_bus(listen=["tcp/127.0.0.1:0"]) as bus:
        yield Network(bus, bus.endpoints()[0])
