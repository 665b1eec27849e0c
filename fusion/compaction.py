"""Forgetting single messages: one snapshot instead of a prefix, with the same totals and the same digest."""

from fleet_seif.envelope import KIND_SNAPSHOT, kind_of
from fleet_seif.errors import NumericalError, WireError
from fleet_seif.messages import Snapshot
from fleet_seif.signing import Signer
from fleet_seif.store import Change, Delete, Put
from fleet_seif.streams import Coalescer
from fleet_seif.wire import decode_heartbeat, decode_message, decode_snapshot, encode_snapshot
from fusion import records
from fusion.stream import Stream

LEAST = 2
"""Messages that a snapshot must stand for to be worth it."""


def compact(stream: Stream, confirmed: int, node: str, signer: Signer | None) -> list[Change]:
    """Replace a stream's prefix by a snapshot, up to the check point that its vehicle has announced (its witness).

    Args:
        confirmed: the last number that every required node holds; a witness beyond it must wait.

    Returns the changes for the store, none where there is nothing to gain or the snapshot would be too large.
    """
    if not stream.witness:
        return []
    upto = decode_heartbeat(stream.witness).checked
    at = next((i for i, first in enumerate(stream.firsts) if first > upto), len(stream.log))
    if upto not in stream.check_digests or upto > confirmed or at < LEAST:
        return []
    try:
        snapshot = _snapshot(stream.log[:at], stream.check_digests[upto], node)
        data = encode_snapshot(snapshot, signer)
        decode_snapshot(data)
    except (WireError, NumericalError, OverflowError):  # beyond a limit of the format: its messages stay as they are
        return []
    stream.log_bytes += len(data) - sum(len(each) for each in stream.log[:at])
    stream.voucher = stream.witness
    stream.log[:at], stream.firsts[:at], stream.times_s[:at] = [data], [0], [snapshot.message.time_s]
    low, high = (records.message_key(*stream.key, number) for number in (0, upto + 1))
    return [Delete(low, high), Put(low, data), Put(records.stream_key(records.VOUCHER, *stream.key), stream.voucher)]


def _snapshot(messages: list[bytes], prefix_digest: bytes, node: str) -> Snapshot:
    """One message for several; the first may be a snapshot itself."""
    first = messages[0]
    whole = Coalescer(decode_snapshot(first).message if kind_of(first) == KIND_SNAPSHOT else decode_message(first))
    for data in messages[1:]:
        whole.add(decode_message(data))
    return Snapshot(message=whole.message(), prefix_digest=prefix_digest, maker=node)
