"""Imports run one way: fleet_seif <- {vehicles | fusion} <- scenarios <- tests; only one module knows Zenoh."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ALLOWED = {
    "fleet_seif": {"fleet_seif"},
    "vehicles": {"fleet_seif", "vehicles"},
    "fusion": {"fleet_seif", "fusion"},
    "scenarios": {"fleet_seif", "vehicles", "fusion", "scenarios"},
}
TOP_LEVEL = {*ALLOWED, "tests", "pyproject.toml", "README.md", "LICENSE"}


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_run_one_way(package: str) -> None:
    ours = {*ALLOWED, "tests"}
    for path in sorted((ROOT / package).rglob("*.py")):
        used = {name.split(".")[0] for name in imported(path)} & ours
        assert used <= ALLOWED[package], f"{path} imports {used - ALLOWED[package]}"


def test_only_the_bus_knows_zenoh() -> None:
    users = {
        path.relative_to(ROOT).as_posix()
        for package in ALLOWED
        for path in (ROOT / package).rglob("*.py")
        if any(name.split(".")[0] == "zenoh" for name in imported(path))
    }
    assert users == {"fleet_seif/bus.py"}


CORES = {
    "vehicles": ("core", "outbox", "records"),
    "fusion": ("core", "ledger", "life", "stream", "events", "compaction"),
}


@pytest.mark.parametrize("core", [f"{package}/{name}.py" for package, names in CORES.items() for name in names])
def test_cores_have_no_clock_no_socket_and_no_randomness(core: str) -> None:
    forbidden = {"time", "socket", "threading", "random", "secrets", "asyncio", "queue", "zenoh", "sqlite3"}
    assert not {name.split(".")[0] for name in imported(ROOT / core)} & forbidden


def test_the_top_level_holds_what_the_user_fixed() -> None:
    entries = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")}
    generated = {"build", "dist"} | {name for name in entries if name.startswith("out") or name.endswith(".egg-info")}
    assert entries - generated == TOP_LEVEL


def test_joint_solutions_use_one_thread_of_every_library_of_linear_algebra() -> None:
    """In a process of its own: which libraries are found depends on the order of imports."""
    code = (
        "from fleet_seif.jit import one_thread; import fleet_seif.joint; from threadpoolctl import threadpool_info\n"
        "print([each['num_threads'] for each in one_thread(threadpool_info)() if each['user_api'] == 'blas'])"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert set(json.loads(told)) == {1}
