"""From a finished run to its report and the files in its folder."""

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from fleet_seif.errors import RunError
from fleet_seif.joint import JointSolution, marginal_covariances, solve
from fleet_seif.merging import Merges
from fleet_seif.records import Floats
from fusion.ledger import Ledger
from fusion.merges import merges_of
from scenarios import output
from scenarios.association import Truths, assigned_truth, associate, fleet_association
from scenarios.config import Scenario
from scenarios.history import meetings, pose_times, replay, uncertainty_of
from scenarios.recording import Recording
from scenarios.score import MapScore, score_map, score_vehicle
from vehicles.drive import DriveResult

MEETING_STEPS: Final = 3
TIME_SLACK_S: Final = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class FinishedRun:
    """All that a run left behind. streams: per vehicle what the fusion node counted; fusion: what it measured."""

    name: str
    scenario: Scenario
    recording: Recording
    ledger: Ledger
    drives: dict[str, DriveResult]
    streams: dict[str, dict[str, int]]
    wall_s: float
    fusion: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def truths(self) -> Truths:
        """Which true landmark each vehicle's landmarks are, by what it assigned to them."""
        return {name: assigned_truth(log, self.drives[name].assigned) for name, log in self.recording.logs.items()}


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome:
    """The canonical map of a run, its score and its report."""

    solution: JointSolution
    landmark_cov: Floats
    score: MapScore
    report: dict[str, Any]


def evaluate(run: FinishedRun) -> Outcome:
    """Solve canonically and score. Raises RunError where no vehicle is part of the map."""
    doubtful = sorted({s.vehicle for s in run.ledger.streams.values() if not s.healthy})
    if not run.ledger.lives():
        raise RunError(
            f"no vehicle is part of the map; doubtful by their own word: {', '.join(doubtful) or 'none'}. Without"
            " identities landmarks may be too close together for this noise: see filter.association"
        )
    merges = merges_of(run.ledger)
    solution = solve(run.ledger.lives(), merges.classes)
    landmark_cov, _ = marginal_covariances(solution)
    score = score_map(solution, landmark_cov, run.recording, run.truths)
    report = {
        "format": output.FORMAT,
        "scenario": run.name,
        "seed": run.scenario.run.seed,
        "steps": max(log.steps for log in run.recording.logs.values()),
        "wall_s": run.wall_s,
        "digest": run.ledger.map_digest(merges.classes).hex(),
        **{name: value for name, value in vars(score).items() if name != "landmark_truth"},
        **fleet_association(run.recording, {name: drive.assigned for name, drive in run.drives.items()}).fields(),
        "doubtful_vehicles": doubtful,
        "vehicles": {name: _vehicle(run, name) for name in run.recording.logs},
        "frames": _frames(solution),
        "merging": _merging(merges),
        "meetings": meeting_report(run.ledger, run.recording) if run.scenario.figure == "meetings" else [],
        "sightings_left_out": run.recording.skipped,
        "fusion": run.fusion,
    }
    return Outcome(solution=solution, landmark_cov=landmark_cov, score=score, report=report)


def _merging(merges: Merges) -> dict[str, Any]:
    """Pairs of landmarks of different vehicles that were compared by their place, and why some were kept apart."""
    return {
        "candidates": len(merges.considered),
        "merged": len(merges.considered) - len(merges.refused),
        "kept_apart": dict(sorted(Counter(str(each.reason) for each in merges.refused).items())),
    }


def _frames(solution: JointSolution) -> dict[str, Any]:
    """How many frames the map is made of, and those that disagree with the others so much that they count less."""
    return {
        "count": len(solution.frames),
        "weighted_down": [
            {
                "vehicle": solution.frames[f][0],
                "life": solution.frames[f][1],
                "frame": solution.frames[f][2],
                "weight": float(solution.weight[f]),
                "chi_square_per_row": float(solution.chi_square[f] / solution.dof[f]),
            }
            for f in solution.doubtful.tolist()
        ],
    }


def _vehicle(run: FinishedRun, name: str) -> dict[str, Any]:
    result, log = run.drives[name], run.recording.logs[name]
    return {
        **score_vehicle(result, log, run.recording.landmarks),
        **associate(log, result.assigned).fields(),
        "step_us_p50": _us(result.filter_s, 50),
        "step_us_p99": _us(result.filter_s, 99),
        "publish_us_p50": _us(result.publish_s, 50),
        "bytes_per_step_mean": result.bytes_put / max(log.steps, 1),
        "deltas_published": result.messages,
        **run.streams[name],
        "readings_refused": result.readings_refused,
        "sightings_refused": result.sightings_refused,
        "steps_beyond_active_max": result.steps_beyond_active_max,
    }


def _us(seconds: Floats, percentile: float) -> float | None:
    return float(np.percentile(seconds, percentile) * 1e6) if len(seconds) else None


def write_folder(folder: Path, run: FinishedRun, outcome: Outcome) -> None:
    """Everything the README promises, into a folder made by output.prepare_folder."""
    from scenarios.figure import draw_figure, figure_times  # every process of a fleet would wait for matplotlib

    for name, log in run.recording.logs.items():
        output.write_readings(folder, log, run.drives[name].assigned)
        output.write_trajectory(folder / "trajectory" / f"{name}.tum", log.time_s, run.drives[name].pose)
        output.write_trajectory(folder / "trajectory" / f"{name}_truth.tum", log.time_s, log.truth_pose)
    output.write_truth(folder, run.recording)
    pose_time_s = pose_times(run.ledger, outcome.solution.poses)
    output.write_map(folder, outcome.solution, outcome.landmark_cov, outcome.score.landmark_truth, pose_time_s)
    times = figure_times(run.scenario.figure, run.recording)
    draw_figure(
        folder / "figure.png",
        title=run.scenario.description.split(":")[0],
        times=times,
        recording=run.recording,
        moments=list(replay(run.ledger, times.times_s)),
        drives=run.drives,
        truths=run.truths,
    )
    output.write_json(folder / "report.json", outcome.report)  # last: who finds it finds the rest


def meeting_report(ledger: Ledger, recording: Recording) -> list[dict[str, Any]]:
    """For each pair of vehicles, what their first meeting did to the landmarks that were already in the map.

    uncertainty_before_m2, uncertainty_after_m2: summed covariance traces of those landmarks at the step before the
    first sighting in common and MEETING_STEPS later.
    """
    found = []
    for a, b, time_s in meetings(recording):
        clock = recording.logs[a].time_s
        at = int(np.searchsorted(clock, time_s + TIME_SLACK_S)) - 1
        if at < 1:
            continue
        later = min(at + MEETING_STEPS, len(clock) - 1)
        moments = list(replay(ledger, [clock[at - 1] + TIME_SLACK_S, clock[later] + TIME_SLACK_S]))
        if len(moments) == 2:
            before, after = moments
            found.append({
                "vehicles": [a, b],
                "time_s": time_s,
                "step": at,
                "uncertainty_before_m2": before.uncertainty_m2,
                "uncertainty_after_m2": uncertainty_of(after, before),
            })  # fmt: skip
    return found
