"""Subscribing to the fused map.

async with fleet_seif.connect("tcp/127.0.0.1:7447", fleet="demo") as fleet:
    async for joint_map in fleet.maps():
        ...
"""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from pathlib import Path

from fleet_seif.bus import ZenohBus, open_bus
from fleet_seif.envelope import PIECES_MAX
from fleet_seif.errors import WireError
from fleet_seif.keys import Keys
from fleet_seif.map_wire import decode_map, read_piece
from fleet_seif.messages import JointMap

log = logging.getLogger(__name__)
VERSIONS_OPEN_MAX = 4


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
        pieces = self._open.setdefault((version, count), {})
        pieces[index] = chunk
        while len(self._open) > VERSIONS_OPEN_MAX:
            del self._open[min(self._open)]
        if len(pieces) < count or count > PIECES_MAX:
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
        self._changed = asyncio.Event()
        self._keys = Keys(fleet)
        self._bus = bus
        bus.subscribe(self._keys.map(), lambda _, data: self._hand_over(data, whole=False))
        bus.ask(self._keys.map(), b"", lambda data: self._hand_over(data, whole=True), lambda: None)

    def _hand_over(self, data: bytes, *, whole: bool) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has closed: nobody is waiting any more
            self._loop.call_soon_threadsafe(self._take, data, whole)

    def _take(self, data: bytes, whole: bool) -> None:
        try:
            joint = self._assembler.take_whole(data) if whole else self._assembler.take(data)
        except WireError as error:
            log.warning("map_refused reason=%s", error)
            return
        if joint is not None:
            self._newest = joint
            self._changed.set()

    async def maps(self) -> AsyncIterator[JointMap]:
        """The current map, then the newest one whenever there is one; maps in between are skipped.

        Ends after the final map of a run that ends.
        """
        seen = None
        while True:
            await self._changed.wait()
            self._changed.clear()
            joint = self._newest
            if joint is None or joint is seen:
                continue
            seen = joint
            yield joint
            if joint.final:
                return


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
