"""Marks of a figure: who saw a landmark, what was kept apart and why, and what was not fused."""

import matplotlib.colors
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fleet_seif.merge_records import Considered, Reason
from fleet_seif.messages import LandmarkName
from scenarios.figure_marks import MARKER_OF, NAMES_MAX, draw_kept_apart, draw_own_map, draw_seen_by, legend_of

ANN, BOB, CAT = (LandmarkName(vehicle, 0, 7) for vehicle in ("ann", "bob", "cat"))
MEAN = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
COLOURS = {"ann": "#ff0000", "bob": "#00ff00", "cat": "#0000ff"}


def empty() -> Axes:
    return Figure().add_subplot()


def faces(axes: Axes) -> list[tuple[list[float], str]]:
    """Place and colour of every dot and sector, in the order in which they are drawn."""
    return [
        (place, matplotlib.colors.to_hex(face))
        for marks in axes.collections
        for place, face in zip(
            np.asarray(marks.get_offsets()).tolist(), np.atleast_2d(marks.get_facecolor()), strict=True
        )
        if matplotlib.colors.to_hex(face) in COLOURS.values()
    ]


def test_a_landmark_has_a_sector_in_the_colour_of_each_vehicle_that_saw_it() -> None:
    axes = empty()
    draw_seen_by(axes, MEAN, [["cat"], ["ann", "bob"], ["ann", "bob", "cat"]], COLOURS, 9.0)
    one, two, three = MEAN.tolist()
    assert sorted(faces(axes)) == sorted([
        (one, "#0000ff"),
        (two, "#ff0000"), (two, "#00ff00"),
        (three, "#ff0000"), (three, "#00ff00"), (three, "#0000ff"),
    ])  # fmt: skip


def test_a_pair_kept_apart_has_a_line_between_its_landmarks_whatever_name_they_go_by() -> None:
    axes = empty()
    refused = [Considered(ANN, BOB, 3.0, Reason.AMBIGUOUS), Considered(BOB, CAT, 30.0, Reason.CONTRADICTED)]
    first = LandmarkName("aaa", 0, 0)
    draw_kept_apart(axes, MEAN, ((first, ANN), (BOB,), (CAT,)), refused, 1.0)
    lines = [np.column_stack(line.get_data()).tolist() for line in axes.lines]
    assert lines[0::2] == [MEAN[[0, 1]].tolist(), MEAN[[1, 2]].tolist()]
    assert lines[1::2] == [[[0.5, 0.0]], [[0.5, 1.0]]]
    assert [line.get_marker() for line in axes.lines[1::2]] == [
        MARKER_OF[Reason.AMBIGUOUS], MARKER_OF[Reason.CONTRADICTED]
    ]  # fmt: skip


def test_every_reason_to_keep_a_pair_apart_has_a_mark_of_its_own() -> None:
    assert set(MARKER_OF) == set(Reason) - {Reason.MERGED}
    assert len(set(MARKER_OF.values())) == len(MARKER_OF)


def test_an_own_map_is_hollow() -> None:
    axes = empty()
    draw_own_map(axes, MEAN, COLOURS["ann"], 1.0)
    assert np.asarray(axes.collections[0].get_offsets()).tolist() == MEAN.tolist()
    assert np.asarray(axes.collections[0].get_facecolor()).size == 0


def test_the_legend_counts_pairs_by_reason_at_the_end_and_names_who_is_not_fused() -> None:
    before = [Considered(ANN, BOB, 3.0, Reason.UNSOLVED)]
    end = [Considered(ANN, BOB, 3.0, Reason.FEW)] * 2 + [Considered(ANN, CAT, 3.0, Reason.AMBIGUOUS)]
    words = [str(handle.get_label()) for handle in legend_of([before, end], ["ann", "bob"])]
    assert words[:4] == [
        "kept apart (at the end):",
        f"{Reason.AMBIGUOUS} (1)",
        f"{Reason.FEW} (2)",
        f"{Reason.UNSOLVED} (0)",
    ]
    assert words[4].startswith("doubtful: not fused (ann, bob)")
    many = [f"v{i}" for i in range(NAMES_MAX + 3)]
    assert "and 3 more" in str(legend_of([], many)[0].get_label())
    assert legend_of([[]], []) == []
