"""The option that rewrites the baseline, the ratios of a run, and the table at its end."""

import os
from collections.abc import Callable, Iterator

import pytest
from threadpoolctl import threadpool_limits

from tests.benchmarks import baseline

OPTION = "--write-baseline"
RATIOS = pytest.StashKey[dict[str, float]]()
Ratio = Callable[[str, float], None]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(OPTION, action="store_true", help="put the ratios of this run into tests/benchmarks/baseline.json")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Single-threaded BLAS for all that is compared."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@pytest.fixture
def ratio(request: pytest.FixtureRequest) -> Ratio:
    """ratio(name, value): compare with the baseline; the test fails where it is worse than allowed."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
        pytest.skip("kernels are not compiled: NUMBA_DISABLE_JIT is set")
    found = request.config.stash.setdefault(RATIOS, {})
    expected = baseline.load()

    def compare(name: str, value: float) -> None:
        found[name] = value
        why = baseline.refusal(expected, name, value)
        if why and not (name in expected and request.config.getoption(OPTION)):
            pytest.fail(why)

    return compare


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """The ratios of this run beside those of the baseline; with the option, the file is rewritten."""
    found = config.stash.get(RATIOS, {})
    if not found:
        return
    expected = baseline.load()
    terminalreporter.section("ratios: now, baseline, worst allowed")
    for name, value in found.items():
        entry = expected.get(name)
        beside = (
            f"{entry.value:10.3g}{entry.worst:10.3g}  {entry.better} is better" if entry else "  not in the baseline"
        )
        terminalreporter.write_line(f"{name:44s}{value:10.3g}{beside}")
    if config.getoption(OPTION):
        baseline.save(baseline.with_values(expected, found))
        terminalreporter.write_line(f"{baseline.PATH.name} rewritten")
