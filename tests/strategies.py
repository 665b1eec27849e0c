"""What hypothesis draws: numbers, matrices, deltas, messages and whole streams. Real values, so that cases shrink."""

import dataclasses
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import SearchStrategy

from fleet_seif.information import H_QUANTUM, QUANTA_MAX, VARIABLE_MAX, FrameDelta, block_size, row_offsets
from fleet_seif.merge_records import Differing, KeptApart, MergeReport, Reason
from fleet_seif.messages import (
    Ack,
    Action,
    Continues,
    DeltaMessage,
    Epoch,
    Evidence,
    FramePart,
    FrameStatus,
    Heartbeat,
    Hello,
    JointMap,
    LandmarkName,
    NodeStatus,
    OperatorEvent,
    RangeRequest,
    Snapshot,
    StreamPosition,
    VehicleState,
)
from fleet_seif.records import Floats, Ints
from fleet_seif.wire import POSE_MAX

settled = settings(
    deadline=None,
    derandomize=True,
    max_examples=60,
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
    suppress_health_check=[HealthCheck.too_slow],
)
"""No deadline (kernels compile on first use), the same cases every run."""

SEQUENCES = st.integers(0, 2**53)
SMALL = st.integers(0, 10_000)
DIGESTS = st.binary(min_size=32, max_size=32)
NAMES = st.text("abzABZ019_-", min_size=1, max_size=32)
EPOCHS = st.builds(Epoch, SEQUENCES, st.integers(0, 2**64 - 1))
FLOATS = st.floats(allow_nan=False, allow_infinity=False)


def finite(bound: float) -> SearchStrategy[float]:
    return st.floats(-bound, bound, allow_subnormal=False)


def vectors(n: int, bound: float = 10.0) -> SearchStrategy[Floats]:
    return arrays(np.float64, (n,), elements=finite(bound))


def points() -> SearchStrategy[Floats]:
    return vectors(2)


def poses() -> SearchStrategy[Floats]:
    """Poses with headings over more than a turn."""
    return st.tuples(finite(10.0), finite(10.0), finite(7.0)).map(np.array)


def spd(n: int, least: float = 0.1) -> SearchStrategy[Floats]:
    """Symmetric positive definite matrices, shape (n, n), eigenvalues of at least `least`."""
    roots = arrays(np.float64, (n, n), elements=finite(1.0))
    return roots.map(lambda A: A @ A.T + least * np.eye(n))


def table(*shape: int) -> SearchStrategy[Floats]:
    return arrays(np.float64, shape, elements=FLOATS)


@st.composite
def deltas(draw: st.DrawFn, variable_max: int = VARIABLE_MAX, bound: int = QUANTA_MAX - 1) -> FrameDelta:
    """A delta of a few blocks of any of the variables."""
    names = draw(st.lists(st.integers(0, variable_max), unique=True, max_size=4))
    variables = np.array(sorted(names), np.int64)
    pairs = [(i, j) for i in range(len(names)) for j in range(i, len(names))]
    chosen = sorted(draw(st.lists(st.sampled_from(pairs), unique=True))) if pairs else []
    size = sum(block_size(int(variables[i]), int(variables[j])) for i, j in chosen)
    value = st.one_of(st.integers(-9, 9), st.integers(-bound, bound))

    def values(count: int) -> Ints:
        return np.array(draw(st.lists(value, min_size=count, max_size=count)), np.int64)

    return FrameDelta(
        variables=variables,
        rows=np.array([i for i, _ in chosen], np.int64),
        cols=np.array([j for _, j in chosen], np.int64),
        H=values(size),
        b=values(int(row_offsets(variables)[-1])),
    )


@st.composite
def parts(draw: st.DrawFn) -> FramePart:
    status = draw(st.sampled_from(FrameStatus))
    ends = status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    return FramePart(
        frame=draw(st.integers(0, VARIABLE_MAX)),
        status=status,
        delta=draw(deltas()),
        end_pose=draw(table(3)) if ends else None,
    )


def covariances() -> SearchStrategy[Floats]:
    return st.one_of(st.just(np.zeros((3, 3))), spd(3).map(lambda A: np.asarray((A + A.T) / 2)))


def hellos() -> SearchStrategy[Hello]:
    continues = st.builds(Continues, epoch=EPOCHS, last=SEQUENCES, prefix_digest=DIGESTS)
    return st.builds(
        Hello,
        software=st.text(max_size=50),
        life=st.integers(0, VARIABLE_MAX),
        placed=st.booleans(),
        start_pose=vectors(3, POSE_MAX),
        start_pose_cov=covariances(),
        start_information=st.floats(1e-3, 1e9),
        step_information_max=st.floats(1e-3, 1e9),
        continues=st.one_of(st.none(), continues),
    )


