"""Broken and made-up messages for every reader, and what must hold of each: `python -m tests.fuzz --count 1000000`.

1. A reader raises WireError, or gives a record whose bytes are exactly the input (but for the signature).
2. Whoever receives an input and refuses it is as before: a ledger, a vehicle's outbox, a subscriber.
3. Input number n of a seed is the same everywhere, so a failure is found again by what is printed.

Inputs are golden messages, changed: bits flipped, cut, spliced, bytes inserted; or their msgpack taken apart and put
together otherwise. Digest and signature are then made anew: the attacker is a vehicle, node or operator of the fleet
with its own key, or somebody else.
"""

import argparse
import hashlib
import itertools
import logging
import math
import multiprocessing
import random
import re
import struct
import time
import typing
from collections.abc import Callable, Iterator
from functools import cache
from types import NoneType
from typing import Any, Final

import msgpack
import numpy as np

from fleet_seif import map_wire, wire
from fleet_seif.client import MapAssembler
from fleet_seif.config import FilterSettings, FusionSettings, PublishSettings
from fleet_seif.envelope import DIGEST, DIGEST_END, PIECE_BYTES, SIGNATURE, SIGNED, VERSION, authenticate
from fleet_seif.errors import WireError
from fleet_seif.messages import (
    DeltaMessage,
    Epoch,
    FrameStatus,
    Heartbeat,
    JointMap,
    OperatorEvent,
    RangeRequest,
    Snapshot,
    StreamPosition,
    VehicleState,
)
from fleet_seif.records import Sightings
from fleet_seif.signing import Role, Signer
from fleet_seif.varints import VALUE_MAX, decode_ints, encode_ints
from fusion.core import FusionCore
from tests import golden
from tests.golden import EXAMPLES, KINDS, NODE, OPERATOR, RING, VEHICLE
from vehicles.core import Identity, VehicleCore

STRANGER: Final = golden.signer(Role.VEHICLE, "v1", 77)
SIGNERS: Final = (None, VEHICLE, NODE, OPERATOR, STRANGER)
OWN: Final = {"delta": VEHICLE, "heartbeat": VEHICLE, "ack": NODE, "range": NODE, "snapshot": VEHICLE, "map": NODE,
              "event": OPERATOR, "status": NODE, "merges": NODE}  # fmt: skip
"""Who signs a kind: the key that an attacker inside the fleet has. The others have none."""
RENEW: Final = 500
"""Inputs after which the receivers are made anew: what is valid fills them."""
BATCH: Final = 1000


def body_start(data: bytes) -> int:
    """Where the body of a whole message begins."""
    return DIGEST_END + 1 + (SIGNATURE if data[DIGEST_END] == 1 else 0)


def unsigned(data: bytes) -> bytes:
    """A message without its signature."""
    return data[:DIGEST_END] + b"\0" + data[body_start(data) :]


def sealed(kind: int, body: bytes, by: Signer | None) -> bytes:
    """A body, whatever it is, under a right digest and a right signature."""
    head = b"FSF" + bytes([VERSION, kind])
    head += hashlib.blake2b(head + body, digest_size=DIGEST).digest()
    return head + (b"\0" if by is None else b"\1" + by.sign(SIGNED + head)) + body


SEEDS: Final = {kind: [golden.encoded(n) for n in EXAMPLES if n.split("-")[0] == kind] for kind in KINDS}
BODIES: Final = {kind: [data[body_start(data) :] for data in seeds] for kind, seeds in SEEDS.items()}
TREES: Final = {kind: [msgpack.unpackb(body, strict_map_key=False) for body in b] for kind, b in BODIES.items()}

