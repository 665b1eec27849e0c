"""What a hostile or broken peer can do: nothing to others, and to its own contribution no more than stop it.

The decoder: see `tests.fuzz`, which also runs by hand. The ledger: one liar, `eve`, beside two honest vehicles. Each
class of lie is drawn at random from a seed. Whatever she sends, what the honest have contributed is as it was; she stays
at her last checked prefix, quarantined with a reason that names the message if her authentic words condemn her, or not
at all if a limit or a reader stopped them, and then her stream completes once she is honest.
"""

import dataclasses
import pickle
import random
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import numpy as np
import pytest

from fleet_seif.config import FilterSettings, FusionSettings, PublishSettings
from fleet_seif.envelope import body_digest
from fleet_seif.errors import WireError
from fleet_seif.information import H_QUANTUM, QUANTA_MAX, FrameDelta, delta_digest
from fleet_seif.joint import solve
from fleet_seif.map_wire import decode_map, encode_map
from fleet_seif.messages import (
    Ack,
    Continues,
    DeltaMessage,
    Epoch,
    Evidence,
    FramePart,
    FrameStatus,
    Heartbeat,
    Hello,
    NodeStatus,
    Snapshot,
    StreamPosition,
)
from fleet_seif.node_wire import encode_evidence, encode_status
from fleet_seif.records import Sightings
from fleet_seif.signing import KeyRing, Role, Signer
from fleet_seif.store import Change, Put
from fleet_seif.streams import EMPTY_PREFIX, Coalescer, extend_prefix
from fleet_seif.wire import encode_ack, encode_heartbeat, encode_message, encode_snapshot
from fusion.core import AskRange, FusionCore
from fusion.ledger import EPOCHS_MAX, Ledger, Receipt
from fusion.mapping import make_map, map_input
from fusion.stream import Stream
from tests import fuzz
from tests.golden import delta_of
from vehicles.core import Identity, VehicleCore

DRAWS: Final = 50
MANY: Final = 10_000
FUZZED: Final = 3_000
FUZZED_MANY: Final = 100_000


# The decoder.


def check_fuzzed(seed: int, count: int) -> None:
    tally = fuzz.run(seed, count)
    assert sum(read for read, _ in tally.values()) > 0.05 * count, "too few inputs get past the readers"
    assert all(read > 0 and refused > 0 for read, refused in tally.values()), tally


