"""Subscribers: the current map at once, the newest afterwards, never pieces of two."""

import asyncio
import dataclasses
from collections.abc import Callable
from typing import cast

import numpy as np
import pytest

import fleet_seif
from fleet_seif.bus import OnPut, ZenohBus
from fleet_seif.client import GONE_S, NODES_MAX, VERSIONS_OPEN_MAX, FleetClient, MapAssembler
from fleet_seif.errors import RunError, WireError
from fleet_seif.keys import Keys
from fleet_seif.map_wire import encode_map, map_pieces
from fleet_seif.messages import JointMap, LandmarkName
from fusion.mapping import empty_map
from tests.conftest import Network

LARGE = 3000


NODE = "hub"


def joint_map(version: int, landmarks: int = 2, *, final: bool = False, node: str = NODE) -> JointMap:
    return dataclasses.replace(
        empty_map("demo", node),
        version=version,
        final=final,
        landmark_mean=np.full((landmarks, 2), float(version)),
        names=tuple((LandmarkName("v1", 0, i),) for i in range(landmarks)),
        signature=tuple(range(landmarks)),
    )


def pieces(version: int, node: str = NODE) -> list[bytes]:
    return map_pieces(encode_map(joint_map(version, LARGE, node=node)), node, version)


def test_large_maps_travel_in_small_pieces() -> None:
    assert len(pieces(1)) > 1
    assert max(len(piece) for piece in pieces(1)) < 60_000


def test_pieces_in_any_order_give_the_map() -> None:
    assembler = MapAssembler()
    results = [assembler.take(piece) for piece in reversed(pieces(4))]
    assert results[:-1] == [None] * (len(results) - 1)
    assert results[-1] is not None
    assert np.all(results[-1].landmark_mean == 4.0)


def test_pieces_of_different_versions_never_mix() -> None:
    assembler, old, new = MapAssembler(), pieces(1), pieces(2)
    mixed = [old[0], *new[1:], *old[2:], new[0], old[1]]
    maps = [joint for piece in mixed if (joint := assembler.take(piece)) is not None]
    assert [joint.version for joint in maps] == [2]
    assert np.all(maps[0].landmark_mean == 2.0)


def test_a_lost_piece_costs_one_map_only() -> None:
    assembler = MapAssembler()
    assert all(assembler.take(piece) is None for piece in pieces(1)[1:])
    assert [j.version for piece in pieces(2) if (j := assembler.take(piece)) is not None] == [2]


def test_incomplete_maps_do_not_pile_up() -> None:
    assembler = MapAssembler()
    for version in range(50):
        assembler.take(pieces(version)[0])
    assert len(assembler._open) <= VERSIONS_OPEN_MAX


def test_a_damaged_piece_is_refused() -> None:
    with pytest.raises(WireError):
        MapAssembler().take(pieces(1)[0][:-1])


async def test_a_new_subscriber_gets_the_current_map_at_once(network: Network) -> None:
    current = encode_map(joint_map(5, LARGE))
    network.bus.answer(Keys("demo").map(NODE), lambda key, data: [current])
    async with fleet_seif.connect(network.endpoint, fleet="demo") as fleet:
        async for joint in fleet.maps():
            assert joint.version == 5
            break


async def test_maps_end_with_the_final_one_and_skip_what_is_old(network: Network) -> None:
    current = encode_map(joint_map(5))
    network.bus.answer(Keys("demo").map(NODE), lambda key, data: [current])
    seen = []
    async with fleet_seif.connect(network.endpoint, fleet="demo") as fleet, asyncio.timeout(20):
        async for joint in fleet.maps():
            seen.append(joint.version)
            if joint.version == 5:
                for version in (3, 6, 7):
                    for piece in map_pieces(encode_map(joint_map(version, final=version == 7)), NODE, version):
                        network.bus.put(Keys("demo").map(NODE), piece)
    assert seen[0] == 5
    assert seen[-1] == 7
    assert seen == sorted(seen)


async def test_nobody_there_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fleet_seif.bus.CONNECT_MS", 0)
    with pytest.raises(RunError, match="cannot reach a fusion node"):
        async with fleet_seif.connect("tcp/127.0.0.1:1", fleet="demo"):
            pass


async def test_every_iterator_gets_the_current_map(network: Network) -> None:
    current = encode_map(joint_map(5))
    network.bus.answer(Keys("demo").map(NODE), lambda key, data: [current])
    async with fleet_seif.connect(network.endpoint, fleet="demo") as fleet, asyncio.timeout(20):
        for _ in range(2):
            async for joint in fleet.maps():
                assert joint.version == 5
                break