EDGES: Final[tuple[Any, ...]] = (
    0, 1, -1, 2, 63, 64, 127, 128, 255, 256, 2**31 - 2, 2**31 - 1, 2**31, 2**53 - 1, 2**53, 2**53 + 1, 2**60, 2**63 - 1,
    2**63, 2**64 - 1, -2, -(2**31), -(2**63), True, False, None, "", "v1", "é", "x" * 201, "a/b", b"", bytes(32),
    bytes(24), bytes(72), 0.0, -0.0, 1.0, 1e9, 1.1e9, 5e-324, 1e308, -1e308, math.inf, math.nan, [], {}, [[]], {"a": 1},
    {b"a": 1, "b": 2}, msgpack.ExtType(5, b"x"), msgpack.ExtType(0, b"v1"), msgpack.Timestamp(1, 1),
)  # fmt: skip
FLOATS: Final = (0.0, -0.0, 1.0, -1.0, 1e-300, 5e-324, 1e300, 1e308, -1e308, 1e154, 1e-154, math.inf, math.nan)
INTS: Final = (0, 1, -1, 2**31 - 1, 2**31, 2**40, 2**40 + 1, 2**60 - 1, 2**60, -(2**60), 2**61 - 1, 1 - 2**61)


class Mutator:
    """Draws inputs."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)

    def draw(self) -> tuple[str, bytes]:
        """A kind's name, and bytes for its reader."""
        rng = self._rng
        kind = rng.choice(list(KINDS))
        way = rng.random()
        if way < 0.1:
            return kind, self._bytes(rng.choice(SEEDS[kind]), SEEDS[kind])
        if way < 0.35:
            body = self._bytes(rng.choice(BODIES[kind]), BODIES[kind])
        else:
            body = self._body_of_tree(kind)
        by = rng.choice([OWN.get(kind), *SIGNERS])
        return kind, sealed(KINDS[kind].number, body, by)

    def _bytes(self, data: bytes, others: list[bytes]) -> bytes:
        """Bytes, damaged a few times."""
        rng, out = self._rng, bytearray(data)
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            at = rng.randrange(len(out) + 1)
            match rng.randrange(6):
                case 0 if out:
                    out[at - 1] ^= 1 << rng.randrange(8)
                case 1:
                    del out[at:]
                case 2:
                    out[at:at] = rng.randbytes(rng.choice((1, 1, 2, 4, 9)))
                case 3:
                    del out[at : at + rng.choice((1, 1, 2, 8))]
                case 4:
                    other = rng.choice(others)
                    cut = rng.randrange(len(other) + 1)
                    out[at:] = other[cut:]
                case _ if out:
                    out[at - 1] = rng.choice((0, 1, 127, 128, 192, 193, 203, 220, 221, 255))
        return bytes(out)

    def _body_of_tree(self, kind: str) -> bytes:
        rng = self._rng
        tree = rng.choice(TREES[kind])
        for _ in range(rng.choice((1, 1, 1, 1, 2, 3))):
            tree = self._changed(tree, kind, rng.choice((1, 2, 3, 4, 5, 6)))
        try:
            return bytes(msgpack.packb(tree))
        except (OverflowError, ValueError, TypeError):
            return b""

    def _changed(self, node: Any, kind: str, depth: int) -> Any:
        """A tree with a change somewhere below."""
        rng = self._rng
        if isinstance(node, dict) and node and depth > 1:
            key = rng.choice(list(node))
            return {**node, key: self._changed(node[key], kind, depth - 1)}
        if not isinstance(node, list) or not node or depth <= 1:
            return self._other(node, kind)
        k = rng.randrange(len(node))
        if rng.random() < 0.8:
            return [*node[:k], self._changed(node[k], kind, depth - 1), *node[k + 1 :]]
        match rng.randrange(4):
            case 0:
                return [*node[:k], *node[k + 1 :]]
            case 1:
                return [*node[:k], node[k], *node[k:]]
            case 2:
                j = rng.randrange(len(node))
                out = list(node)
                out[k], out[j] = out[j], out[k]
                return out
            case _:
                return [*node[:k], self._other(node[k], kind), *node[k:]]

    def _other(self, node: Any, kind: str) -> Any:
        """Something instead of a node."""
        rng = self._rng
        way = rng.random()
        if way < 0.25:
            return rng.choice(EDGES)
        if way < 0.35:
            return rng.choice([node, [node], rng.choice(TREES[kind]), rng.choice(rng.choice(list(TREES.values())))])
        match node:
            case bool():
                return not node
            case int():
                return rng.choice((node + 1, node - 1, node ^ (1 << rng.randrange(53)), rng.getrandbits(64)))
            case float():
                return rng.choice((*FLOATS, -node, node * (1 + 2**-50), rng.uniform(-1e9, 1e9)))
            case str():
                return rng.choice((node + "x", node[1:], node.upper(), "ann", "v2", "fusion"))
            case bytes():
                return self._binary(node)
        return rng.choice(EDGES)

    def _binary(self, data: bytes) -> bytes:
        """Other bytes, other numbers in a column of integers, or other floats."""
        rng = self._rng
        way = rng.random()
        column = decode_ints(data) if len(data) < 200 and way < 0.5 else None
        if column is not None:
            values = column.tolist() or [0]
            for _ in range(rng.choice((1, 1, 2))):
                k = rng.randrange(len(values))
                step = rng.choice((*INTS, rng.randrange(-5, 6), values[k] + 1, -values[k]))
                values[k : k + rng.randrange(2)] = [max(1 - VALUE_MAX, min(step, VALUE_MAX - 1))]
            return encode_ints(np.array(values, np.int64))
        if len(data) % 8 == 0 and data and way < 0.8:
            numbers = list(struct.unpack(f"<{len(data) // 8}d", data))
            for _ in range(rng.choice((1, 2, 4))):
                numbers[rng.randrange(len(numbers))] = rng.choice(FLOATS)
            if len(numbers) == 9 and rng.random() < 0.7:  # symmetric, so that there is more to look at
                for i, j in itertools.combinations(range(3), 2):
                    numbers[3 * j + i] = numbers[3 * i + j]
            return struct.pack(f"<{len(numbers)}d", *numbers)
        return self._bytes(data, [data])