def test_fuzzed_messages_are_refused_or_canonical_and_what_is_refused_changes_nothing() -> None:
    check_fuzzed(0, FUZZED)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_many_fuzzed_messages_are_refused_or_canonical_and_what_is_refused_changes_nothing() -> None:
    for seed in range(20):
        check_fuzzed(seed, FUZZED_MANY // 20)


# A world without a filter: streams written down by hand.

FLEET: Final = "f"
EPOCH: Final = Epoch(1, 7)
HONEST: Final = ("ann", "bob")
VEHICLES: Final = (*HONEST, "eve")
NEXT: Final = 7
"""What everybody has said when eve begins to lie is 0 .. 6, checked up to 4."""
CHECKED: Final = 4
LAST: Final = 9
START: Final = 100.0
LIMIT: Final = 1000.0
"""What hellos declare: start information, and information a step."""
LANDMARKS: Final = {0: (2.0, 1.0), 1: (3.0, -1.0), 2: (5.0, 2.0)}
OPENED, CONTINUED, ENDED, CORRECTED = FrameStatus
SETTINGS: Final = FusionSettings(parked_max=8, parked_bytes_max=8_000, parked_bytes_all_max=12_000, gap_max=100)


def H(value: float) -> int:
    return round(value / H_QUANTUM)


def seen(n: int, weight: int = 10) -> FrameDelta:
    """A landmark seen from the pose, at the difference of their places, and a little more about the pose."""
    w, (x, y) = H(weight), LANDMARKS[n]
    b = [round(weight * v * 2**24) for v in (x, y)]
    return delta_of(
        {(0, 0): [w + H(1), 0, 0, w + H(1), 0, H(1)], (0, n + 1): [-w, 0, 0, -w, 0, 0], (n + 1, n + 1): [w, 0, w]},
        {0: [-b[0], -b[1], 0], n + 1: b},
    )


def pose(weight: float) -> FrameDelta:
    return delta_of({(0, 0): [H(weight), 0, 0, H(weight), 0, H(weight)]}, {})


def part(status: FrameStatus, delta: FrameDelta, frame: int = 0) -> FramePart:
    ends = status in (ENDED, CORRECTED)
    return FramePart(frame=frame, status=status, delta=delta, end_pose=np.array([1.0, 0.0, 0.1]) if ends else None)


def hello(vehicle: str, **changes: Any) -> Hello:
    x = float(VEHICLES.index(vehicle))
    plain: dict[str, Any] = {
        "software": "by hand", "life": 0, "placed": True, "start_pose": np.array([x, -x, 0.5 * x]),
        "start_pose_cov": np.zeros((3, 3)), "start_information": START, "step_information_max": LIMIT,
    }  # fmt: skip
    return Hello(**{**plain, **changes})


def message(vehicle: str, k: int, last: int | None = None, **changes: Any) -> DeltaMessage:
    plain: dict[str, Any] = {
        "fleet": FLEET, "vehicle": vehicle, "epoch": EPOCH, "first": k, "last": k if last is None else last, "step": k,
        "time_s": float(k), "parts": (), "hello": hello(vehicle) if k == 0 else None,
    }  # fmt: skip
    return DeltaMessage(**{**plain, **changes})


@cache
def told(vehicle: str) -> tuple[DeltaMessage, ...]:
    """What a vehicle says if it is honest: two frames, three landmarks, messages 0 .. 9."""
    parts: dict[int, tuple[FramePart, ...]] = {
        0: (part(OPENED, pose(START)),),
        1: (part(CONTINUED, seen(0)),),
        2: (part(CONTINUED, seen(1)),),
        3: (part(CONTINUED, seen(0)),),
        4: (part(ENDED, seen(1)), part(OPENED, pose(START), 1)),
        5: (part(CONTINUED, seen(1), 1),),
        6: (part(CONTINUED, seen(2), 1),),
        7: (part(CONTINUED, seen(1), 1),),
        8: (part(CONTINUED, seen(2), 1),),
        9: (part(ENDED, FrameDelta.nothing(), 1),),
    }
    names = {1: ((0, 70),), 2: ((1, 71),), 6: ((2, 72),)}
    return tuple(message(vehicle, k, parts=parts[k], landmarks=names.get(k, ()), end=k == LAST) for k in parts)


@cache
def honest_bytes(vehicle: str) -> tuple[bytes, ...]:
    return tuple(encode_message(m) for m in told(vehicle))


def prefix_digest(vehicle: str, last: int) -> bytes:
    digest = EMPTY_PREFIX
    for data in honest_bytes(vehicle)[: last + 1]:
        digest = extend_prefix(digest, body_digest(data))
    return digest


def give(ledger: Ledger, sender: str, data: bytes) -> Receipt | None:
    """What became of it; None where it was malformed."""
    try:
        return ledger.accept(data, sender)[0]
    except WireError:
        return None


def contribution(stream: Stream) -> object:
    """All that canonical maps take from a stream, and what is acknowledged of it."""
    assert stream.life is not None
    checked = stream.life.checked
    frames = {number: delta_digest(delta) for number, delta in checked.frames.items()}
    return frames, checked.names, checked.healthy, stream.checked, stream.next, stream.prefix_digest, stream.quarantine


def map_digest_of_the_honest(ledger: Ledger) -> object:
    lives = [life for life in ledger.lives() if life.vehicle in HONEST]
    frames = [(life.vehicle, life.start_pose.tobytes(), *map(delta_digest, life.frames)) for life in lives]
    return frames, ledger.classes(lives)


@dataclass(frozen=True)
class World:
    """The ledger when eve begins to lie, pickled; what it holds of whom; and all honest streams in the end."""

    pickled: bytes
    stored: dict[bytes, bytes]
    honest: dict[str, object]
    honest_map: object
    whole: object
    eve_checked: dict[int, object]


@cache
def world() -> World:
    ledger, eve_checked = Ledger(FLEET, SETTINGS), {-1: {}}
    for vehicle in VEHICLES:
        for data in honest_bytes(vehicle)[:NEXT]:
            _, stream = ledger.accept(data, vehicle)
            if vehicle == "eve":
                assert stream.life is not None
                frames = stream.life.checked.frames
                eve_checked[stream.checked] = {number: delta_digest(delta) for number, delta in frames.items()}
    assert all(stream.checked == CHECKED for stream in ledger.streams.values())
    stored = {change.key: change.value for change in ledger.take_changes() if isinstance(change, Put)}
    honest = {vehicle: contribution(ledger.streams[vehicle, EPOCH]) for vehicle in HONEST}
    pickled, honest_map = pickle.dumps(ledger), map_digest_of_the_honest(ledger)
    for vehicle in VEHICLES:
        for data in honest_bytes(vehicle)[NEXT:]:
            ledger.accept(data, vehicle)
    whole = contribution(ledger.streams["eve", EPOCH])
    return World(pickled, stored, honest, honest_map, whole, eve_checked)


def fresh() -> Ledger:
    ledger: Ledger = pickle.loads(world().pickled)
    return ledger


# Lies.

QUARANTINED, STOPPED, REFUSED = "quarantined", "stopped", "refused"


@dataclass(frozen=True)
class Lie:
    """What eve sends, and what comes of it.

    QUARANTINED: of `epoch`, because of message `number`; she stays at what was checked up to `checked`.
    STOPPED: by a limit, or as something that is too late. REFUSED: unread. Both leave her as she was.
    """

    inputs: Sequence[tuple[str, bytes]]
    fate: str
    number: int = -1
    checked: int = CHECKED
    epoch: Epoch = field(default=EPOCH)


def by_eve(*messages: DeltaMessage, signer: Signer | None = None) -> list[tuple[str, bytes]]:
    return [("eve", encode_message(m, signer)) for m in messages]


def lied(k: int, last: int | None = None, **changes: Any) -> DeltaMessage:
    return message("eve", k, last, **changes)


def quarantined(*messages: DeltaMessage, number: int = NEXT, **more: Any) -> Lie:
    return Lie(by_eve(*messages), QUARANTINED, number, **more)


def diagonal(variable: int, value: int) -> FrameDelta:
    """A value at one place of a variable's diagonal."""
    return delta_of({(variable, variable): [value, 0, 0, 0, 0, 0] if variable == 0 else [0, 0, value]}, {})


def indefinite(rng: random.Random) -> Lie:
    much = rng.randrange(2**45, 2**58)
    a, b = sorted(rng.sample(range(4), 2))
    size = 6 if a == 0 else 4
    delta = rng.choice([diagonal(rng.randrange(4), -much), delta_of({(a, b): [much] * size}, {})])
    match rng.randrange(4):
        case 0:  # caught at once
            return quarantined(lied(7, parts=(part(ENDED, delta, 1),)))
        case 1:  # at the end of the stream
            later = [told("eve")[8], told("eve")[9]]
            return quarantined(lied(7, parts=(part(CONTINUED, delta, 1),)), *later, number=LAST)
        case 2:  # in a frame that had ended
            return quarantined(lied(7, parts=(part(CORRECTED, delta, 0),)))
        case _:  # at a multiple of 64
            last = rng.randrange(64, 128)
            return quarantined(lied(7, last, parts=(part(CONTINUED, delta, 1),)), number=last)


def absurd(rng: random.Random) -> Lie:
    steps = rng.randrange(1, 4)
    over = rng.choice((1, rng.randrange(1, 2**40)))
    if rng.random() < 0.3:
        opened = part(OPENED, diagonal(0, H(steps * LIMIT + START) + over), 2)
        return quarantined(lied(7, 6 + steps, parts=(part(ENDED, FrameDelta.nothing(), 1), opened)))
    delta = diagonal(rng.randrange(4), H(steps * LIMIT) + over)
    return quarantined(lied(7, 6 + steps, parts=(part(rng.choice((CONTINUED, ENDED)), delta, 1),)))


def above_every_limit(rng: random.Random) -> Lie:
    value = rng.choice((0.0, -0.0, -1.0, float("inf"), float("nan"), 1e9 * (1 + 2**-52), rng.uniform(1e9 + 1, 1e300)))
    name = rng.choice(("start_information", "step_information_max"))
    epoch = Epoch(2, rng.getrandbits(64))
    return Lie(by_eve(lied(0, epoch=epoch, hello=hello("eve", **{name: value}))), REFUSED)


def unnamed_landmark(rng: random.Random) -> Lie:
    number = rng.choice((4, 5, rng.randrange(4, 2**31)))
    delta = rng.choice([diagonal(number, H(1)), delta_of({(0, number): [1] * 6}, {}), delta_of({}, {number: [0, 1]})])
    return quarantined(lied(7, parts=(part(CONTINUED, delta, 1),)))


def frames_out_of_order(rng: random.Random) -> Lie:
    nothing, far = FrameDelta.nothing(), rng.randrange(3, 2**31)
    end = part(ENDED, nothing, 1)
    wrong = rng.choice([
        (part(CONTINUED, nothing, 0),), (part(CONTINUED, nothing, 2),), (part(CONTINUED, nothing, far),),
        (part(OPENED, nothing, 0),), (part(OPENED, nothing, 1),), (part(OPENED, pose(1), 2),),
        (part(OPENED, nothing, far),), (part(ENDED, nothing, 0),), (part(ENDED, nothing, 2),), (end, end),
        (part(CORRECTED, nothing, 1),), (part(CORRECTED, nothing, far),), (end, part(CONTINUED, nothing, 1)),
        (end, part(OPENED, pose(1), 3)), (end, part(OPENED, pose(1), 2), part(OPENED, pose(1), 3)),
    ])  # fmt: skip
    return quarantined(lied(7, parts=wrong))


def alias_of_nothing(rng: random.Random) -> Lie:
    a, b = rng.choice([(0, 3), (3, 0), (1, 1), (rng.randrange(3, 2**31 - 1), 1), (0, rng.randrange(3, 2**31 - 1))])
    good = ((0, 1, True),) * rng.randrange(3)
    return quarantined(lied(7, aliases=(*good, (a, b, rng.random() < 0.5))))


def landmarks_out_of_order(rng: random.Random) -> Lie:
    numbers = rng.choice([(4,), (2,), (0,), (3, 3), (4, 3), (3, 5), (rng.randrange(4, 2**31 - 1),)])
    return quarantined(lied(7, landmarks=tuple((n, rng.randrange(-1, 2**63)) for n in numbers)))


def overflow(rng: random.Random) -> Lie:
    sign, variable = rng.choice((1, -1)), rng.randrange(4)
    first = rng.randrange(2**59 + 2**40, QUANTA_MAX)
    second = rng.randrange(QUANTA_MAX - first + 2**40, QUANTA_MAX)
    if rng.random() < 0.5:
        deltas = [delta_of({}, {variable: [sign * v, 0, 0][: 3 if variable == 0 else 2]}) for v in (first, second)]
    else:
        deltas = [delta_of({(0, 2): [0, 0, 0, sign * v, 0, 0]}, {}) for v in (first, second)]
    if rng.random() < 0.5:  # within one message
        return quarantined(lied(7, parts=tuple(part(CONTINUED, delta, 1) for delta in deltas)))
    return quarantined(*(lied(7 + i, parts=(part(CONTINUED, deltas[i], 1),)) for i in range(2)), number=8)


def another_body(rng: random.Random, m: DeltaMessage) -> DeltaMessage:
    changes: list[dict[str, Any]] = [
        {"step": m.step + rng.randrange(1, 9)}, {"time_s": m.time_s + rng.random() + 1e-3}, {"healthy": not m.healthy},
        {"refused": rng.randrange(1, 2**53)}, {"innovation": rng.random() + 1e-9}, {"aliases": ((0, 1, True),)},
        {"last": m.last + rng.randrange(1, 99)}, {"parts": ()},
    ]  # fmt: skip
    return dataclasses.replace(m, **rng.choice(changes))


def checked_before(number: int) -> int:
    return CHECKED if number > CHECKED else 0 if number > 0 else -1


def same_number(rng: random.Random) -> Lie:
    k = rng.randrange(LAST)
    honest = by_eve(*told("eve")[NEXT : k + 1]) if rng.random() < 0.5 or k == NEXT else by_eve(*told("eve")[k : k + 1])
    return Lie([*honest, *by_eve(another_body(rng, told("eve")[k]))], QUARANTINED, k, checked_before(k))


def overlapping_ranges(rng: random.Random) -> Lie:
    first = rng.randrange(NEXT)
    last = rng.randrange(first + 1, 40)
    m = lied(first, last) if first else lied(0, last, parts=(part(OPENED, pose(START)),))
    return Lie(by_eve(m), QUARANTINED, first, checked_before(first))


def continuing(last: int, epoch: Epoch, digest: bytes | None = None, **changes: Any) -> DeltaMessage:
    """Message 0 of an epoch that continues the first one."""
    digest = prefix_digest("eve", last) if digest is None else digest
    continues = Continues(epoch=EPOCH, last=last, prefix_digest=digest)
    return lied(0, epoch=epoch, hello=hello("eve", continues=continues, **changes))


def two_that_continue_one(rng: random.Random) -> Lie:
    a, b = rng.choice([(6, 6), (6, rng.randrange(7, 10)), (rng.randrange(7, 10), rng.randrange(7, 10))])
    epochs = [Epoch(rng.randrange(1, 9), n + 10) for n in rng.sample(range(99), 2)]
    further = [lied(1, epoch=epochs[0], parts=(part(CONTINUED, seen(1), 1),))] * rng.randrange(2)
    pair = [continuing(a, epochs[0]), *further, continuing(b, epochs[1])]
    return quarantined(*pair, number=min(a, b) + 1)


def beyond_where_it_was_continued(rng: random.Random) -> Lie:
    last = rng.randrange(NEXT - 1)
    m = continuing(last, Epoch(2, rng.getrandbits(64)))
    return quarantined(m, number=last + 1, checked=checked_before(last + 1))


def another_history(rng: random.Random) -> Lie:
    epoch = Epoch(rng.randrange(2, 99), rng.getrandbits(64))
    if rng.random() < 0.5:
        return Lie(by_eve(continuing(6, epoch, rng.randbytes(32))), QUARANTINED, -1, epoch=epoch)
    life = rng.randrange(1, 2**31)
    return Lie(by_eve(continuing(6, epoch, life=life)), QUARANTINED, 0, epoch=epoch)


def of_others(rng: random.Random) -> Lie:
    k = rng.randrange(NEXT + 3)
    fleet = {"fleet": rng.choice(("g", "F", "f2"))}
    name = {"vehicle": rng.choice((*HONEST, "Eve", "eve2"))}
    changes = rng.choice([fleet, name, {**fleet, **name}])
    return Lie(by_eve(dataclasses.replace(told("eve")[k], **changes)), REFUSED)


def after_the_end(rng: random.Random) -> Lie:
    rest = list(told("eve")[NEXT:])
    first = rng.randrange(LAST + 1, LAST + 50)
    rest.insert(rng.choice((len(rest), rng.randrange(len(rest)))), lied(first, first + rng.randrange(3)))
    return Lie(by_eve(*rest), STOPPED)


def garbage_snapshot(rng: random.Random) -> Lie:
    last = rng.randrange(NEXT, 200)
    bad = rng.choice([
        {"parts": (part(OPENED, diagonal(0, -rng.randrange(1, 2**50))),)},
        {"parts": (part(CONTINUED, pose(1)),)}, {"parts": (part(OPENED, pose(1), 1),)},
        {"parts": (part(OPENED, diagonal(0, H((last + 2) * LIMIT + START))),)},
        {"parts": (part(OPENED, pose(1)),), "landmarks": ((1, 5),)},
        {"parts": (part(OPENED, pose(1)), part(CONTINUED, diagonal(9, 1)))},
        {"parts": (part(OPENED, pose(1)),), "aliases": ((0, 1, True),)},
    ])  # fmt: skip
    snapshot = Snapshot(message=lied(0, last, **bad), prefix_digest=rng.randbytes(32))
    return Lie([("eve", encode_snapshot(snapshot))], STOPPED)


def unannounced_snapshot(rng: random.Random) -> Lie:
    """A node's snapshot, right but for that nobody has vouched for its digest."""
    whole = Coalescer(told("eve")[0])
    last = rng.randrange(NEXT, LAST + 1)
    for m in told("eve")[1 : last + 1]:
        whole.add(m)
    digest = rng.choice([prefix_digest("eve", last), rng.randbytes(32)])
    return Lie([("eve", encode_snapshot(Snapshot(message=whole.message(), prefix_digest=digest, maker="fusion")))], STOPPED)


def huge_gap(rng: random.Random) -> Lie:
    first = rng.choice((NEXT + SETTINGS.gap_max + 1, rng.randrange(NEXT + SETTINGS.gap_max + 1, 2**53), 2**53))
    return Lie(by_eve(lied(first, rng.choice((first, 2**53)))), STOPPED)


def parked_flood(rng: random.Random) -> Lie:
    count = rng.randrange(SETTINGS.parked_max + 1, 16)
    firsts = rng.sample(range(LAST + 1, NEXT + SETTINGS.gap_max), count)
    fat = tuple((n, -1) for n in range(rng.choice((0, 500))))
    return Lie(by_eve(*(lied(first, landmarks=fat) for first in firsts)), STOPPED)


LIES: dict[str, Callable[[random.Random], Lie]] = {
    lie.__name__: lie
    for lie in (
        indefinite, absurd, above_every_limit, unnamed_landmark, frames_out_of_order, alias_of_nothing,
        landmarks_out_of_order, overflow, same_number, overlapping_ranges, two_that_continue_one,
        beyond_where_it_was_continued, another_history, of_others, after_the_end, garbage_snapshot,
        unannounced_snapshot, huge_gap, parked_flood,
    )
}  # fmt: skip


def applied(stored: dict[bytes, bytes], changes: Iterable[Change]) -> dict[bytes, bytes]:
    """What a store holds after changes."""
    out = dict(stored)
    for change in changes:
        if isinstance(change, Put):
            out[change.key] = change.value
        else:
            out = {key: value for key, value in out.items() if not change.low <= key < change.high}
    return out


def check_the_honest(ledger: Ledger) -> None:
    """What they have contributed, the map of it, and what is acknowledged are as before; and they can go on."""
    for vehicle in HONEST:
        assert contribution(ledger.streams[vehicle, EPOCH]) == world().honest[vehicle]
    assert map_digest_of_the_honest(ledger) == world().honest_map
    assert ledger.accept(honest_bytes("ann")[NEXT], "ann")[0] is Receipt.FOLDED


def check_eve(ledger: Ledger, lie: Lie, receipts: Sequence[Receipt | None]) -> None:
    streams = [stream for (vehicle, _), stream in ledger.streams.items() if vehicle == "eve"]
    stream = ledger.streams["eve", EPOCH]
    if lie.fate == QUARANTINED:
        assert Receipt.REFUSED in receipts, receipts
        faulty = ledger.streams["eve", lie.epoch]
        assert re.search(rf"message {lie.number}\b" if lie.number >= 0 else "another history", faulty.quarantine)
        assert [s for s in streams if s.quarantine] == [faulty]
        assert stream.checked == lie.checked
    else:
        assert not any(s.quarantine for s in streams), [s.quarantine for s in streams]
        assert all(r in ((None,) if lie.fate == REFUSED else Receipt) for r in receipts), receipts
    if stream.checked in world().eve_checked:
        frames = {} if stream.life is None else stream.life.checked.frames
        assert {n: delta_digest(d) for n, d in frames.items()} == world().eve_checked[stream.checked]
    else:
        assert contribution(stream) == world().whole


def check_repair(ledger: Ledger) -> None:
    """Whom a limit or a reader has stopped completes with the honest messages."""
    for data in honest_bytes("eve")[NEXT:]:
        ledger.accept(data, "eve")
    stream = ledger.streams["eve", EPOCH]
    assert contribution(stream) == world().whole
    assert stream.ended
    assert not stream.parked


def check_store(ledger: Ledger, changes: list[Change], *, restore: bool) -> None:
    """The store holds what the ledger holds, and a ledger made from it is the same."""
    stored = applied(world().stored, changes)
    assert stored == {change.key: change.value for change in ledger.contents() if isinstance(change, Put)}
    if restore:
        again = Ledger(FLEET, SETTINGS)
        again.restore(sorted(stored.items()))
        assert (again.ledger_digest(), again.map_digest()) == (ledger.ledger_digest(), ledger.map_digest())


def check_lie(lie: Lie, *, restore: bool) -> None:
    ledger = fresh()
    receipts = [give(ledger, sender, data) for sender, data in lie.inputs]
    check_eve(ledger, lie, receipts)
    check_store(ledger, ledger.take_changes(), restore=restore)
    check_the_honest(ledger)
    if lie.fate != QUARANTINED:
        check_repair(ledger)


def check_class(name: str, draws: int) -> None:
    rng = random.Random(name)
    for k in range(draws):
        lie = LIES[name](rng)
        try:
            check_lie(lie, restore=k % 50 == 0)
        except Exception as error:
            raise AssertionError(f"draw {k}: {error!r}: {lie.number} {[data.hex() for _, data in lie.inputs]}") from error


@pytest.mark.parametrize("name", LIES)
def test_a_lie_stops_the_liar_and_nobody_else(name: str) -> None:
    check_class(name, DRAWS)


@pytest.mark.slow
@pytest.mark.parametrize("name", LIES)
def test_ten_thousand_lies_stop_the_liar_and_nobody_else(name: str) -> None:
    check_class(name, MANY)


@pytest.mark.parametrize("checked", [-1, 0, CHECKED])
def test_the_map_beside_a_quarantined_vehicle_is_positive_definite(checked: int) -> None:
    """What checked prefixes can come to: those of the honest, and one of eve's."""
    ledger = fresh()
    if checked < CHECKED:
        m = dataclasses.replace(told("eve")[checked + 1], step=99)
        assert give(ledger, "eve", encode_message(m)) is Receipt.REFUSED
        assert ledger.streams["eve", EPOCH].checked == checked
    lives = ledger.lives()
    solution = solve(lives, ledger.classes(lives))
    assert np.linalg.eigvalsh(solution.H.toarray())[0] > 0
    assert np.all(np.isfinite(solution.mean))


# The same messages in any order.


def exchange(a: Ledger, b: Ledger) -> None:
    """Evidence, as nodes tell each other."""
    for one, other in ((a, b), (b, a)):
        for data in [s.evidence for s in one.streams.values() if s.evidence]:
            other.accept_evidence(data)


def verdicts(ledger: Ledger) -> object:
    streams = {
        key: (s.quarantine, s.next, s.prefix_digest, s.checked)
        for key, s in sorted(ledger.streams.items())
        if s.next > 0 or s.quarantine
    }
    return streams, ledger.map_digest(), ledger.ledger_digest()


def check_orders(lie: Lie, rng: random.Random) -> None:
    everything = [*((v, data) for v in VEHICLES for data in honest_bytes(v)), *lie.inputs]
    ledgers = [Ledger(FLEET), Ledger(FLEET)]
    for ledger in ledgers:
        for sender, data in rng.sample(everything, len(everything)):
            give(ledger, sender, data)
    for _ in range(3):
        exchange(*ledgers)
        for ledger in ledgers:
            for sender, data in everything:
                give(ledger, sender, data)
    assert verdicts(ledgers[0]) == verdicts(ledgers[1])


@pytest.mark.parametrize("name", LIES)
def test_two_nodes_come_to_the_same_verdict_whatever_the_order(name: str) -> None:
    rng = random.Random(f"order {name}")
    for _ in range(DRAWS // 2):
        check_orders(LIES[name](rng), rng)
