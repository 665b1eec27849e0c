"""What one life of a vehicle has contributed: the sum of its messages, and the part of it that has been checked.

1. A life is a fresh epoch and all epochs that continue it; its messages come here in order, each once.
2. A message is folded wholly or not at all. One that breaks the rules ends the life with a reason, for good.
3. At every check point the frames that changed must be positive definite. What was so is `checked`; canonical maps rest
   on that alone, so a life that has ended with a reason stays at its last check.
4. The verdict is a function of the messages, whoever folds them and whenever.
5. An alias counts until it is taken back. Innovations are summed by epoch, in order: a snapshot of an epoch's prefix
   brings the same bits as its messages.
"""

import math
from dataclasses import dataclass, field
from typing import Final

from fleet_seif.definite import is_positive_definite
from fleet_seif.errors import NumericalError
from fleet_seif.information import H_QUANTUM, FrameDelta, FrameTotal, largest_growth, quanta
from fleet_seif.messages import DeltaMessage, FramePart, FrameStatus, Hello
from fleet_seif.records import Floats
from fleet_seif.streams import is_check_point

INNOVATION_MAX: Final = 1.5
"""Mean squared normalised innovation, per degree of freedom, up to which a vehicle counts as consistent."""
INNOVATION_SIGMAS: Final = 5.0
"""What is added for chance: so many standard deviations of a chi-square."""


@dataclass
class Frame:
    """One frame: the sum of its deltas, and the mean of its end pose once it has ended."""

    total: FrameTotal = field(default_factory=FrameTotal)
    end_pose: Floats | None = None


@dataclass(frozen=True)
class Checked:
    """What a life had contributed at its last check point. frames: by number; names: how many landmarks; aliases: pairs
    of them that are one, ascending; innovation, dof: sum of squared normalised innovations, its degrees of freedom."""

    frames: dict[int, FrameDelta] = field(default_factory=dict)
    names: int = 0
    healthy: bool = True
    aliases: tuple[tuple[int, int], ...] = ()
    innovation: float = 0.0
    dof: int = 0

    @property
    def consistent(self) -> bool:
        """Whether innovations are, on the whole, about as large as the vehicle says that they should be."""
        allowed = INNOVATION_MAX * self.dof + INNOVATION_SIGMAS * math.sqrt(2.0 * self.dof)
        return self.innovation <= allowed


class LifeTotal:
    """See the rules above."""

    def __init__(self) -> None:
        self.hello: Hello | None = None
        self.frames: dict[int, Frame] = {}
        self.signatures: list[int] = []
        self.healthy = True
        self.checked = Checked()
        self._aliases: set[tuple[int, int]] = set()
        self._innovation: list[float] = []
        self._dof = 0
        self._changed: set[int] = set()
        self._ended: set[int] = set()

    @property
    def number(self) -> int:
        return 0 if self.hello is None else self.hello.life

    @property
    def newest(self) -> Checked:
        """All that has been folded, as if it had been checked."""
        frames = {number: frame.total.delta() for number, frame in self.frames.items()}
        return self._as_checked(frames)

    def _as_checked(self, frames: dict[int, FrameDelta]) -> Checked:
        aliases = tuple(sorted(self._aliases))
        return Checked(frames, len(self.signatures), self.healthy, aliases, sum(self._innovation), self._dof)

    def fold(self, message: DeltaMessage, *, check: bool = False) -> str | None:
        """Add the next message, and check the sum at a check point or where told to.

        Returns a reason where it may not be added, with nothing changed, or where the sum fails the check after it.
        """
        reason = self._broken_rule(message) or self._add(message)
        if reason is not None:
            return f"message {message.first}: {reason}"
        if message.hello is not None and self.hello is None:
            self.hello = message.hello
        self.signatures.extend(signature for _, signature in message.landmarks)
        self.healthy = message.healthy
        for a, b, added in message.aliases:
            (self._aliases.add if added else self._aliases.discard)((min(a, b), max(a, b)))
        if message.hello is not None:
            self._innovation.append(0.0)
        self._innovation[-1] += message.innovation
        self._dof += message.innovation_dof
        if check or is_check_point(message):
            reason = self._check()
        return None if reason is None else f"message {message.last}: {reason}"

    def _broken_rule(self, message: DeltaMessage) -> str | None:
        """Why a message cannot follow those before it."""
        hello = message.hello or self.hello
        if self.hello is not None and message.hello is not None and message.hello.life != self.number:
            return f"continues life {self.number} as life {message.hello.life}"
        known = len(self.signatures)
        if any(number != known + i for i, (number, _) in enumerate(message.landmarks)):
            return f"new landmarks must be numbered on from {known}"
        known += len(message.landmarks)
        if any(a >= known or b >= known or a == b for a, b, _ in message.aliases):
            return "an alias of a landmark that it has not named"
        assert hello is not None
        count, ended = len(self.frames), self._ended
        for part in message.parts:
            if not _in_place(part, count, ended):
                return f"frame {part.frame} cannot be {part.status.name.lower()} now: {count} frames are known"
            if len(part.delta.variables) and part.delta.variables[-1] > known:
                return "information about a landmark that it has not named"
            if part.status is FrameStatus.OPENED:
                count += 1
            if part.end_pose is not None:
                ended = ended | {part.frame}
            reason = _absurd(part, message.last - message.first + 1, hello)
            if reason is not None:
                return reason
        return None

    def _add(self, message: DeltaMessage) -> str | None:
        done: list[FramePart] = []
        before = len(self.frames)
        try:
            for part in message.parts:
                if part.frame not in self.frames:
                    self.frames[part.frame] = Frame()
                self.frames[part.frame].total.add(part.delta)
                done.append(part)
        except NumericalError as error:
            for part in done:
                self.frames[part.frame].total.subtract(part.delta)
            for frame in range(before, len(self.frames)):
                del self.frames[frame]
            return str(error)
        for part in message.parts:
            self._changed.add(part.frame)
            if part.end_pose is not None:
                self.frames[part.frame].end_pose = part.end_pose
                self._ended.add(part.frame)
        return None

    def _check(self) -> str | None:
        frames = dict(self.checked.frames)
        for number in sorted(self._changed):
            total = self.frames[number].total.delta()
            if frames.get(number) is total:
                continue
            frames[number] = total
            try:
                definite = is_positive_definite(frames[number])
            except NumericalError as error:
                return f"frame {number}: {error}"
            if not definite:
                return f"the information in frame {number} is not positive definite"
        self._changed.clear()
        self.checked = self._as_checked(frames)
        return None


def _in_place(part: FramePart, count: int, ended: set[int]) -> bool:
    """Whether a part is about a frame that it may be about; `count` frames are known, some of them ended."""
    if part.status is FrameStatus.OPENED:
        return part.frame == count == len(ended)
    if part.status is FrameStatus.CORRECTED:
        return part.frame in ended
    return part.frame == count - 1 and part.frame not in ended


def _absurd(part: FramePart, steps: int, hello: Hello) -> str | None:
    """Why a part claims more than its vehicle has said that it ever would; a correction may redo a whole frame."""
    if part.status is FrameStatus.CORRECTED:
        return None
    most = steps * quanta(hello.step_information_max)
    if part.status is FrameStatus.OPENED:
        most += quanta(hello.start_information)
    if largest_growth(part.delta) <= most:
        return None
    return f"more information than the {most * H_QUANTUM:g} per m^2 or rad^2 that its hello allows for {steps} steps"
