"""The envelope of every message, and strict readers of the fields inside; FORMAT.md is the specification.

Reading is strict: bytes that the writer would not make raise WireError, nothing else.
"""

import hashlib
import math
from typing import Any, Final

import msgpack
import numpy as np

from fleet_seif.errors import WireError
from fleet_seif.messages import Epoch, check_name
from fleet_seif.records import Floats

MAGIC: Final = b"FSF"
VERSION: Final = 1
HEADER: Final = 5
DIGEST: Final = 32
MESSAGE_MAX: Final = 16 * 2**20
PARTS_MAX: Final = 64
ENTRIES_MAX: Final = 2**20
STEP_MAX: Final = ENTRIES_MAX**2  # of a column of ENTRIES_MAX steps: their sums stay below 2^63
SEQUENCE_MAX: Final = 2**53
PIECE_BYTES: Final = 48_000
PIECES_MAX: Final = 4096

KIND_DELTA: Final = 1
KIND_HEARTBEAT: Final = 2
KIND_ACK: Final = 3
KIND_RANGE: Final = 4
KIND_SNAPSHOT: Final = 5
KIND_PIECE: Final = 6
KIND_MAP: Final = 7


def seal(kind: int, fields: object) -> bytes:
    head = MAGIC + bytes([VERSION, kind])
    body: bytes = msgpack.packb(fields)
    return head + hashlib.blake2b(head + body, digest_size=DIGEST).digest() + body


def unseal(kind: int, data: bytes) -> Any:
    """The fields of a message of a kind, as tuples; types and ranges are the caller's to check."""
    if len(data) > MESSAGE_MAX:
        raise WireError(f"message of {len(data)} bytes: at most {MESSAGE_MAX}")
    if len(data) < HEADER + DIGEST or data[:3] != MAGIC:
        raise WireError("not a fleet_seif message")
    if data[3] != VERSION:
        raise WireError(f"message of format {data[3]}: this software reads format {VERSION}")
    if data[4] != kind:
        raise WireError(f"message of kind {data[4]} where kind {kind} belongs")
    body = data[HEADER + DIGEST :]
    if hashlib.blake2b(data[:HEADER] + body, digest_size=DIGEST).digest() != data[HEADER : HEADER + DIGEST]:
        raise WireError("digest does not match: damaged on the way")
    try:
        fields = msgpack.unpackb(body, use_list=False, raw=False, strict_map_key=True, max_array_len=ENTRIES_MAX)
        canonical = msgpack.packb(fields)
    except Exception as error:  # msgpack raises many kinds, and all of them mean bytes that are not ours
        raise WireError(f"body is not msgpack: {error!r}"[:200]) from None
    if canonical != body:
        raise WireError("body is not in its one canonical form")
    return fields


def body_digest(data: bytes) -> bytes:
    """The digest inside an encoded message, 32 bytes; it covers kind, version and body."""
    return data[HEADER : HEADER + DIGEST]


def fields_of(value: Any, count: int, what: str) -> tuple[Any, ...]:
    if not isinstance(value, tuple) or len(value) != count:
        raise WireError(f"{what}: expected {count} fields")
    return value


def items_of(value: Any, count_max: int, what: str) -> tuple[Any, ...]:
    if not isinstance(value, tuple) or len(value) > count_max:
        raise WireError(f"{what}: expected a list of at most {count_max}")
    return value


def int_of(value: Any, low: int, high: int, what: str) -> int:
    if type(value) is not int or not low <= value <= high:
        raise WireError(f"{what}: expected an integer from {low} to {high}")
    return value


def float_of(value: Any, what: str) -> float:
    if type(value) is not float or not math.isfinite(value):
        raise WireError(f"{what}: expected a finite float")
    return value


def bool_of(value: Any, what: str) -> bool:
    if type(value) is not bool:
        raise WireError(f"{what}: expected true or false")
    return value


def digest_of(value: Any, what: str) -> bytes:
    if type(value) is not bytes or len(value) != DIGEST:
        raise WireError(f"{what}: expected {DIGEST} bytes")
    return value


def text_of(value: Any, what: str) -> str:
    if type(value) is not str or len(value) > 200:
        raise WireError(f"{what}: expected a text of at most 200 characters")
    return value


def name_of(value: Any, what: str) -> str:
    try:
        return check_name(text_of(value, what), what)
    except ValueError as error:
        raise WireError(str(error)) from None


def array_of(value: Any, shape: tuple[int, ...], what: str) -> Floats:
    """An array of finite float64; a first dimension of -1 follows the length."""
    step = math.prod(k for k in shape if k >= 0) * 8
    if type(value) is not bytes or len(value) % 8 or (len(value) != step if shape[0] >= 0 else len(value) % step):
        raise WireError(f"{what}: expected float64 numbers of shape {shape}")
    array = np.frombuffer(value, "<f8").reshape(shape).copy()
    if not np.all(np.isfinite(array)):
        raise WireError(f"{what}: a number is not finite")
    return array


def raw_bytes(array: Floats) -> bytes:
    return np.ascontiguousarray(array, "<f8").tobytes()


def epoch_of(value: Any) -> Epoch:
    counter, nonce = fields_of(value, 2, "epoch")
    return Epoch(int_of(counter, 0, SEQUENCE_MAX, "epoch counter"), int_of(nonce, 0, 2**64 - 1, "epoch nonce"))


def kind_of(data: bytes) -> int:
    """The kind a message claims to be, 0 for bytes that are not ours."""
    return data[4] if len(data) > HEADER and data[:3] == MAGIC else 0
