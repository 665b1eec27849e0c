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
from fleet_seif.envelope import authenticate
from fleet_seif.errors import RunError, WireError
from fleet_seif.keys import Keys, node_of
from fleet_seif.map_wire import decode_map, read_piece
from fleet_seif.merge_records import MergeReport
from fleet_seif.merge_wire import decode_merges
from fleet_seif.messages import JointMap
from fleet_seif.signing import KeyRing, Role

log = logging.getLogger(__name__)
VERSIONS_OPEN_MAX = 8
NODES_MAX = 100
GONE_S = 5.0
LOOK_S = 1.0


class MapAssembler:
    """Puts maps together from pieces. Pieces of different nodes and versions never mix; of one node an older map never
    follows a newer. With `keys`, only maps that their node has signed are taken."""

    def __init__(self, keys: KeyRing | None = None) -> None:
        self._keys = keys
        self._open: dict[tuple[str, int, int], dict[int, bytes]] = {}
        self._newest: dict[str, int] = {}

    def take(self, data: bytes) -> JointMap | None:
        """A map when its last piece arrives. Raises WireError."""
        piece = read_piece(data)
        if piece.version <= self._newest.get(piece.node, -1):
            return None
        key = (piece.node, piece.version, piece.count)
        pieces = self._open.pop(key, {})
        pieces[piece.index] = piece.data
        self._open[key] = pieces
        while len(self._open) > VERSIONS_OPEN_MAX:
            del self._open[next(iter(self._open))]  # the one that was longest without news
        if len(pieces) < piece.count:
            return None
        del self._open[key]
        return self.take_whole(b"".join(pieces[i] for i in range(piece.count)))

    def take_whole(self, data: bytes) -> JointMap | None:
        """A map that came in one piece, if it is newer than the last of its node. Raises WireError."""
        joint = decode_map(data)
        authenticate(data, self._keys, Role.NODE, joint.node)
        if joint.version <= self._newest.get(joint.node, -1) or len({*self._newest, joint.node}) > NODES_MAX:
            return None
        self._newest[joint.node] = joint.version
        self._open = {key: value for key, value in self._open.items() if key[0] != joint.node or key[1] > joint.version}
        return joint


class FleetClient:
    """What a subscriber sees of a fleet. Made by `connect`.

    Of several fusion nodes it follows one, as long as that one is there and sends, then another.
    """

    def __init__(self, bus: ZenohBus, fleet: str, keys: KeyRing | None = None) -> None:
        self._loop = asyncio.get_running_loop()
        self._assembler = MapAssembler(keys)
        self._keys = keys
        self._followed = ""
        self._heard_s = 0.0
        self._newest: JointMap | None = None
        self._merges: dict[str, MergeReport] = {}
        self._nodes: set[str] = set()
        self._gone_at_s: float | None = None
        self._changed = asyncio.Event()
        names = Keys(fleet)
        bus.subscribe(names.merges("*"), lambda _, data: self._hand_over(self._take_merges, data, False))
        bus.ask(names.merges("*"), b"", lambda data: self._hand_over(self._take_merges, data, True), lambda: None)
        bus.subscribe(names.map("*"), lambda _, data: self._hand_over(self._take, data, False))
        bus.watch(names.node_alive("*"), lambda key, alive: self._hand_over(self._note_node, node_of(key), alive))
        bus.ask(names.map("*"), b"", lambda data: self._hand_over(self._take, data, True), lambda: None)

    def _hand_over(self, handle: Callable[[Any, bool], None], what: bytes | str, flag: bool) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has closed: nobody is waiting any more
            self._loop.call_soon_threadsafe(handle, what, flag)

    def _take(self, data: bytes, whole: bool) -> None:
        try:
            joint = self._assembler.take_whole(data) if whole else self._assembler.take(data)
        except WireError as error:
            log.warning("map_refused reason=%s", error)
            return
        if joint is not None and self._follows(joint):
            self._newest = joint
            self._wake()

    def _take_merges(self, data: bytes, whole: bool) -> None:
        try:
            report = decode_merges(data)
            authenticate(data, self._keys, Role.NODE, report.node)
        except WireError as error:
            log.warning("merges_refused reason=%s", error)
            return
        known = self._merges.get(report.node)
        room = known is not None or len(self._merges) < NODES_MAX
        if room and (known is None or known.version <= report.version):
            self._merges[report.node] = report
            self._wake()

    def _follows(self, joint: JointMap) -> bool:
        now_s = self._loop.time()
        if joint.node != self._followed and self._followed in self._nodes and now_s < self._heard_s + GONE_S:
            return False
        self._followed, self._heard_s = joint.node, now_s
        return True

    def _note_node(self, node: str, alive: bool) -> None:
        (self._nodes.add if alive else self._nodes.discard)(node)
        self._gone_at_s = None if self._nodes else self._loop.time()
        self._wake()

    def _wake(self) -> None:
        """Wake everybody who waits now; who waits later waits for the next change."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def merges(self, node: str, wait_s: float = 0.0) -> MergeReport | None:
        """What a node has said last of the merges in its maps; None where nothing comes within wait_s."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                while node not in self._merges:
                    await self._changed.wait()
        return self._merges.get(node)

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
    endpoint: str | list[str],
    *,
    fleet: str = "fleet",
    config: Path | None = None,
    insecure: bool = False,
    keys: KeyRing | None = None,
) -> AsyncIterator[FleetClient]:
    """Connect to a fusion node at an endpoint such as tcp/127.0.0.1:7447, or to the first reachable of several.

    keys: public keys of a fleet that signs its messages; maps that are not signed are then refused.

    Raises RunError where none can be reached.
    """
    endpoints = [endpoint] if isinstance(endpoint, str) else endpoint
    session = open_bus(connect=endpoints, config=config, insecure=insecure)
    bus = await asyncio.to_thread(session.__enter__)
    try:
        yield FleetClient(bus, fleet, keys)
    finally:
        await asyncio.to_thread(session.__exit__, None, None, None)
