"""Figures: when they look at a run, and that they can be drawn of any run."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from fleet_seif.merge_records import Considered, Merges, Reason
from scenarios.association import Truths, assigned_truth
from scenarios.config import load_scenario
from scenarios.figure import DPI, SIZE_IN, FigureTimes, Kind, draw_figure, figure_times
from scenarios.history import Moment, meetings, replay
from scenarios.recording import Recording
from scenarios.report import FinishedRun
from scenarios.source import record
from scenarios.virtual import run_virtual

KINDS: tuple[Kind, ...] = ("meetings", "overview")
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


@cache
def paper() -> Recording:
    return record(load_scenario("three_air_vehicles", ("world.steps=120",)))


@cache
def tiny_run() -> tuple[Recording, FinishedRun]:
    """Few steps of three vehicles among whom some share landmarks."""
    changes = ("fleet.vehicles=3", "world.landmarks=20", "world.steps=12", "run.rate_hz=0")
    scenario = load_scenario("fleet", changes)
    recording = record(scenario)
    return recording, run_virtual("fleet", scenario, recording)


def moments_at(times: FigureTimes) -> list[Moment]:
    return list(replay(tiny_run()[1].ledger, times.times_s[-3:]))


def truths_of(recording: Recording) -> Truths:
    drives = tiny_run()[1].drives
    return {name: assigned_truth(log, drives[name].assigned) for name, log in recording.logs.items()}


def draw(path: Path, kind: Kind, recording: Recording, moments: Sequence[Moment] | None = None) -> bytes:
    """The file's bytes, after a look at its size."""
    times = figure_times(kind, recording)
    draw_figure(
        path,
        title="A tiny run",
        recording=recording,
        times=times,
        moments=moments_at(times) if moments is None else moments,
        drives=tiny_run()[1].drives,
        truths=truths_of(recording),
    )
    data = path.read_bytes()
    assert data.startswith(PNG_MAGIC)
    assert matplotlib.image.imread(path).shape[:2] == (SIZE_IN[1] * DPI, SIZE_IN[0] * DPI)
    return data


def without_truth(recording: Recording) -> Recording:
    logs = {
        name: replace(
            log,
            truth_pose=np.full_like(log.truth_pose, np.nan),
            sighting_truth=np.full_like(log.sighting_truth, -1),
        )
        for name, log in recording.logs.items()
    }
    return Recording(landmarks=np.empty((0, 2)), logs=logs, skipped={})


def test_times_ascend_and_hold_every_panel_and_the_end() -> None:
    for kind in KINDS:
        times = figure_times(kind, paper())
        assert list(times.times_s) == sorted(set(times.times_s))
        assert {time_s for time_s, _ in times.panels} <= set(times.times_s)
        assert times.panels[-1] == (times.times_s[-1], "the end")
        assert times.times_s[-1] == paper().logs["v1"].time_s[-1]


def test_the_six_panels_are_just_before_and_just_after_both_meetings_and_the_ends() -> None:
    times = figure_times("meetings", paper())
    first, second = times.meetings
    clock = paper().logs["v1"].time_s
    panels = [float(time_s) for time_s, _ in times.panels]
    assert len(panels) == 6
    for (_, _, met_s), (before_s, after_s) in ((first, panels[1:3]), (second, panels[3:5])):
        assert before_s == clock[clock < met_s][-1]
        assert met_s < after_s <= met_s + 0.5
        assert met_s in times.times_s
    assert [caption for _, caption in times.panels[1:3]] == ["just before v1 and v2 meet", "just after v1 and v2 met"]


def test_meetings_of_vehicles_that_are_already_connected_are_not_marked() -> None:
    assert len(meetings(paper())) == 3
    assert [(a, b) for a, b, _ in figure_times("meetings", paper()).meetings] == [("v1", "v2"), ("v2", "v3")]


def test_a_long_run_is_looked_at_no_more_than_120_times() -> None:
    recording = record(load_scenario("three_air_vehicles"))
    assert all(60 <= len(figure_times(kind, recording).times_s) <= 120 for kind in KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_tiny_run_can_be_drawn(kind: Kind, tmp_path: Path) -> None:
    draw(tmp_path / "a.png", kind, tiny_run()[0])


def test_the_same_run_gives_the_same_picture_to_the_byte(tmp_path: Path) -> None:
    recording = tiny_run()[0]
    assert draw(tmp_path / "a.png", "overview", recording) == draw(tmp_path / "b.png", "overview", recording)


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_without_any_truth_can_be_drawn(kind: Kind, tmp_path: Path) -> None:
    draw(tmp_path / "a.png", kind, without_truth(tiny_run()[0]))


def test_gaps_in_the_truth_leave_gaps_in_the_picture_only(tmp_path: Path) -> None:
    recording = tiny_run()[0]
    log = recording.logs["v1"]
    holed = log.truth_pose.copy()
    holed[3:8] = np.nan
    logs = {**recording.logs, "v1": replace(log, truth_pose=holed)}
    draw(tmp_path / "a.png", "overview", Recording(landmarks=recording.landmarks, logs=logs, skipped={}))


def test_a_run_of_which_no_map_is_known_can_be_drawn(tmp_path: Path) -> None:
    draw(tmp_path / "a.png", "overview", tiny_run()[0], [])


def test_pairs_kept_apart_and_doubtful_vehicles_show_in_the_picture(tmp_path: Path) -> None:
    recording = tiny_run()[0]
    moment = moments_at(figure_times("overview", recording))[-1]
    one, two = (names[0] for names in moment.solution.classes[:2])
    apart = Merges(moment.solution.classes, considered=(Considered(one, two, 3.0, Reason.AMBIGUOUS),))
    pictures = [
        draw(tmp_path / "a.png", "overview", recording, [each])
        for each in (moment, replace(moment, merges=apart), replace(moment, doubtful=frozenset({"v2"})))
    ]
    assert len(set(pictures)) == 3
