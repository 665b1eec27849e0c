"""What association adds to a step, by the size of the map: python -m tests.association_cost [--landmarks N ...].

One pass over a strip of landmarks, six sightings a step (scenarios.experiments.strip), with and without identities; the
map holds all of them in the end. Medians of the last LAST steps: of all, and of those that close a frame, when the
vehicle solves its own map and looks around; and the longest step of the run. 100,000 take a quarter of an hour.
"""

import argparse
import dataclasses
import statistics
import time

import numpy as np

from fleet_seif.config import FilterSettings
from fleet_seif.frames import FramedFilter
from fleet_seif.jit import one_thread
from fleet_seif.records import UNKNOWN_SIGNATURE, Reading, Sightings
from scenarios.experiments.strip import Strip

LAST = 500


def hidden(seen: Sightings) -> Sightings:
    return dataclasses.replace(seen, signature=np.full(len(seen.z), UNKNOWN_SIGNATURE))


@one_thread
def spent_us(landmarks: int, settings: FilterSettings) -> tuple[float, float, float, FramedFilter]:
    """Median step, median and longest closing step, and the filter at the end."""
    strip, told = Strip(landmarks), settings.identities == "signatures"
    framed = FramedFilter(settings)
    framed.start(strip.start() if told else hidden(strip.start()))
    steps: list[tuple[float, bool]] = []
    for reading in strip.readings():
        given: Reading = reading if told else dataclasses.replace(reading, sightings=hidden(reading.sightings))
        frame, begin = framed.frame, time.perf_counter()
        framed.step(given)
        steps.append((1e6 * (time.perf_counter() - begin), framed.frame > frame))
    step, closing = statistics.median(us for us, _ in steps[-LAST:]), [us for us, closes in steps[-LAST:] if closes]
    return step, statistics.median(closing), max(us for us, closes in steps if closes), framed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--landmarks", nargs="+", type=int, default=[1000, 10_000], metavar="N")
    spent_us(200, FilterSettings(identities="associated"))  # compiles
    for landmarks in parser.parse_args().landmarks:
        known, *_ = spent_us(landmarks, FilterSettings())
        step, closing, longest, framed = spent_us(landmarks, FilterSettings(identities="associated"))
        closing, longest = closing / 1e3, longest / 1e3
        report = (
            f"{landmarks:6d} landmarks ({len(framed.signatures)} begun): step {step:5.0f} us, with identities"
            f" {known:5.0f} us, so {step - known:5.0f} us more; closing {closing:4.0f} ms, at most {longest:.0f}"
        )
        print(report, flush=True)


if __name__ == "__main__":
    main()