@st.composite
def messages(draw: st.DrawFn, first: SearchStrategy[int] = st.one_of(st.just(0), SEQUENCES)) -> DeltaMessage:  # noqa: B008
    number = draw(first)
    landmark, signature = st.integers(0, VARIABLE_MAX - 1), st.integers(-1, 2**63 - 1)
    return DeltaMessage(
        fleet=draw(NAMES),
        vehicle=draw(NAMES),
        epoch=draw(EPOCHS),
        first=number,
        last=draw(st.integers(number, 2**53)),
        step=draw(SEQUENCES),
        time_s=draw(FLOATS),
        parts=tuple(draw(st.lists(parts(), max_size=2))),
        landmarks=tuple(draw(st.lists(st.tuples(landmark, signature), max_size=3))),
        aliases=tuple(draw(st.lists(st.tuples(landmark, landmark, st.booleans()), max_size=2))),
        healthy=draw(st.booleans()),
        innovation=draw(FLOATS),
        innovation_dof=draw(SEQUENCES),
        refused=draw(SEQUENCES),
        hello=draw(hellos()) if number == 0 else None,
        end=draw(st.booleans()),
    )


def snapshots() -> SearchStrategy[Snapshot]:
    return st.builds(Snapshot, message=messages(st.just(0)), prefix_digest=DIGESTS, maker=st.one_of(st.just(""), NAMES))


@st.composite
def heartbeats(draw: st.DrawFn) -> Heartbeat:
    last = draw(SEQUENCES)
    return Heartbeat(
        fleet=draw(NAMES),
        vehicle=draw(NAMES),
        epoch=draw(EPOCHS),
        last=last,
        prefix_digest=draw(DIGESTS),
        checked=draw(st.integers(-1, last)),
        checked_digest=draw(DIGESTS),
        ended=draw(st.booleans()),
    )


def acks() -> SearchStrategy[Ack]:
    return st.builds(
        Ack, fleet=NAMES, node=NAMES, vehicle=NAMES, epoch=EPOCHS, last=SEQUENCES, prefix_digest=DIGESTS,
        fault=st.text(max_size=200),
    )  # fmt: skip


@st.composite
def ranges(draw: st.DrawFn) -> RangeRequest:
    first = draw(SEQUENCES)
    last, count = draw(st.integers(first, 2**53)), draw(st.integers(1, 4096))
    return RangeRequest(fleet=draw(NAMES), vehicle=draw(NAMES), epoch=draw(EPOCHS), first=first, last=last, count=count)


def landmark_names() -> SearchStrategy[LandmarkName]:
    return st.builds(LandmarkName, NAMES, st.integers(0, VARIABLE_MAX), st.integers(0, VARIABLE_MAX))


@st.composite
def events(draw: st.DrawFn) -> OperatorEvent:
    action = draw(st.sampled_from(Action))
    about_landmarks = action in (Action.FORCE, Action.FORBID, Action.RELEASE)
    pair = sorted(draw(st.lists(landmark_names(), min_size=2, max_size=2, unique=True))) if about_landmarks else None
    return OperatorEvent(
        fleet=draw(NAMES),
        number=draw(st.integers(1, 2**53)),
        operator=draw(NAMES),
        action=action,
        landmarks=None if pair is None else (pair[0], pair[1]),
        vehicle="" if about_landmarks else draw(NAMES),
    )


def evidences() -> SearchStrategy[Evidence]:
    return st.builds(Evidence, first=st.binary(max_size=80), second=st.binary(max_size=80))


def statuses() -> SearchStrategy[NodeStatus]:
    last = st.integers(-1, 2**53)
    position = st.builds(StreamPosition, NAMES, EPOCHS, last, DIGESTS, st.one_of(st.just(b""), DIGESTS))
    return st.builds(
        NodeStatus,
        fleet=NAMES,
        node=NAMES,
        streams=st.lists(position, max_size=3).map(tuple),
        events=DIGESTS,
    )


