"""Three air vehicles map one world and meet twice (Fig. 17 of the SEIF paper): a virtual run of the scenario.

Everything but Zenoh and processes is as in `fleet-seif run three_air_vehicles --virtual`: filters, deltas, fusion.
"""

from pathlib import Path
from typing import Final

from scenarios.config import load_scenario
from scenarios.experiments.study import Cell, Progress, Row, csv_of, png_of, write_csv
from scenarios.figure import draw_figure, figure_times
from scenarios.history import Moment, replay
from scenarios.report import FinishedRun, Outcome, evaluate
from scenarios.score import score_map
from scenarios.source import record
from scenarios.virtual import run_virtual

NAME: Final = "fleet"
TITLE: Final = "Three air vehicles map one world and meet twice (SEIF paper, Fig. 17)"
SCENARIO: Final = "three_air_vehicles"
SETTINGS: Final = ("filter.frames='single'",)
QUICK_SETTINGS: Final = (*SETTINGS, "world.steps=120")


def run(out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Raises RunError or NumericalError where the run fails."""
    scenario = load_scenario(SCENARIO, QUICK_SETTINGS if quick else SETTINGS, seed)
    recording = record(scenario)
    total = sum(log.steps for log in recording.logs.values())
    done = dict.fromkeys(recording.logs, 0)

    def step(vehicle: str, now: int, _: int) -> None:
        done[vehicle] = now
        progress(sum(done.values()), total)

    finished = run_virtual(SCENARIO, scenario, recording, step)
    times = figure_times("meetings", recording)
    moments = list(replay(finished.ledger, times.times_s))
    draw_figure(
        png_of(out, NAME),
        title=TITLE,
        recording=recording,
        times=times,
        moments=moments,
        drives=finished.drives,
        truths=finished.truths,
    )
    write_csv(csv_of(out, NAME), [_line(moment, finished) for moment in moments])
    return _rows(evaluate(finished))


def _line(moment: Moment, run: FinishedRun) -> dict[str, Cell]:
    score = score_map(moment.solution, moment.landmark_cov, run.recording, run.truths)
    return {
        "time_s": moment.time_s,
        "landmarks": score.fused_landmarks,
        "uncertainty_m2": moment.uncertainty_m2,
        "landmark_rmse_m": _cell(score.landmark_rmse_m),
        "landmark_rmse_aligned_m": _cell(score.landmark_rmse_aligned_m),
        "nees_per_dof": _cell(score.nees_per_dof),
        "merges": score.merges,
    }


def _cell(value: float | None) -> Cell:
    return "" if value is None else value


def _rows(outcome: Outcome) -> list[Row]:
    report, score = outcome.report, outcome.score
    rows = [
        Row(
            quantity=f"{' and '.join(met['vehicles'])} meet, step {met['step']}: "
            "variance of landmarks known before, summed, m^2, before; 3 steps after",
            ours=f"{met['uncertainty_before_m2']:.3g}; {met['uncertainty_after_m2']:.3g}",
        )
        for met in report["meetings"]
    ]
    return [
        *rows,
        Row(quantity="fused landmarks of landmarks seen", ours=f"{score.fused_landmarks} of {score.truth_landmarks}"),
        Row(quantity="merges; wrong; missed", ours=f"{score.merges}; {score.wrong_merges}; {score.missed_merges}"),
        Row(
            quantity="fused map, error, m, RMS (map moved to fit best)",
            ours=f"{_number(score.landmark_rmse_m)} ({_number(score.landmark_rmse_aligned_m)})",
        ),
        Row(quantity="fused map, NEES per dof", ours=_number(score.nees_per_dof)),
        Row(quantity="gate of the vehicles' filters", ours="on, as in the scenario"),
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
