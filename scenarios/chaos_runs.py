"""Many seeds of chaos, on several cores: what `fleet-seif chaos` does."""

import json
import logging
import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from pydantic import ValidationError

from scenarios.chaos import ChaosError, Schedule, draw_schedule, reference, run_schedule, shrink
from scenarios.config import Scenario, ScenarioError
from scenarios.recording import Recording
from scenarios.source import record

BATCH = 50
Say = Callable[[str], None]


@dataclass
class Tally:
    """What came of many seeds. failures: seed, what did not hold, and the smallest schedule that shows it."""

    seeds: int = 0
    kills: int = 0
    events: int = 0
    boundaries: int = 0
    virtual_s: float = 0.0
    failures: list[tuple[int, str, str]] = field(default_factory=list)

    def add(self, other: "Tally") -> None:
        self.seeds += other.seeds
        self.kills += other.kills
        self.events += other.events
        self.boundaries += other.boundaries
        self.virtual_s += other.virtual_s
        self.failures += other.failures


class Arena:
    """A scenario's world, and what its vehicles contribute where nothing goes wrong."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.recording: Recording = record(scenario)
        self.expected = reference(scenario, self.recording)

    def schedule(self, seed: int) -> Schedule:
        return draw_schedule(seed, self.scenario, self.recording)

    def run(self, schedule: Schedule) -> Tally:
        """One schedule; a failure comes with the smallest one that fails alike."""
        tally = Tally(seeds=1)
        reason = self._try(schedule, tally)
        if reason is not None:
            least = shrink(schedule, lambda less: self._try(less, Tally()) is not None)
            tally.failures.append((schedule.seed, reason, least.model_dump_json(exclude_defaults=True)))
        return tally

    def run_every_boundary(self, schedule: Schedule) -> Tally:
        """One schedule, with a process killed before each of its effects in turn."""
        tally = self.run(schedule)
        for number in range(1, tally.boundaries + 1):
            if tally.failures:
                break
            tally.add(self.run(schedule.model_copy(update={"kills": (number,)})))
        return tally

    def _try(self, schedule: Schedule, tally: Tally) -> str | None:
        try:
            done = run_schedule(schedule, self.scenario, self.recording, self.expected)
        except ChaosError as error:
            return str(error)
        except Exception as error:  # a bug of ours is a failure like any other: it is shrunk and told
            return f"{type(error).__name__}: {error}"
        tally.kills += done.kills
        tally.events += done.events
        tally.boundaries += done.boundaries
        tally.virtual_s += done.virtual_s
        return None


_arena: Arena | None = None


def _prepare(scenario: str) -> None:
    global _arena  # noqa: PLW0603 - one for each worker process
    logging.getLogger().setLevel(logging.CRITICAL)  # refused messages are what is wanted here
    _arena = Arena(Scenario.model_validate_json(scenario))


def _batch(work: tuple[Sequence[int], bool]) -> Tally:
    seeds, every_boundary = work
    assert _arena is not None
    tally = Tally()
    for seed in seeds:
        schedule = _arena.schedule(seed)
        if every_boundary:
            calm = schedule.model_copy(update={"kills": ()})
            tally.add(_arena.run_every_boundary(calm))
        else:
            tally.add(_arena.run(schedule))
    return tally


def run_seeds(scenario: Scenario, seeds: range, jobs: int, say: Say, *, every_boundary: bool = False) -> Tally:
    """Run every seed, on `jobs` processes; stops at the end of the batch with the first failure."""
    begin, told_s, tally = time.monotonic(), time.monotonic(), Tally()
    for done in _spread(scenario, seeds, jobs, every_boundary):
        tally.add(done)
        if tally.failures:
            break
        if time.monotonic() > told_s + 5.0:
            told_s = time.monotonic()
            say(f"{tally.seeds} runs, {tally.kills} kills, {tally.seeds / (told_s - begin):.0f} a second")
    return tally


def _spread(scenario: Scenario, seeds: range, jobs: int, every_boundary: bool) -> Iterator[Tally]:
    text = scenario.model_dump_json()
    size = max(1, min(BATCH, len(seeds) // (4 * jobs)))
    work: Iterable[tuple[Sequence[int], bool]] = (
        (seeds[i : i + size], every_boundary) for i in range(0, len(seeds), size)
    )
    if jobs == 1:
        _prepare(text)
        yield from map(_batch, work)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, _prepare, (text,)) as pool:
        yield from pool.imap_unordered(_batch, work)


def read_schedule(text: str) -> Schedule:
    """A schedule from the JSON that a failure printed. Raises ScenarioError."""
    try:
        return Schedule.model_validate(json.loads(text))
    except (json.JSONDecodeError, ValidationError) as error:
        raise ScenarioError(f"--schedule: not one that chaos has printed: {error}") from None


def seed_range(text: str) -> range:
    """A..B, both included. Raises ScenarioError."""
    low, dots, high = text.partition("..")
    if not (low.isdigit() and (high.isdigit() or not dots)):
        raise ScenarioError(f"--seeds {text!r}: expected A..B, for instance 1..1000")
    return range(int(low), int(high or low) + 1)