def test_forged_pieces_of_far_versions_do_not_push_real_ones_out() -> None:
    assembler = MapAssembler()
    for k in range(8):
        assembler.take(map_pieces(encode_map(joint_map(1, LARGE)), NODE, 2**52 + k)[0])
    assert [j.version for piece in pieces(6) if (j := assembler.take(piece)) is not None] == [6]


# Several nodes.


def test_pieces_of_different_nodes_never_mix() -> None:
    assembler, of_a, of_b = MapAssembler(), pieces(3, "a"), pieces(3, "b")
    mixed = [of_a[0], *of_b[1:], *of_a[1:-1], of_b[0], of_a[-1]]
    maps = [joint for piece in mixed if (joint := assembler.take(piece)) is not None]
    assert sorted(joint.node for joint in maps) == ["a", "b"]


def test_versions_grow_for_each_node_by_itself() -> None:
    assembler = MapAssembler()
    got = [assembler.take_whole(encode_map(joint_map(v, node=n))) for n, v in (("a", 5), ("b", 2), ("a", 4), ("b", 3))]
    assert [joint is not None for joint in got] == [True, True, False, True]


def test_of_more_nodes_than_the_limit_the_first_are_listened_to() -> None:
    assembler = MapAssembler()
    nodes = [f"n{k}" for k in range(NODES_MAX + 5)]
    taken = [n for n in nodes if assembler.take_whole(encode_map(joint_map(1, node=n))) is not None]
    assert taken == nodes[:NODES_MAX]
    assert assembler.take_whole(encode_map(joint_map(2, node="n0"))) is not None


class Ears:
    """What a client is given as a bus: it remembers the handlers."""

    def __init__(self) -> None:
        self.take: OnPut = lambda key, data: None
        self.watched: Callable[[str, bool], None] = lambda key, alive: None

    def subscribe(self, key: str, handler: OnPut) -> None:
        self.take = handler

    def watch(self, key: str, handler: Callable[[str, bool], None]) -> None:
        self.watched = handler

    def ask(self, key: str, payload: bytes, on_reply: Callable[[bytes], None], on_done: Callable[[], None]) -> None:
        on_done()


class Listening:
    """A client with a clock that is set, and what it shows after each thing that happens."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ears = Ears()
        self.now_s = 100.0
        self.loop = asyncio.get_running_loop()
        monkeypatch.setattr(self.loop, "time", lambda: self.now_s)
        self.client = FleetClient(cast(ZenohBus, self.ears), "demo")

    async def happen(self) -> tuple[str, int] | None:
        monkeyed = asyncio.Event()
        self.loop.call_soon(monkeyed.set)
        await monkeyed.wait()
        newest = self.client._newest
        return None if newest is None else (newest.node, newest.version)

    async def map(self, node: str, version: int) -> tuple[str, int] | None:
        for piece in map_pieces(encode_map(joint_map(version, node=node)), node, version):
            self.ears.take(Keys("demo").map(node), piece)
        return await self.happen()

    async def alive(self, node: str, *, is_alive: bool = True) -> None:
        self.ears.watched(Keys("demo").node_alive(node), is_alive)
        await self.happen()


async def test_a_client_follows_one_of_two_nodes_as_long_as_it_is_there_and_sends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listening = Listening(monkeypatch)
    for node in ("a", "b"):
        await listening.alive(node)
    assert await listening.map("a", 1) == ("a", 1)
    assert await listening.map("b", 7) == ("a", 1)
    listening.now_s += GONE_S - 0.1
    assert await listening.map("a", 2) == ("a", 2)
    assert await listening.map("b", 8) == ("a", 2)
    listening.now_s += GONE_S - 0.1
    assert await listening.map("b", 9) == ("a", 2), "not silent for long enough"
    listening.now_s += 0.2
    assert await listening.map("b", 10) == ("b", 10)
    assert await listening.map("a", 3) == ("b", 10), "it stays with the one that it follows now"


async def test_a_client_leaves_a_node_that_is_gone_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    listening = Listening(monkeypatch)
    for node in ("a", "b"):
        await listening.alive(node)
    assert await listening.map("a", 1) == ("a", 1)
    await listening.alive("a", is_alive=False)
    assert await listening.map("b", 1) == ("b", 1)


async def test_maps_go_on_while_one_of_two_nodes_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    listening = Listening(monkeypatch)
    for node in ("a", "b"):
        await listening.alive(node)
    await listening.map("a", 1)
    maps = listening.client.maps()
    assert (await anext(maps)).node == "a"
    await listening.alive("a", is_alive=False)
    listening.now_s += GONE_S + 1.0
    await listening.map("b", 4)
    assert (await anext(maps)).node == "b"
    await listening.alive("b", is_alive=False)
    listening.now_s += GONE_S + 0.1
    with pytest.raises(RunError, match="away"):
        await anext(maps)
