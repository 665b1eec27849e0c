"""What a vehicle puts on the wire, against the length of its frames and how many steps a message covers.

A message of several steps holds their sum, which is smaller than the parts: links change again and again, and are sent
once. What is paid is freshness: the map of others is older by the steps that wait. Beside it stand the raw readings,
packed with msgpack as the vehicle's own store keeps them.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgpack
import numpy as np

from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.messages import Epoch
from fleet_seif.records import Reading
from scenarios.config import load_scenario
from scenarios.experiments import drawing
from scenarios.experiments.study import Cell, Progress, Row, csv_of, png_of, write_csv
from scenarios.palette import INK
from scenarios.recording import Log
from scenarios.source import record
from vehicles.core import Identity, VehicleCore

NAME: Final = "bandwidth"
TITLE: Final = "Bytes a step, against the length of frames and the steps that a message covers"
WORLDS: Final = (("the paper's noise", "three_air_vehicles"), ("mild noise", "three_air_vehicles_mild"))
LENGTHS: Final = (0, 10, 25, 50)
"""Steps of a frame; 0: a single frame."""
EVERY: Final = (1, 2, 5, 10, 25)
COLOURS: Final = (INK, drawing.SKY, drawing.BLUE, drawing.GREEN)


def run(out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Raises NumericalError where a filter breaks down."""
    lengths, every = (LENGTHS[1:3], EVERY[:2]) if quick else (LENGTHS, EVERY)
    settings = ("world.steps=100",) if quick else ()
    logs = {
        title: list(record(load_scenario(name, settings, seed)).logs.values())[: 1 if quick else None]
        for title, name in WORLDS
    }
    cases = list(itertools.product(logs, lengths, every))
    lines: list[dict[str, Cell]] = []
    for done, (title, length, count) in enumerate(cases, start=1):
        put = np.mean([put_bytes(log, length, count) / log.steps for log in logs[title]])
        raw = np.mean([readings_bytes(log) / log.steps for log in logs[title]])
        lines.append(
            {
                "world": title, "frame_steps": length, "every_steps": count, "bytes_per_step": float(put),
                "readings_bytes_per_step": float(raw), "ratio_to_readings": float(put / raw),
                "waiting_steps_mean": (count - 1) / 2,
            }
        )  # fmt: skip
        progress(done, len(cases))
    write_csv(csv_of(out, NAME), lines)
    _draw(png_of(out, NAME), lines)
    return [_row(line) for line in lines]


def put_bytes(log: Log, frame_steps: int, every_steps: int) -> int:
    """Bytes of all messages of a vehicle's whole run, put without any link losing them."""
    adaptive = FilterSettings(frames="adaptive", frame_steps_max=frame_steps or 1)
    settings = adaptive if frame_steps else FilterSettings(frames="single")
    identity = Identity(
        fleet="f", vehicle=log.vehicle, epoch=Epoch(1, 1), start_pose=log.start_pose, start_pose_cov=log.start_pose_cov
    )
    core = VehicleCore(identity, settings, PublishSettings(window=100_000, every_steps=every_steps))
    core.start(float(log.time_s[0]), log.sightings_at(0))
    for reading in log.readings():
        core.step(reading)
        core.note_commit(core.take_changes()[1])
        core.release()
    core.end()
    core.note_commit(core.take_changes()[1])
    core.release()
    return core.counters.bytes_put


def readings_bytes(log: Log) -> int:
    """Bytes of all readings of a vehicle, packed one by one."""
    return sum(len(_packed(reading)) for reading in log.readings())


def _packed(reading: Reading) -> bytes:
    """Float64 arrays, only the upper triangle of a covariance, signatures as msgpack's own integers."""
    seen, upper = reading.sightings, np.triu_indices(3)
    arrays = (reading.odometry, reading.odometry_cov[upper], seen.z, seen.cov[:, [0, 0, 1], [0, 1, 1]])
    raw = [np.asarray(array, np.float64).tobytes() for array in arrays]
    return bytes(msgpack.packb((reading.time_s, *raw, seen.signature.tolist())))


def _row(line: dict[str, Cell]) -> Row:
    length = f"frames of {line['frame_steps']} steps" if line["frame_steps"] else "a single frame"
    return Row(
        quantity=f"{line['world']}, {length}, {line['every_steps']} steps a message (map older by "
        f"{line['waiting_steps_mean']:g} steps on average): bytes a step; times those of the readings",
        ours=f"{line['bytes_per_step']:.0f}; {line['ratio_to_readings']:.2f}",
    )


def _draw(path: Path, lines: Sequence[dict[str, Cell]]) -> None:
    figure = drawing.new_figure(13.0, 5.6, TITLE, "three vehicles, 500 steps; every message counted once")
    grid = figure.add_gridspec(1, 2, left=0.06, right=0.985, bottom=0.11, top=0.80, wspace=0.14)
    every = sorted({int(line["every_steps"]) for line in lines})
    for column, (title, _) in enumerate(WORLDS):
        axes = figure.add_subplot(grid[0, column])
        here = [line for line in lines if line["world"] == title]
        for length, colour in zip(LENGTHS, COLOURS, strict=True):
            values = [float(line["bytes_per_step"]) for line in here if line["frame_steps"] == length]
            label = f"frames of {length} steps" if length else "a single frame"
            if values:
                axes.plot(range(len(values)), values, color=colour, lw=1.8, marker="o", ms=4, label=label)
        axes.axhline(float(here[0]["readings_bytes_per_step"]), color=drawing.VERMILION, lw=1.5, label="raw readings")
        drawing.plain(axes, f"{title}: bytes a step", "steps that a message covers")
        drawing.number_x(axes, every)
        axes.set_ylim(bottom=0.0)
        drawing.legend(axes, "upper right")
    drawing.save(figure, path)