class Receivers:
    """Everybody who takes messages, each with something to lose."""

    def __init__(self) -> None:
        self.core = FusionCore(golden.FLEET, "other", FusionSettings(), keys=RING)
        self.maps = MapAssembler(RING)
        # what a later message would spoil: a stream with a message that waits, an event, a map
        for name in ("delta-hello", "delta-corrected"):
            self.core.on_delta("v1", wire.encode_message(EXAMPLES[name][0], VEHICLE), 0.0)
        self.core.on_events("fusion", golden.encoded("event-force"))
        self.vehicle = _vehicle()

    def give(self, kind: str, data: bytes) -> bool:
        """Give an input to whoever takes this kind; whether it was refused as malformed."""
        core, vehicle = self.core, self.vehicle
        malformed = core.counters["malformed"]
        match kind:
            case "delta" | "snapshot":
                core.on_delta("v1", data, 1.0)
            case "heartbeat":
                core.on_heartbeat("v1", data, 1.0)
            case "status":
                core.on_status("fusion", data, 1.0)
            case "merges":
                core.on_merges("fusion", data)
            case "event" | "evidence":
                core.on_events("fusion", data)
            case "ack":
                vehicle.on_ack(data)
                try:
                    authenticate(data, RING, Role.NODE, wire.decode_ack(data).node)
                except WireError:
                    return True
            case "range":
                core.answer_range("v1", data)
                vehicle.on_range(data)
                return True
            case "piece" | "map":
                try:
                    self.maps.take(data) if kind == "piece" else self.maps.take_whole(data)
                except WireError:
                    return True
        return core.counters["malformed"] > malformed

    def state(self, kind: str) -> object:
        """All that a refused input of a kind must leave as it is."""
        if kind in ("ack", "range"):
            box = self.vehicle.outbox
            waiting = (
                box.last_acknowledged,
                box.last_put,
                box.last,
                box.done,
                len(box.changes),
                dict(self.vehicle.faults),
            )
            return waiting, box.heartbeat("f", "v1")
        if kind in ("piece", "map"):
            return dict(self.maps._newest)
        ledger = self.core.ledger
        streams = [
            (s.key, s.next, s.checked, s.prefix_digest, s.quarantine, sorted(s.parked), s.parked_bytes, s.witness,
             len(s.log), dict(s.announced), s.hello is None, s.duplicates)
            for s in ledger.streams.values()
        ]  # fmt: skip
        return streams, ledger.contents(), ledger.bytes_held, ledger._parked_bytes, sorted(ledger.events)


