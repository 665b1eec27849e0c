"""How long a process takes until every kernel is ready, beside one that only imports the libraries we stand on.

With the kernels cached on disk, as after the first run; and with an empty cache (marked slow: half a minute).
"""

import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks.conftest import Ratio
from tests.benchmarks.runs import Arguments, median, rounds_us

READY = "from fleet_seif.warm_up import warm_up; warm_up()"
LIBRARIES = "import numba, numpy, pydantic, scipy.sparse.linalg, threadpoolctl"
ROUNDS = 5


def run(code: str, environment: Mapping[str, str] | None = None) -> float:
    """Seconds a new Python takes for it."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, **(environment or {})})
    return time.perf_counter() - begin


@pytest.mark.benchmark(group="start-up")
def test_start_up_with_cached_kernels(benchmark: BenchmarkFixture, ratio: Ratio) -> None:
    libraries_s: list[float] = []
    run(READY)

    def ready() -> Arguments:
        libraries_s.append(run(LIBRARIES))
        return (READY,), {}

    ready_s = 1e-6 * median(rounds_us(benchmark, run, ready, ROUNDS))
    benchmark.extra_info["median s, libraries alone"] = median(libraries_s)
    ratio("start_up_over_imports_of_libraries", ready_s / median(libraries_s))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.benchmark(group="start-up")
def test_start_up_with_an_empty_cache(benchmark: BenchmarkFixture, ratio: Ratio, tmp_path: Path) -> None:
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    cold_s = 1e-6 * median(rounds_us(benchmark, run, lambda: ((READY, cache), {}), 1))
    warm_s = median([run(READY, cache) for _ in range(ROUNDS)])
    benchmark.extra_info["median s, cached"] = warm_s
    ratio("start_up_without_cache_over_with", cold_s / warm_s)
