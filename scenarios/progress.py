"""Progress of a run: bars on a terminal, a line now and then elsewhere."""

import contextlib
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

LINE_S = 5.0


@contextlib.contextmanager
def progress_bars(console: Console, totals: dict[str, int], quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A function to call with (vehicle, done, total); names that are not in `totals` are left alone."""
    if quiet:
        yield lambda name, done, total: None
    elif console.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console) as bars:
            tasks = {name: bars.add_task(name, total=total) for name, total in totals.items()}

            def update(name: str, done: int, total: int) -> None:
                if name in tasks:
                    bars.update(tasks[name], completed=done)

            yield update
    else:
        yield _lines(console, totals)


def _lines(console: Console, totals: dict[str, int]) -> Callable[[str, int, int], None]:
    steps = dict.fromkeys(totals, 0)
    told_s, told = time.monotonic(), ""

    def update(name: str, done: int, total: int) -> None:
        nonlocal told_s, told
        if name in steps:
            steps[name] = done
        if time.monotonic() >= told_s + LINE_S:
            told_s = time.monotonic()
            text = "  ".join(f"{name} {done}/{totals[name]}" for name, done in steps.items())
            if text != told:
                told = text
                console.print(text, highlight=False, soft_wrap=True)

    return update
