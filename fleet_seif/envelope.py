"""The envelope of every message, and strict readers of the fields inside; FORMAT.md is the specification.

Reading is strict: bytes that the writer would not make raise WireError, nothing else. A signature is checked before
anything of the body is looked at.
"""

import hashlib
import math
from typing import Any, Final

import msgpack
import numpy as np

from fleet_seif.errors import WireError
from fleet_seif.information import VARIABLE_MAX
from fleet_seif.messages import Epoch, LandmarkName, check_name
from fleet_seif.records import Floats
from fleet_seif.signing import KeyRing, Role, Signer

MAGIC: Final = b"FSF"
VERSION: Final = 2
HEADER: Final = 5
DIGEST: Final = 32
DIGEST_END: Final = HEADER + DIGEST
SIGNATURE: Final = 64
SIGNED: Final = b"fleet_seif signature\0"
MESSAGE_MAX: Final = 16 * 2**20
DELTA_MAX: Final = 7 * 2**20
PARTS_MAX: Final = 20_000
ENTRIES_MAX: Final = 2**20
STEP_MAX: Final = ENTRIES_MAX**2  # of a column of ENTRIES_MAX steps: their sums stay below 2^63
SEQUENCE_MAX: Final = 2**53
PIECE_BYTES: Final = 48_000
PIECES_MAX: Final = 4096
REPLIES_MAX: Final = 4096
COUNTERS_MAX: Final = 256

KIND_DELTA: Final = 1
KIND_HEARTBEAT: Final = 2
KIND_ACK: Final = 3
KIND_RANGE: Final = 4
KIND_SNAPSHOT: Final = 5
KIND_PIECE: Final = 6
KIND_MAP: Final = 7
KIND_EVENT: Final = 8
KIND_STATUS: Final = 9
KIND_EVIDENCE: Final = 10
KIND_MERGES: Final = 11


def seal(kind: int, fields: object, signer: Signer | None = None) -> bytes:
    """A message of a kind. With a signer it carries a signature over magic, version, kind and digest."""
    head = MAGIC + bytes([VERSION, kind])
    body: bytes = msgpack.packb(fields)
    head += hashlib.blake2b(head + body, digest_size=DIGEST).digest()
    if signer is None:
        return head + b"\0" + body
    return head + b"\1" + signer.sign(SIGNED + head) + body


def _split(kind: int, data: bytes) -> tuple[bytes, bytes]:
    """Signature (empty: none) and body of a message; envelope and digest are checked."""
    if len(data) > MESSAGE_MAX:
        raise WireError(f"message of {len(data)} bytes: at most {MESSAGE_MAX}")
    if len(data) <= DIGEST_END or data[:3] != MAGIC:
        raise WireError("not a fleet_seif message")
    if data[3] != VERSION:
        raise WireError(f"message of format {data[3]}: this software reads format {VERSION}")
    if data[4] != kind:
        raise WireError(f"message of kind {data[4]} where kind {kind} belongs")
    flag = data[DIGEST_END]
    start = DIGEST_END + 1 + (SIGNATURE if flag == 1 else 0)
    if flag > 1 or len(data) < start:
        raise WireError("the signature is neither absent nor whole")
    body = data[start:]
    if hashlib.blake2b(data[:HEADER] + body, digest_size=DIGEST).digest() != data[HEADER:DIGEST_END]:
        raise WireError("digest does not match: damaged on the way")
    return data[DIGEST_END + 1 : start], body


def unseal(kind: int, data: bytes) -> Any:
    """The fields of a message of a kind, as tuples; types and ranges are the caller's to check."""
    _, body = _split(kind, data)
    try:
        fields = msgpack.unpackb(
            body, use_list=False, raw=False, strict_map_key=True, max_array_len=ENTRIES_MAX,
            max_map_len=COUNTERS_MAX if kind == KIND_MAP else 0, max_ext_len=0,
        )  # fmt: skip
        canonical = msgpack.packb(fields)
    except Exception as error:  # msgpack raises many kinds, and all of them mean bytes that are not ours
        raise WireError(f"body is not msgpack: {error!r}"[:200]) from None
    if canonical != body:
        raise WireError("body is not in its one canonical form")
    return fields


def authenticate(data: bytes, keys: KeyRing | None, role: Role, name: str) -> None:
    """Raise WireError unless these bytes were signed by `name`. Without a key ring everybody is believed."""
    if keys is None:
        return
    signature = data[DIGEST_END + 1 : DIGEST_END + 1 + SIGNATURE]
    if not is_signed(data) or not keys.verify(role, name, SIGNED + data[:DIGEST_END], signature):
        raise WireError(f"not signed by {role} {name!r}, or its key is not in the key ring")


def is_signed(data: bytes) -> bool:
    """Whether a message carries a signature, right or wrong."""
    return len(data) > DIGEST_END and data[DIGEST_END] == 1


def body_digest(data: bytes) -> bytes:
    """The digest inside an encoded message, 32 bytes; it covers kind, version and body."""
    return data[HEADER:DIGEST_END]


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


def landmark_name_of(value: Any) -> LandmarkName:
    vehicle, life, number = fields_of(value, 3, "landmark name")
    return LandmarkName(
        name_of(vehicle, "vehicle"), int_of(life, 0, VARIABLE_MAX, "life"), int_of(number, 0, VARIABLE_MAX, "number")
    )


def kind_of(data: bytes) -> int:
    """The kind a message claims to be, 0 for bytes that are not ours."""
    return data[4] if len(data) > HEADER and data[:3] == MAGIC else 0