def merge_reports() -> SearchStrategy[MergeReport]:
    reason = st.sampled_from([each for each in Reason if each is not Reason.MERGED])
    names = st.lists(landmark_names(), max_size=3).map(tuple)
    d2 = st.one_of(st.none(), st.floats(0.0, 1e300))
    return st.builds(
        MergeReport,
        fleet=NAMES,
        node=NAMES,
        version=st.integers(0, 2**53),
        canonical=st.booleans(),
        map_digest=DIGESTS,
        ledger_digest=DIGESTS,
        kept_apart=st.lists(st.tuples(reason, st.integers(1, 2**53)), max_size=6).map(tuple),
        nearest=st.lists(st.builds(KeptApart, landmark_names(), landmark_names(), reason, d2), max_size=3).map(tuple),
        differing=st.lists(st.builds(Differing, NAMES, names, st.lists(names, max_size=2).map(tuple)), max_size=2).map(
            tuple
        ),
    )


def states() -> SearchStrategy[VehicleState]:
    count = st.integers(-1, 2**53)
    return st.builds(
        VehicleState,
        name=NAMES,
        life=st.integers(0, VARIABLE_MAX),
        epoch=EPOCHS,
        cut=count,
        checked=count,
        behind=count,
        parked=count,
        duplicates=count,
        gaps_repaired=count,
        refused=count,
        stalled=st.booleans(),
        ended=st.booleans(),
        placed=st.booleans(),
        healthy=st.booleans(),
        fault=st.text(max_size=200),
    )


@st.composite
def maps(draw: st.DrawFn) -> JointMap:
    n, v = draw(st.integers(0, 3)), draw(st.integers(0, 2))
    groups = st.lists(landmark_names(), max_size=2).map(tuple)
    signature = st.integers(-1, 2**63 - 1)
    return JointMap(
        fleet=draw(NAMES),
        node=draw(NAMES),
        version=draw(SEQUENCES),
        canonical=draw(st.booleans()),
        final=draw(st.booleans()),
        map_digest=draw(DIGESTS),
        ledger_digest=draw(DIGESTS),
        landmark_mean=draw(table(n, 2)),
        landmark_cov=draw(table(draw(st.sampled_from([0, n])), 2, 2)),
        cov_version=draw(st.integers(-1, 2**53)),
        names=tuple(draw(st.lists(groups, min_size=n, max_size=n))),
        signature=tuple(draw(st.lists(signature, min_size=n, max_size=n))),
        poses=tuple(draw(st.lists(NAMES, min_size=v, max_size=v))),
        pose_mean=draw(table(v, 3)),
        pose_cov=draw(table(draw(st.sampled_from([0, v])), 3, 3)),
        vehicles=tuple(draw(st.lists(states(), max_size=2))),
        counters=dict(sorted(draw(st.dictionaries(st.text(max_size=20), SEQUENCES, max_size=3)).items())),
    )


STRONG = 2**40
"""Quanta on the diagonal of what a stream sees for the first time: everything else together is less."""
WEAK = 2**20
STEP_INFORMATION = 5000.0
"""More than a message of `streams` adds to a diagonal, per m^2 or rad^2: (STRONG + WEAK) 2^-28 = 4096.004."""


@st.composite
def definite_deltas(draw: st.DrawFn, known: int, seen: set[int]) -> FrameDelta:
    """A delta of a frame that stays positive definite. seen: the frame's variables so far; new ones are added to it."""
    chosen = sorted(draw(st.sets(st.integers(0, known), max_size=3)) | (set() if seen else {0}))
    pairs = [(i, j) for i in range(len(chosen)) for j in range(i, len(chosen))]
    kept = [(i, j) for i, j in pairs if i == j or draw(st.booleans())]
    weak = st.integers(-WEAK, WEAK)
    H: list[int] = []
    for i, j in kept:
        size = block_size(chosen[i], chosen[j])
        block = draw(st.lists(weak, min_size=size, max_size=size))
        if i == j and chosen[i] not in seen:
            for at in {3: (0, 2), 6: (0, 3, 5)}[size]:
                block[at] += STRONG
        H += block
    seen |= set(chosen)
    rows = int(row_offsets(np.array(chosen, np.int64))[-1])
    return FrameDelta(
        variables=np.array(chosen, np.int64),
        rows=np.array([i for i, _ in kept], np.int64),
        cols=np.array([j for _, j in kept], np.int64),
        H=np.array(H, np.int64),
        b=np.array(draw(st.lists(st.integers(-(2**45), 2**45), min_size=rows, max_size=rows)), np.int64),
    )


