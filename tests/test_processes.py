"""The last mile: real processes, real Zenoh, the commands a user types."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.fleets import run_virtual

COMMAND = [sys.executable, "-m", "scenarios"]
FAST = ["--set", "world.steps=120"]
PATIENCE_S = 100


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def children_of(pid: int) -> list[int]:
    """Processes started by another, read from the system."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == pid and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def running(pid: int) -> bool:
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def command_line(pid: int) -> bytes:
    return (Path("/proc") / str(pid) / "cmdline").read_bytes()


def wait_until(condition: object, what: str) -> None:
    assert callable(condition)
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.02)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that a short real run leaves."""
    folder = tmp_path_factory.mktemp("run") / "out"
    done = command("run", "three_air_vehicles", *FAST, "--out", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "fused map: " in done.stdout
    return folder


def test_a_real_run_gives_the_digest_of_the_virtual_one(finished: Path) -> None:
    report = json.loads((finished / "report.json").read_text())
    assert report["digest"] == run_virtual("three_air_vehicles", FAST[1]).ledger.map_digest().hex()


@pytest.mark.slow
def test_a_lossy_real_run_gives_the_same_digest_too(finished: Path, tmp_path: Path) -> None:
    settings = [*FAST, "--set", "link.jitter_s=0.3"]
    done = command("run", "lossy_link", *settings, "--out", str(tmp_path), "--quiet")
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    lossy, perfect = (json.loads((folder / "report.json").read_text()) for folder in (tmp_path, finished))
    assert lossy["digest"] == perfect["digest"]
    assert sum(vehicle["gaps_repaired"] for vehicle in lossy["vehicles"].values()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 21))
def test_whole_lossy_real_runs_give_the_digest_of_a_perfect_link_over_seeds(seed: int, tmp_path: Path) -> None:
    done = command("run", "lossy_link", "--seed", str(seed), "--out", str(tmp_path), "--quiet")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["digest"] == run_virtual("three_air_vehicles", seed=seed).ledger.map_digest().hex()


def test_the_report_holds_what_the_readme_promises(finished: Path) -> None:
    report = json.loads((finished / "report.json").read_text())
    whole = (
        "format scenario seed vehicles steps wall_s digest landmark_rmse_m landmark_rmse_aligned_m nees_per_dof "
        "nees_per_landmark truth_landmarks fused_landmarks matched_landmarks merges wrong_merges missed_merges"
    )
    each = (
        "landmark_rmse_m pose_rmse_m step_us_p50 step_us_p99 publish_us_p50 bytes_per_step_mean deltas_published "
        "deltas_folded duplicates gaps_repaired"
    )
    assert set(whole.split()) <= set(report)
    assert list(report["vehicles"]) == ["v1", "v2", "v3"]
    for vehicle in report["vehicles"].values():
        assert set(each.split()) <= set(vehicle)
        assert vehicle["deltas_published"] == vehicle["deltas_folded"] == 122


def test_solving_the_written_system_gives_the_written_means(finished: Path) -> None:
    with np.load(finished / "map.npz") as file:
        n = len(file["b"])
        H = np.zeros((n, n))
        for row in range(n):
            at = slice(file["H_indptr"][row], file["H_indptr"][row + 1])
            H[row, file["H_indices"][at]] = file["H_data"][at]
        mean = np.linalg.solve(H, file["b"])
        landmarks = 2 * len(file["landmark_mean"])
        assert np.array_equal(H, H.T)
        assert mean[:landmarks] == pytest.approx(file["landmark_mean"].ravel(), abs=1e-9)
        newest = [k for k, name in enumerate(file["variables"]) if name.startswith("pose/")]
        assert mean[newest] == pytest.approx(file["pose_mean"].ravel(), abs=1e-9)
        assert np.linalg.inv(H)[:2, :2] == pytest.approx(file["landmark_cov"][0], rel=1e-6)
        assert list(file["variables"][:2]) == ["landmark/0/x", "landmark/0/y"]
        assert list(file["variables"][-3:]) == ["pose/v3/x", "pose/v3/y", "pose/v3/theta"]


def test_the_readings_written_are_those_the_filters_were_fed(finished: Path) -> None:
    run = run_virtual("three_air_vehicles", FAST[1])
    for name, log in run.recording.logs.items():
        with np.load(finished / "readings" / f"{name}.npz") as file:
            assert np.array_equal(file["odometry"], log.odometry)
            assert np.array_equal(file["sighting_range_m"], log.sighting_z[:, 0])
            assert np.array_equal(file["sighting_bearing_rad"], log.sighting_z[:, 1])
            assert file["odometry_cov"].shape == (120, 3, 3)


def test_trajectories_are_in_tum_format(finished: Path) -> None:
    for name in ("v1.tum", "v1_truth.tum"):
        table = np.loadtxt(finished / "trajectory" / name)
        assert table.shape == (121, 8)
        assert np.sum(table[:, 4:] ** 2, axis=1) == pytest.approx(np.ones(121))


def test_a_figure_is_drawn(finished: Path) -> None:
    assert (finished / "figure.png").read_bytes().startswith(b"\x89PNG")


@contextlib.contextmanager
def slow_run() -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A run of two vehicles that takes minutes, once its three processes are there, and those."""
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)  # children inherit SIG_IGN
    run = subprocess.Popen(
        [*COMMAND, "run", "fleet", "--set", "fleet.vehicles=2", "--set", "run.rate_hz=1"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    signal.signal(signal.SIGINT, ours)
    try:
        wait_until(lambda: len(children_of(run.pid)) == 3, "three processes")
        yield run, children_of(run.pid)
    finally:
        run.kill()
        run.communicate()


def test_interrupting_a_run_ends_every_process() -> None:
    with slow_run() as (run, children):
        run.send_signal(signal.SIGINT)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert not any(running(pid) for pid in children)


def test_a_killed_launcher_takes_its_processes_with_it() -> None:
    with slow_run() as (run, children):
        run.kill()
        run.wait()
        wait_until(lambda: not any(running(pid) for pid in children), "the end of the children")


def test_a_vehicle_that_dies_ends_the_run_with_its_name() -> None:
    with slow_run() as (run, children):

        def named() -> list[int]:  # a process that has just been forked still bears its parent's command line
            return [pid for pid in children if b"--name\0v2\0" in command_line(pid)]

        wait_until(lambda: bool(named()), "the command line of v2")
        (victim,) = named()
        os.kill(victim, signal.SIGKILL)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1
    assert "process v2 ended with code -9" in errors
    assert not any(running(pid) for pid in children if pid != victim)


@contextlib.contextmanager
def fusion_node(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A fusion node of fleet "demo" on its own, and where it listens."""
    node = subprocess.Popen(
        [*COMMAND, "fusion", "--listen", "tcp/127.0.0.1:0", "--fleet", "demo", "--supervised", *arguments],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert node.stdout is not None
    assert node.stdin is not None
    node.stdin.write("release\n")  # it need not stay for vehicles that might come back
    node.stdin.flush()
    try:
        yield node, next(e["endpoint"] for line in node.stdout if (e := json.loads(line))["event"] == "listening")
    finally:
        node.stdin.close()
        node.stdout.close()
        node.kill()
        node.wait()


@contextlib.contextmanager
def json_watcher(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """A subscriber that prints JSON lines."""
    watcher = subprocess.Popen(
        [*COMMAND, "watch", endpoint, "--fleet", "demo", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        yield watcher
    finally:
        watcher.kill()
        watcher.communicate()


def drive_v1(endpoint: str, steps: int) -> None:
    settings = ("--set", f"world.steps={steps}", "--set", "run.rate_hz=100")
    done = command("vehicle", "fleet", "--name", "v1", "--connect", endpoint, "--fleet", "demo", *settings)
    assert done.returncode == 0, done.stderr


def test_a_subscriber_sees_the_map_grow_to_the_final_one() -> None:
    with fusion_node("--expected", "2") as (node, endpoint):
        drive_v1(endpoint, 60)
        with json_watcher(endpoint) as watcher:
            assert watcher.stdout is not None
            maps = [json.loads(watcher.stdout.readline())]  # a map at once, though nothing happens any more
            settings = ("--set", "fleet.vehicles=2", "--set", "world.steps=60", "--set", "run.rate_hz=100")
            done = command("vehicle", "fleet", "--name", "v2", "--connect", endpoint, "--fleet", "demo", *settings)
            assert done.returncode == 0, done.stderr
            maps += [json.loads(line) for line in watcher.communicate(timeout=PATIENCE_S)[0].splitlines()]
        assert node.wait(PATIENCE_S) == 0
    assert not maps[0]["final"]
    assert maps[-1]["final"]
    assert [m["version"] for m in maps] == sorted({m["version"] for m in maps})
    assert [(v["name"], v["cut"], v["placed"]) for v in maps[-1]["vehicles"]] == [("v1", 61, True), ("v2", 61, True)]


def test_a_subscriber_is_told_when_the_fusion_node_is_gone() -> None:
    with fusion_node() as (node, endpoint), json_watcher(endpoint) as watcher:
        drive_v1(endpoint, 20)
        assert watcher.stdout is not None
        watcher.stdout.readline()
        node.kill()
        _, errors = watcher.communicate(timeout=PATIENCE_S)
    assert watcher.returncode == 1
    assert "fusion node has been away" in errors


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run", "nowhere"], 2, ["no scenario 'nowhere'", "three_air_vehicles"]),
        (["run", "fleet", "--set", "world.landmark=3"], 2, ["[world.landmark]", "landmarks"]),
        (["run", "fleet", "--set", "fleet.vehicles=many"], 2, ["[fleet.vehicles]", "'many'"]),
        (["run", "mrclam"], 2, ["dataset.path"]),
        (["run", "mrclam", "--set", "dataset.path=/nowhere"], 2, ["/nowhere"]),
        (["run", "fleet", "--out", "/proc/nothing"], 1, ["/proc/nothing", "--out"]),
        (["run", "fleet", "--seed", "-1"], 2, ["--seed"]),
        (["vehicle", "fleet", "--name", "v9"], 2, ["v9", "v1"]),
        (["vehicle", "fleet", "--name", "v1", "--connect", "tcp/192.0.2.1:7447"], 1, ["--insecure"]),
        (["fusion", "--listen", "tcp/0.0.0.0:0"], 1, ["--insecure"]),
        (["fusion", "--listen", "nonsense"], 1, ["PROTOCOL/ADDRESS"]),
        (["run", "three_air_vehicles", "--set", "world.steps=60"], 2, ["60 steps", "at least 89"]),
        (["fusion", "--fleet", "a/b"], 2, ["a/b", "characters"]),
        (["watch", "--fleet", "a b"], 2, ["a b", "characters"]),
        (["fly"], 2, ["fly"]),
    ],
)
def test_bad_input_is_answered_in_a_sentence(arguments: list[str], code: int, words: list[str]) -> None:
    done = command(*arguments)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr


def test_a_vehicle_without_a_fusion_node_says_so() -> None:
    done = command("vehicle", "fleet", "--name", "v1", "--connect", "tcp/127.0.0.1:1")
    assert done.returncode == 1
    assert "cannot reach a fusion node at tcp/127.0.0.1:1" in done.stderr


def test_the_scenarios_are_listed() -> None:
    done = command("scenarios")
    assert done.returncode == 0
    for name in ("three_air_vehicles", "lossy_link", "mrclam"):
        assert name in done.stdout
