"""Signed integers as little-endian base-128 groups, zigzag coded: small magnitudes take few bytes.

A value v becomes u = 2 v for v >= 0 and -2 v - 1 otherwise; u is written in groups of seven bits, lowest first, the top
bit of a byte set on all but the last. The form is unique: a last byte of 0 after others, and values of 2^61 quanta or
more, are refused.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from fleet_seif.jit import kernel
from fleet_seif.records import Ints

VALUE_MAX: Final = 2**61
BYTES_MAX: Final = 9

Bytes = NDArray[np.uint8]


@kernel
def _encode(values: Ints, out: Bytes) -> int:
    n = 0
    for v in values:
        u = 2 * v if v >= 0 else -2 * v - 1
        while u >= 128:
            out[n] = (u & 127) | 128
            u >>= 7
            n += 1
        out[n] = u
        n += 1
    return n


@kernel
def _decode(data: Bytes, out: Ints) -> int:
    """Number of values, or -1 where the bytes are not of the unique form."""
    n = at = 0
    while at < len(data):
        u, shift = np.int64(0), 0
        while True:
            if at == len(data) or shift >= 7 * BYTES_MAX:
                return -1
            byte = np.int64(data[at])
            at += 1
            u |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                if byte == 0 and shift > 7:
                    return -1
                break
        if u >= 2 * VALUE_MAX - 1:
            return -1
        out[n] = u >> 1 if u & 1 == 0 else -(u >> 1) - 1
        n += 1
    return n


def encode_ints(values: Ints) -> bytes:
    """Bytes of int64 values, each of magnitude below VALUE_MAX."""
    if len(values) and not -VALUE_MAX < values.min() <= values.max() < VALUE_MAX:
        raise ValueError(f"values must stay below 2^61 in magnitude, got {values.min()} .. {values.max()}")
    out = np.empty(BYTES_MAX * len(values), np.uint8)
    return out[: _encode(values, out)].tobytes()


def decode_ints(data: bytes) -> Ints | None:
    """The values, shape (n,), or None where the bytes are not what encode_ints makes."""
    out = np.empty(len(data), np.int64)
    n = _decode(np.frombuffer(data, np.uint8), out)
    return None if n < 0 else out[:n].copy()
