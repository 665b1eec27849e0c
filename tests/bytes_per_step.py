"""Bytes a vehicle publishes per step against the size of the map: python -m tests.bytes_per_step [PNG]."""

import sys

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tests.fleets import run_virtual

SIZES = (50, 100, 200, 500, 1000, 2000, 5000)
STEPS = 2000


def table() -> dict[int, int]:
    """Mean bytes a step by landmarks in the world, one vehicle, six active landmarks."""
    rows = {}
    for landmarks in SIZES:
        settings = ("fleet.vehicles=1", f"world.landmarks={landmarks}", f"world.steps={STEPS}", "run.rate_hz=0")
        (drive,) = run_virtual("fleet", *settings).drives.values()
        rows[landmarks] = round(drive.bytes_put / STEPS)
    return rows


def main() -> None:
    rows = table()
    for landmarks, size in rows.items():
        print(f"{landmarks:6d} landmarks  {size:6d} bytes a step")
    if len(sys.argv) > 1:
        figure = Figure(figsize=(7, 3.5), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        axes.semilogx(list(rows), list(rows.values()), "o-", color="#0072B2")
        axes.set(xlabel="landmarks in the world", ylabel="bytes a step", ylim=(0, 2 * max(rows.values())))
        axes.grid(color="#dddddd")
        figure.savefig(sys.argv[1], dpi=100)


if __name__ == "__main__":
    main()
