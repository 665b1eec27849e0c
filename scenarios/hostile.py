"""A vehicle that lies: its messages, tampered with and sealed again as if they were its own."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fleet_seif.bus import Bus, OnQuery, Priority
from fleet_seif.errors import WireError
from fleet_seif.information import H_QUANTUM, FrameDelta
from fleet_seif.messages import DeltaMessage, FramePart
from fleet_seif.signing import Signer
from fleet_seif.wire import decode_message, encode_message
from scenarios.faults import Hostile


class Liar:
    """Turns each message of a vehicle into what it sends instead."""

    def __init__(self, hostile: Sequence[Hostile], who: str, signer: Signer | None = None) -> None:
        self._lies = [each for each in hostile if each.who == who]
        self._signer = signer

    @property
    def honest(self) -> bool:
        return not self._lies

    def __call__(self, data: bytes) -> list[bytes]:
        """What is sent instead of a message; the message itself where the vehicle does not lie (yet)."""
        try:
            message = decode_message(data)
        except WireError:  # not a delta
            return [data]
        sent = [data]
        for hostile in self._lies:
            if message.step >= hostile.from_step:
                sent = self._tampered(hostile.lie, message, data)
        return sent

    def _tampered(self, lie: str, message: DeltaMessage, data: bytes) -> list[bytes]:
        match lie:
            case "garbage":
                return [data[: len(data) // 2] + bytes(7) + data[len(data) // 2 + 7 :]]
            case "equivocate":
                return [data, self._sealed(message, step=message.step + 1)]
            case "indefinite":
                return [self._sealed(message, parts=tuple(_scaled(part, -1000) for part in message.parts))]
            case "absurd":
                return [self._sealed(message, parts=tuple(_absurd(part) for part in message.parts))]
            case _:
                return [self._sealed(message, parts=tuple(_foreign(part) for part in message.parts))]

    def _sealed(self, message: DeltaMessage, **changes: object) -> bytes:
        return encode_message(dataclasses.replace(message, **changes), self._signer)  # type: ignore[arg-type]


def _scaled(part: FramePart, factor: int) -> FramePart:
    return dataclasses.replace(
        part, delta=dataclasses.replace(part.delta, H=np.clip(part.delta.H, -(2**40), 2**40) * factor)
    )


def _absurd(part: FramePart) -> FramePart:
    """Two thousand million per m^2 about the pose, twice as much as anybody may declare."""
    much = int(2.1e9 / H_QUANTUM)
    delta = FrameDelta(
        variables=np.array([0]), rows=np.array([0]), cols=np.array([0]),
        H=np.array([much, 0, 0, much, 0, much]), b=np.zeros(3, np.int64),
    )  # fmt: skip
    return dataclasses.replace(part, delta=delta)


def _foreign(part: FramePart) -> FramePart:
    """Information about a landmark that nobody has named."""
    delta = FrameDelta(
        variables=np.array([100_000]), rows=np.array([0]), cols=np.array([0]),
        H=np.array([2**28, 0, 2**28]), b=np.zeros(2, np.int64),
    )  # fmt: skip
    return dataclasses.replace(part, delta=delta)


def lying(bus: Bus, liar: Liar) -> Bus:
    """The bus itself, or one on which a vehicle puts what its Liar makes of its messages, and answers queries alike."""
    return bus if liar.honest else _LyingBus(bus, liar)


class _LyingBus:
    def __init__(self, bus: Bus, liar: Liar) -> None:
        self._bus = bus
        self._liar = liar
        self.subscribe, self.ask, self.announce = bus.subscribe, bus.ask, bus.announce
        self.watch, self.close = bus.watch, bus.close

    def put(self, key: str, payload: bytes, priority: Priority = "data") -> None:
        for data in self._liar(payload):
            self._bus.put(key, data, priority)

    def answer(self, key: str, handler: OnQuery) -> None:
        def lie(asked: str, payload: bytes) -> list[bytes]:
            return [data for reply in handler(asked, payload) for data in self._liar(reply)]

        self._bus.answer(key, lie)
