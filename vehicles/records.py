"""Where things stand in a vehicle's store: keys, in order, and what their values are.

    c                    the largest counter that an epoch of this vehicle has had
    d  ordinal frame     where a frame ends, as the acknowledged messages of an epoch say
    e  ordinal           an epoch: see `EpochRecord`
    f                    fleet, vehicle and filter settings
    m  ordinal first     a message that not every required node has acknowledged
    r  step              a reading since the last state, with a fingerprint of the delta that the filter made of it
    s                    the filter's state, with the step it belongs to
    t  ordinal           what the acknowledged messages of an epoch come to: see `Trimmed`

Numbers are 8 bytes, big-endian. Ordinals count the epochs of this store. The filter's state is the last `s` with the
readings since: committing a step costs what the step brings, whatever the size of the map.
"""

import hashlib
from dataclasses import dataclass
from typing import Final

import msgpack
import numpy as np

from fleet_seif.delta_wire import pack_delta, read_delta
from fleet_seif.information import FrameDelta
from fleet_seif.messages import Epoch
from fleet_seif.records import Reading, Sightings

KIND: Final = "outbox"
SCHEMA: Final = 1
COUNTER: Final = b"c"
ENDS: Final = b"d"
EPOCH: Final = b"e"
IDENTITY: Final = b"f"
MESSAGE: Final = b"m"
READING: Final = b"r"
STATE: Final = b"s"
TRIMMED: Final = b"t"


def numbered(table: bytes, *numbers: int) -> bytes:
    return table + b"".join(number.to_bytes(8, "big") for number in numbers)


def after(table: bytes) -> bytes:
    """The key behind all keys that begin so."""
    return table[:-1] + bytes([table[-1] + 1])


@dataclass(frozen=True, eq=False, kw_only=True)
class EpochRecord:
    """An epoch of this store.

    hello: its first message, once there is one. base, names: what the filter had published, frame by frame, and named
    before it; ended: how many of these frames had ended. closed, closed_names: the same after it; None while it is the
    newest.
    """

    epoch: Epoch
    life: int
    base: tuple[FrameDelta, ...]
    ended: int
    names: int
    hello: bytes = b""
    closed: tuple[FrameDelta, ...] | None = None
    closed_names: tuple[int, ...] = ()

    def pack(self) -> bytes:
        base = [pack_delta(delta) for delta in self.base]
        closed = None if self.closed is None else [pack_delta(delta) for delta in self.closed]
        fields = (
            tuple(self.epoch), self.life, base, self.ended, self.names, self.hello, closed, self.closed_names
        )  # fmt: skip
        return bytes(msgpack.packb(fields))

    @staticmethod
    def read(data: bytes) -> "EpochRecord":
        epoch, life, base, ended, names, hello, closed, closed_names = msgpack.unpackb(data, use_list=False)
        return EpochRecord(
            epoch=Epoch(*epoch),
            life=life,
            base=tuple(read_delta(delta) for delta in base),
            ended=ended,
            names=names,
            hello=hello,
            closed=None if closed is None else tuple(read_delta(delta) for delta in closed),
            closed_names=closed_names,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Trimmed:
    """The acknowledged prefix of an epoch: its last message, the digest there and the sums of its statistics.

    aliases: the last word on each pair.
    """

    newest: bytes
    prefix_digest: bytes
    innovation: float
    innovation_dof: int
    refused: int
    aliases: tuple[tuple[int, int, bool], ...] = ()

    def pack(self) -> bytes:
        statistics = (self.innovation, self.innovation_dof, self.refused)
        fields = (self.newest, self.prefix_digest, *statistics, self.aliases)
        return bytes(msgpack.packb(fields))

    @staticmethod
    def read(data: bytes) -> "Trimmed":
        newest, digest, innovation, dof, refused, aliases = msgpack.unpackb(data, use_list=False)
        return Trimmed(
            newest=newest, prefix_digest=digest, innovation=innovation, innovation_dof=dof, refused=refused,
            aliases=aliases,
        )  # fmt: skip


def fingerprint(delta: FrameDelta) -> bytes:
    """8 bytes that tell whether a filter makes the same of a reading when it is replayed."""
    digest = hashlib.blake2b(delta.H, digest_size=8)  # type: ignore[arg-type]  # arrays are buffers
    digest.update(delta.b)  # type: ignore[arg-type]
    return digest.digest()


def pack_reading(reading: Reading, delta: FrameDelta) -> bytes:
    seen = reading.sightings
    arrays = (reading.odometry, reading.odometry_cov, seen.z, seen.cov)
    raw = [np.asarray(array, np.float64).tobytes() for array in arrays]
    return bytes(
        msgpack.packb((reading.time_s, *raw, np.asarray(seen.signature, np.int64).tobytes(), fingerprint(delta)))
    )


def read_reading(data: bytes) -> tuple[Reading, bytes]:
    """A reading, and the fingerprint of what the filter made of it."""
    time_s, u, cov, z, Z, signature, mark = msgpack.unpackb(data)
    seen = Sightings(
        z=np.frombuffer(z).reshape(-1, 2),
        cov=np.frombuffer(Z).reshape(-1, 2, 2),
        signature=np.frombuffer(signature, np.int64),
    )
    reading = Reading(
        time_s=time_s, odometry=np.frombuffer(u), odometry_cov=np.frombuffer(cov).reshape(3, 3), sightings=seen
    )
    return reading, mark