@st.composite
def streams(draw: st.DrawFn, fleet: str = "test", vehicle: str = "v") -> list[DeltaMessage]:
    """A stream of several frames as a vehicle may publish it: frames open, go on, end, and are corrected later.

    What has been said of a frame is positive definite at any moment, and within what the hello declares.
    """
    out: list[DeltaMessage] = []
    known, frame = 0, 0
    seen: list[set[int]] = [set()]
    hello = dataclasses.replace(
        draw(hellos()), continues=None, step_information_max=draw(st.floats(STEP_INFORMATION, 1e9))
    )
    count = draw(st.integers(1, 6))
    for k in range(count):
        new = draw(st.integers(0, 2))
        landmarks = tuple((known + i, draw(st.integers(-1, 5))) for i in range(new))
        known += new
        mine: list[FramePart] = []
        if k == 0:
            mine.append(FramePart(frame=0, status=FrameStatus.OPENED, delta=draw(definite_deltas(known, seen[0]))))
        elif draw(st.booleans()):
            delta = draw(definite_deltas(known, seen[frame]))
            mine.append(FramePart(frame=frame, status=FrameStatus.CONTINUED, delta=delta))
        else:
            end, delta = draw(table(3)), draw(definite_deltas(known, seen[frame]))
            mine.append(FramePart(frame=frame, status=FrameStatus.ENDED, delta=delta, end_pose=end))
            frame += 1
            seen.append(set())
            delta = draw(definite_deltas(known, seen[frame]))
            mine.append(FramePart(frame=frame, status=FrameStatus.OPENED, delta=delta))
        if frame > 0 and draw(st.booleans()):
            old, end = draw(st.integers(0, frame - 1)), draw(table(3))
            delta = draw(definite_deltas(known, seen[old]))
            mine.append(FramePart(frame=old, status=FrameStatus.CORRECTED, delta=delta, end_pose=end))
        out.append(
            DeltaMessage(
                fleet=fleet,
                vehicle=vehicle,
                epoch=Epoch(1, 5),
                first=k,
                last=k,
                step=k,
                time_s=float(k),
                parts=tuple(mine),
                landmarks=landmarks,
                innovation=float(draw(SMALL)),
                innovation_dof=draw(SMALL),
                refused=draw(SMALL),
                hello=hello if k == 0 else None,
                end=k == count - 1 and draw(st.booleans()),
            )
        )
    return out


def pose_block(value: int) -> FrameDelta:
    """A delta of the pose alone: `value` quanta on its diagonal."""
    return FrameDelta(
        variables=np.array([0]), rows=np.array([0]), cols=np.array([0]),
        H=np.array([value, 0, 0, value, 0, value]), b=np.zeros(3, np.int64),
    )  # fmt: skip


@st.composite
def broken_streams(draw: st.DrawFn) -> tuple[list[DeltaMessage], int]:
    """A stream of `streams`, and the number of the one message in it that breaks a rule."""
    stream = draw(streams())
    k = draw(st.integers(0, len(stream) - 1))
    message = stream[k]
    status = FrameStatus.OPENED if k == 0 else FrameStatus.CONTINUED
    frames = [part.frame for m in stream[: k + 1] for part in m.parts]
    names = sum(len(m.landmarks) for m in stream[: k + 1])

    def with_part(delta: FrameDelta) -> dict[str, Any]:
        return {"parts": (FramePart(frame=max(frames), status=status, delta=delta),)}

    unnamed = dataclasses.replace(
        pose_block(0), variables=np.array([names + 1]), H=np.ones(3, np.int64), b=np.ones(2, np.int64)
    )
    hello = stream[0].hello
    assert hello is not None
    most = hello.step_information_max + (hello.start_information if k == 0 else 0.0)
    changes: list[dict[str, Any]] = [
        {"landmarks": ((names + 1, 3),)},
        {"aliases": ((names, 0, True),)},
        with_part(unnamed),
        with_part(pose_block(int(most / H_QUANTUM * 1.001) + 1)),
        {**with_part(pose_block(-2 * STRONG)), "end": True},
        {"parts": (FramePart(frame=max(frames) + 1, status=status, delta=FrameDelta.nothing()),)},
    ]
    stream[k] = dataclasses.replace(message, **draw(st.sampled_from(changes)))
    return stream, k


def msgpack_values() -> SearchStrategy[Any]:
    """Anything that msgpack writes down."""
    leaves = st.one_of(
        st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(max_size=8),
        st.binary(max_size=40),
    )  # fmt: skip
    return st.recursive(
        leaves,
        lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=2)),
        max_leaves=12,
    )
