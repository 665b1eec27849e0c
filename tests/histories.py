"""Tiny histories of two vehicles, made by hand: what they say honestly, and what they may say instead.

The matrices have a few rows, so that a run of thousands of messages takes a second. Check points are where frames end
or are corrected, and at number 0.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from fleet_seif.envelope import body_digest
from fleet_seif.information import FrameDelta, row_offsets
from fleet_seif.messages import Continues, DeltaMessage, Epoch, FramePart, FrameStatus, Hello, Snapshot
from fleet_seif.streams import EMPTY_PREFIX, Coalescer, extend_prefix
from fleet_seif.wire import encode_message, encode_snapshot
from tests.strategies import STEP_INFORMATION, STRONG

FLEET = "test"
OPENED, CONTINUED, ENDED, CORRECTED = FrameStatus
MAIN = Epoch(1, 11)
GOES_ON = Epoch(2, 12)
FORK = Epoch(2, 13)
WRONG = Epoch(3, 14)
FRESH = Epoch(4, 15)
FORGETFUL = Epoch(5, 16)
HELLO = Hello(
    software="t", life=0, placed=True, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)),
    start_information=STEP_INFORMATION, step_information_max=STEP_INFORMATION,
)  # fmt: skip


def diagonal(*values: tuple[int, int]) -> FrameDelta:
    """A delta with (variable, quanta) on the diagonal, and a little of everything in b."""
    variables = np.array([variable for variable, _ in values], np.int64)
    H = [[v, 0, 0, v, 0, v] if variable == 0 else [v, 0, v] for variable, v in values]
    rows = int(row_offsets(variables)[-1])
    return FrameDelta(
        variables=variables, rows=np.arange(len(values)), cols=np.arange(len(values)),
        H=np.concatenate(H).astype(np.int64), b=np.arange(1, rows + 1, dtype=np.int64),
    )  # fmt: skip


def part(frame: int, status: FrameStatus, *values: tuple[int, int]) -> FramePart:
    ends = status in (ENDED, CORRECTED)
    return FramePart(
        frame=frame, status=status, delta=diagonal(*values), end_pose=np.full(3, frame + 0.5) if ends else None
    )


def said(
    vehicle: str, epoch: Epoch, parts: Sequence[Sequence[FramePart]], hello: Hello,
    landmarks: dict[int, tuple[tuple[int, int], ...]] | None = None, *, end: bool = False,
) -> list[DeltaMessage]:  # fmt: skip
    return [
        DeltaMessage(
            fleet=FLEET, vehicle=vehicle, epoch=epoch, first=k, last=k, step=k, time_s=float(k), parts=tuple(mine),
            landmarks=(landmarks or {}).get(k, ()), hello=None if k else hello, end=end and k == len(parts) - 1,
        )
        for k, mine in enumerate(parts)
    ]  # fmt: skip


def prefix_of(messages: Iterable[DeltaMessage]) -> bytes:
    prefix = EMPTY_PREFIX
    for message in messages:
        prefix = extend_prefix(prefix, body_digest(encode_message(message)))
    return prefix


S = STRONG
HONEST: dict[tuple[str, Epoch], list[DeltaMessage]] = {}
"""What each vehicle says in each epoch if it is honest; FORK and WRONG are not."""

HONEST["ann", MAIN] = said(
    "ann", MAIN,
    [
        [part(0, OPENED, (0, S), (1, S))],
        [part(0, CONTINUED, (0, 5), (2, S))],
        [part(0, ENDED, (1, 3)), part(1, OPENED, (0, S), (1, S))],
        [part(1, CONTINUED, (0, 7))],
        [part(0, CORRECTED, (0, 2)), part(1, CONTINUED, (1, 2))],
        [part(1, ENDED, (0, 1)), part(2, OPENED, (0, S))],
        [part(2, CONTINUED, (0, 1), (3, S))],
        [part(2, CONTINUED, (3, 9))],
    ],
    HELLO, {0: ((0, 5),), 1: ((1, 6),), 6: ((2, -1),)},
)  # fmt: skip


def continuing(epoch: Epoch, last: int, digest: bytes | None = None) -> Hello:
    main = HONEST["ann", MAIN]
    prefix = prefix_of(main[: last + 1]) if digest is None else digest
    return dataclasses.replace(HELLO, continues=Continues(epoch=MAIN, last=last, prefix_digest=prefix))


HONEST["ann", GOES_ON] = said(
    "ann", GOES_ON, [[], [part(2, CONTINUED, (0, 4))], [part(2, ENDED, (3, 1))]], continuing(GOES_ON, 7), end=True
)
HONEST["ann", FORK] = said("ann", FORK, [[], [part(1, CONTINUED, (0, 6))]], continuing(FORK, 3))
HONEST["ann", WRONG] = said("ann", WRONG, [[part(2, CONTINUED, (0, 6))]], continuing(WRONG, 7, bytes(32)))
HONEST["ann", FRESH] = said(
    "ann", FRESH, [[part(0, OPENED, (0, S), (1, S))], [part(0, ENDED, (0, 1))]],
    dataclasses.replace(HELLO, life=1), {0: ((0, 6),)},
)  # fmt: skip
HONEST["ann", FORGETFUL] = said("ann", FORGETFUL, [[part(0, OPENED, (0, S))], [part(0, ENDED, (0, 8))]], HELLO)
HONEST["bob", MAIN] = said(
    "bob", MAIN,
    [
        [part(0, OPENED, (0, S), (1, S), (2, S))],
        [part(0, CONTINUED, (0, 3))],
        [part(0, ENDED, (1, 3)), part(1, OPENED, (0, S), (2, S))],
        [part(1, ENDED, (0, 5))],
    ],
    HELLO, {0: ((0, 5), (1, -1))}, end=True,
)  # fmt: skip


def instead(epoch: Epoch, k: int, vehicle: str = "ann", **changes: object) -> DeltaMessage:
    return dataclasses.replace(HONEST[vehicle, epoch][k], **changes)  # type: ignore[arg-type]


def coalesced(first: int, last: int) -> DeltaMessage:
    coalescer = Coalescer(HONEST["ann", MAIN][first])
    for message in HONEST["ann", MAIN][first + 1 : last + 1]:
        coalescer.add(message)
    return coalescer.message()


@dataclass(frozen=True)
class Lie:
    """Messages that do not go with the honest ones."""

    what: str
    messages: tuple[DeltaMessage, ...]


@cache
def lies() -> tuple[Lie, ...]:
    """Equivocation, forks, and rules that are broken: at once, at the next check point, and at the first message."""
    minus = part(1, CONTINUED, (0, -2 * S))
    return (
        *(Lie(f"another {k}", (instead(MAIN, k, innovation=1.0),)) for k in (0, 1, 3, 5, 7)),
        Lie("another hello that goes on", (instead(GOES_ON, 0, innovation=1.0),)),
        Lie("a range over what was sent one by one", (coalesced(1, 3),)),
        Lie("ranges that overlap", (coalesced(3, 5), coalesced(5, 7))),
        Lie("a fork", tuple(HONEST["ann", FORK])),
        Lie("another history", tuple(HONEST["ann", WRONG])),
        Lie("more after what was continued", tuple(instead(MAIN, 7, first=k, last=k) for k in (8, 9))),
        Lie("a landmark is skipped", (instead(MAIN, 1, landmarks=((7, 6),)),)),
        Lie("not definite at 4", (instead(MAIN, 3, parts=(minus,)),)),
        Lie("not definite at 0", (instead(MAIN, 0, parts=(part(0, OPENED, (0, -S), (1, S)),)),)),
        Lie("too much at 6", (instead(MAIN, 6, parts=(part(2, CONTINUED, (0, 3 * S)),)),)),
        Lie("a frame out of turn", (instead(MAIN, 5, parts=(part(3, OPENED, (0, S)),)),)),
        Lie("bob skips a frame", (instead(MAIN, 2, "bob", parts=(part(2, OPENED, (0, S)),)),)),
        Lie("the continuing epoch breaks a rule", (instead(GOES_ON, 1, parts=(part(0, CONTINUED, (0, 1)),)),)),
    )


@cache
def snapshot(last: int) -> bytes:
    """What ann would answer once everything up to a check point has been acknowledged."""
    whole = coalesced(0, last)
    return encode_snapshot(Snapshot(message=whole, prefix_digest=prefix_of(HONEST["ann", MAIN][: last + 1])))


CHECK_POINTS = (0, 2, 4, 5)
"""Of the main epoch of ann."""
