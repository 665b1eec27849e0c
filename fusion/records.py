"""Where things stand in a fusion node's store: keys, in order, and what their values are.

    f                                 fleet and node, msgpack
    m  vehicle \0 counter nonce first   a folded message, or a snapshot of the prefix as the first: the bytes received
    w  vehicle \0 counter nonce         the heartbeat that announced a check point up to which may be compacted
    v  vehicle \0 counter nonce         the heartbeat that announced the end of the snapshot
    x  vehicle \0 counter nonce         evidence that a vehicle contradicts itself
    q  vehicle \0 counter nonce         why a stream is quarantined, UTF-8: a copy of the verdict, for people
    e  number operator                the decision of an operator
    n  name                           a note of the service, such as its endpoint

Numbers are 8 bytes, big-endian, so that keys ascend as they do.
"""

from typing import Final

from fleet_seif.messages import Epoch

SCHEMA: Final = 1
KIND: Final = "ledger"
IDENTITY: Final = b"f"
MESSAGE: Final = b"m"
WITNESS: Final = b"w"
VOUCHER: Final = b"v"
EVIDENCE: Final = b"x"
QUARANTINE: Final = b"q"
EVENT: Final = b"e"
NOTE: Final = b"n"


def stream_key(table: bytes, vehicle: str, epoch: Epoch) -> bytes:
    """The key of something about a stream; for MESSAGE the beginning of all its messages' keys."""
    return table + vehicle.encode() + b"\0" + epoch.counter.to_bytes(8, "big") + epoch.nonce.to_bytes(8, "big")


def message_key(vehicle: str, epoch: Epoch, first: int) -> bytes:
    return stream_key(MESSAGE, vehicle, epoch) + first.to_bytes(8, "big")


def event_key(number: int, operator: str) -> bytes:
    return EVENT + number.to_bytes(8, "big") + operator.encode()


def stream_of(key: bytes) -> tuple[str, Epoch]:
    """The stream in a key about one."""
    name, _, rest = key[1:].partition(b"\0")
    return name.decode(), Epoch(int.from_bytes(rest[:8], "big"), int.from_bytes(rest[8:16], "big"))
