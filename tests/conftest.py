"""Fixtures shared by tests: isolated Zenoh networks on loopback, each on a port the system chooses."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from fleet_seif.bus import ZenohBus, open_bus


@dataclass(frozen=True)
class Network:
    """A router's bus, and where others connect."""

    bus: ZenohBus
    endpoint: str


@pytest.fixture(autouse=True, scope="module")
def log_level() -> Iterator[None]:
    """What the tests of a module do to the level of the log ends with them: a chaos arena turns it down for good."""
    level = logging.getLogger().level
    yield
    logging.getLogger().setLevel(level)


@pytest.fixture
def network() -> Iterator[Network]:
    """A Zenoh network of its own."""
    with open_bus(listen=["tcp/127.0.0.1:0"]) as bus:
        yield Network(bus, bus.endpoints()[0])