def _vehicle() -> VehicleCore:
    """A vehicle that has put three messages, of which one is acknowledged."""
    identity = Identity(
        fleet=golden.FLEET, vehicle="v1", epoch=Epoch(0, 7), start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3))
    )
    vehicle = VehicleCore(identity, FilterSettings(), PublishSettings(), signer=VEHICLE, keys=RING)
    vehicle.start(0.0, Sightings.none())
    vehicle.end()
    vehicle.note_commit(vehicle.take_changes()[1])
    vehicle.release()
    return vehicle


def check_reader(kind: str, data: bytes) -> bool:
    """Rule 1; whether the input was read."""
    what = KINDS[kind]
    try:
        record = what.decode(data)
    except WireError:
        return False
    assert what.encode(record, None) == unsigned(data), "not canonical"
    check_types(record, what.record)
    check_together(record)
    return True


hints = cache(typing.get_type_hints)
COUNT: Final = (-1, 2**53)
NUMBER: Final = (0, 2**53)
RANGES: Final = {
    **dict.fromkeys(("first", "last", "step", "innovation_dof", "refused", "version", "counter"), NUMBER),
    **dict.fromkeys(("cut", "checked", "behind", "parked", "duplicates", "gaps_repaired", "cov_version"), COUNT),
    **dict.fromkeys(("life", "frame"), (0, 2**31 - 1)),
    "count": (1, 4096), "nonce": (0, 2**64 - 1), "signature": (-1, 2**63 - 1), "index": (0, 4095), "number": (0, 2**53),
}  # fmt: skip
LOWER: Final = {(StreamPosition, "last"): -1, (VehicleState, "refused"): -1, (OperatorEvent, "number"): 1}
NAMES: Final = ("fleet", "vehicle", "node", "operator", "name")
DIGESTS: Final = ("prefix_digest", "checked_digest", "map_digest", "ledger_digest")


