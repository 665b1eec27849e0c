"""Subscribers: the current map at once, the newest afterwards, never pieces of two."""

import asyncio
import dataclasses

import numpy as np
import pytest

import fleet_seif
from fleet_seif.client import MapAssembler
from fleet_seif.errors import RunError, WireError
from fleet_seif.keys import Keys
from fleet_seif.map_wire import encode_map, map_pieces
from fleet_seif.messages import JointMap, LandmarkName
from fusion.mapping import empty_map
from tests.conftest import Network

LARGE = 3000


def joint_map(version: int, landmarks: int = 2, *, final: bool = False) -> JointMap:
    return dataclasses.replace(
        empty_map("demo"),
        version=version,
        final=final,
        landmark_mean=np.full((landmarks, 2), float(version)),
        names=tuple((LandmarkName("v1", 0, i),) for i in range(landmarks)),
        signature=tuple(range(landmarks)),
    )


def pieces(version: int) -> list[bytes]:
    return map_pieces(encode_map(joint_map(version, LARGE)), version)


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
    assert len(assembler._open) <= 4


def test_a_damaged_piece_is_refused() -> None:
    with pytest.raises(WireError):
        MapAssembler().take(pieces(1)[0][:-1])


async def test_a_new_subscriber_gets_the_current_map_at_once(network: Network) -> None:
    current = encode_map(joint_map(5, LARGE))
    network.bus.answer(Keys("demo").map(), lambda key, data: [current])
    async with fleet_seif.connect(network.endpoint, fleet="demo") as fleet:
        async for joint in fleet.maps():
            assert joint.version == 5
            break


async def test_maps_end_with_the_final_one_and_skip_what_is_old(network: Network) -> None:
    current = encode_map(joint_map(5))
    network.bus.answer(Keys("demo").map(), lambda key, data: [current])
    seen = []
    async with fleet_seif.connect(network.endpoint, fleet="demo") as fleet, asyncio.timeout(20):
        async for joint in fleet.maps():
            seen.append(joint.version)
            if joint.version == 5:
                for version in (3, 6, 7):
                    for piece in map_pieces(encode_map(joint_map(version, final=version == 7)), version):
                        network.bus.put(Keys("demo").map(), piece)
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
    network.bus.answer(Keys("demo").map(), lambda key, data: [current])
    async with fleet_seif.connect(network.endpoint, fleet="demo") as fleet, asyncio.timeout(20):
        for _ in range(2):
            async for joint in fleet.maps():
                assert joint.version == 5
                break


def test_forged_pieces_of_far_versions_do_not_push_real_ones_out() -> None:
    assembler = MapAssembler()
    for k in range(8):
        assembler.take(map_pieces(encode_map(joint_map(1, LARGE)), 2**52 + k)[0])
    assert [j.version for piece in pieces(6) if (j := assembler.take(piece)) is not None] == [6]
