"""Subscribing to the fused map.

async with fleet_seif.connect("tcp/127.0.0.1:7447", fleet="demo") as fleet:
    async for joint_map in fleet.maps():
        ...
"""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from fleet_seif.bus import ZenohBus, open_bus
from fleet_seif.errors import RunError, WireError
from fleet_seif.keys import Keys
from fleet_seif.map_wire import decode_map, read_piece
from fleet_seif.messages import JointMap

log = logging.getLogger(__name__)
VERSIONS_OPEN_MAX = 4
GONE_S = 5.0
LOOK_S = 1.0


class MapAssembler:
    """Puts maps together from pieces. Pieces of different versions never mix; an older map never follows a newer."""

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], dict[int, bytes]] = {}
        self._newest = -1

    def take(self, data: bytes) -> JointMap | None:
        """A map when its last piece arrives. Raises WireError."""
        version, index, count, chunk = read_piece(data)
        if version <= self._newest:
            return None
        pieces = self._open.pop((version, count), {})
        pieces[index] = chunk
        self._open[version, count] = pieces
        while len(self._open) > VERSIONS_OPEN_MAX:
            del self._open[next(iter(self._open))]  # the one that was longest without news
        if len(pieces) < count:
            return None
        joint = decode_map(b"".join(pieces[i] for i in range(count)))
        self._newest = version
        self._open = {key: value for key, value in self._open.items() if key[0] > version}
        return joint

    def take_whole(self, data: bytes) -> JointMap | None:
        """A map that came in one piece, if it is newer than the last. Raises WireError."""
        joint = decode_map(data)
        if joint.version <= self._newest:
            return None
        self._newest = joint.version
        return joint


class FleetClient:
    """What a subscriber sees of a fleet. Made by `connect`."""

    def __init__(self, bus: ZenohBus, fleet: str) -> None:
        self._loop = asyncio.get_running_loop()
        self._assembler = MapAssembler()
        self._newest: JointMap | None = None
        self._nodes: set[str] = set()
        self._gone_at_s: float | None = None
        self._changed = asyncio.Event()
        keys = Keys(fleet)
        bus.subscribe(keys.map(), lambda _, data: self._hand_over(self._take, data, False))
        bus.watch(keys.node("*"), lambda key, alive: self._hand_over(self._note_node, key, alive))
        bus.ask(keys.map(), b"", lambda data: self._hand_over(self._take, data, True), lambda: None)

    def _hand_over(self, handle: Callable[[Any, bool], None], what: bytes | str, flag: bool) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has closed: nobody is waiting any more
            self._loop.call_soon_threadsafe(handle, what, flag)

    def _take(self, data: bytes, whole: bool) -> None:
        try:
            joint = self._assembler.take_whole(data) if whole else self._assembler.take(data)
        except WireError as error:
            log.warning("map_refused reason=%s", error)
            return
        if joint is not None:
            self._newest = joint
            self._wake()

    def _note_node(self, key: str, alive: bool) -> None:
        (self._nodes.add if alive else self._nodes.discard)(key)
        self._gone_at_s = None if self._nodes else self._loop.time()
        self._wake()

    def _wake(self) -> None:
        """Wake everybody who waits now; who waits later waits for the next change."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def maps(self) -> AsyncIterator[JointMap]:
        """The current map, then the newest one whenever there is one; maps in between are skipped.

        Ends after the final map of a run that ends. Raises RunError where the fusion node goes and stays away.
        """
        seen: JointMap | None = None
        while True:
            joint = self._newest
            if joint is not None and joint is not seen:
                seen = joint
                yield joint
                if joint.final:
                    return
                continue
            if self._gone_at_s is not None and self._loop.time() > self._gone_at_s + GONE_S:
                raise RunError(f"the fusion node has been away for {GONE_S:.0f} s: is it still running?")
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._changed.wait(), LOOK_S)


@contextlib.asynccontextmanager
async def connect(
    endpoint: str | list[str], *, fleet: str = "fleet", config: Path | None = None, insecure: bool = False
) -> AsyncIterator[FleetClient]:
    """Connect to a fusion node at an endpoint such as tcp/127.0.0.1:7447, or to the first reachable of several.

    Raises RunError where none can be reached.
    """
    endpoints = [endpoint] if isinstance(endpoint, str) else endpoint
    session = open_bus(connect=endpoints, config=config, insecure=insecure)
    bus = await asyncio.to_thread(session.__enter__)
    try:
        yield FleetClient(bus, fleet)
    finally:
        await asyncio.to_thread(session.__exit__, None, None, None)