def check_types(value: Any, hint: Any) -> None:
    """A value is what its record says; numbers are finite and in range, names are names."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint in (int, bool, str, bytes, float):
        assert type(value) is hint, f"{value!r} is no {hint}"
        assert hint is not float or math.isfinite(value), value
    elif isinstance(value, np.ndarray):
        assert np.all(np.isfinite(value)), value
    elif NoneType in args:
        if value is not None:
            check_types(value, next(a for a in args if a is not NoneType))
    elif origin is tuple:
        each = [args[0]] * len(value) if args[-1] is Ellipsis else args
        for item, type_ in zip(value, each, strict=True):
            check_types(item, type_)
    elif origin is dict:
        for key, item in value.items():
            check_types(key, args[0])
            check_types(item, args[1])
    else:
        assert isinstance(value, hint), f"{value!r} is no {hint}"
        for name in getattr(hint, "__dataclass_fields__", getattr(hint, "_fields", ())):
            each = getattr(value, name)
            check_types(each, hints(hint)[name])
            _check_field(value, name, each)


def _check_field(record: Any, name: str, value: Any) -> None:
    if isinstance(value, int) and name in RANGES:
        low, high = RANGES[name]
        assert LOWER.get((type(record), name), low) <= value <= high, (name, value)
    if name in NAMES and not (isinstance(record, OperatorEvent) and value == ""):
        assert re.fullmatch(r"[A-Za-z0-9_-]{1,32}", value), (name, value)
    if name in DIGESTS:
        assert len(value) == DIGEST, name


def check_together(record: Any) -> None:
    """What fields of one record must be together."""
    match record:
        case Snapshot():
            assert record.message.first == 0
            check_together(record.message)
        case DeltaMessage():
            assert record.first <= record.last
            assert (record.first == 0) == (record.hello is not None)
            for part in record.parts:
                assert (part.status in (FrameStatus.ENDED, FrameStatus.CORRECTED)) == (part.end_pose is not None)
        case Heartbeat():
            assert record.checked <= record.last
        case RangeRequest():
            assert record.first <= record.last
        case map_wire.Piece():
            assert record.index < record.count
            assert len(record.data) <= PIECE_BYTES
        case OperatorEvent():
            assert (record.landmarks is None) != (record.vehicle == "")
            assert record.landmarks is None or record.landmarks[0] < record.landmarks[1]
        case JointMap():
            n, p = len(record.landmark_mean), len(record.pose_mean)
            assert len(record.names) == len(record.signature) == n
            assert len(record.poses) == p
            assert len(record.landmark_cov) in (0, n)
            assert len(record.pose_cov) in (0, p)


def every_field() -> Iterator[tuple[str, bytes]]:
    """Each node of each golden body replaced by each of `OTHERS`, left out, or there twice; a kind and a message."""
    for kind, trees in TREES.items():
        for tree in trees:
            for body in _variants(tree):
                yield kind, sealed(KINDS[kind].number, bytes(msgpack.packb(body)), None)


OTHERS: Final[tuple[Any, ...]] = (
    True, -1, 0, 2**31, 2**53 + 1, 2**64 - 1, 1.0, math.nan, math.inf, "", "a/b", "x" * 201, b"", bytes(32), None, [],
    [0, 0], {},
)  # fmt: skip


def _variants(node: Any) -> Iterator[Any]:
    yield from OTHERS
    if isinstance(node, list):
        for k, each in enumerate(node):
            yield [*node[:k], *node[k + 1 :]]
            yield [*node[:k], each, *node[k:]]
            for other in _variants(each):
                yield [*node[:k], other, *node[k + 1 :]]


def run(seed: int, count: int, each: Callable[[int], None] = lambda done: None) -> dict[str, list[int]]:
    """Check `count` inputs of a seed. For each kind: how many were read, and how many refused, unread or not."""
    mutator, receivers = Mutator(seed), Receivers()
    tally = {kind: [0, 0] for kind in KINDS}
    for number in range(count):
        kind, data = mutator.draw()
        if number % RENEW == RENEW - 1:
            receivers = Receivers()
        try:
            read = check_reader(kind, data)
            before = receivers.state(kind)
            refused = receivers.give(kind, data)
            assert read or refused, f"{kind}: not read, and yet taken"
            assert not refused or receivers.state(kind) == before, f"{kind}: refused, and yet something changed"
        except Exception as error:
            raise AssertionError(f"seed {seed}, input {number}, {kind}: {error!r}: {data.hex()}") from error
        tally[kind][0] += read
        tally[kind][1] += refused
        if number % BATCH == BATCH - 1:
            each(number + 1)
    return tally


def _chunk(job: tuple[int, int]) -> dict[str, list[int]]:
    logging.disable()
    with np.errstate(all="ignore"):
        return run(*job)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0, help="first of the seeds, one for 5000 inputs")
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    size = 5000
    jobs = [(args.seed + k, min(size, args.count - k * size)) for k in range(math.ceil(args.count / size))]
    begin, done, total = time.perf_counter(), 0, {kind: [0, 0] for kind in KINDS}
    with multiprocessing.Pool(args.processes) as pool:
        for tally in pool.imap(_chunk, jobs):
            done += size
            for kind, (read, refused) in tally.items():
                total[kind][0] += read
                total[kind][1] += refused
            rate = done / (time.perf_counter() - begin)
            print(f"\r{min(done, args.count):>9} inputs, {rate:.0f} a second", end="", flush=True)
    print("".join(f"\n{kind:>10}: {read} read, {refused} refused" for kind, (read, refused) in total.items()))


if __name__ == "__main__":
    main()
