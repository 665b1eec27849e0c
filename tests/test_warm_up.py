"""What is compiled before a process says that it is ready: everything that it will run, and no more."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled"),
    pytest.mark.timeout(600),
]
CODE = """
import json, sys
from fleet_seif.warm_up import warm_up

def compiled():
    found = {}
    for name, module in sorted(sys.modules.items()):
        for key, value in vars(module).items() if name.startswith("fleet_seif") else ():
            if hasattr(value, "nopython_signatures"):
                found[value.py_func.__module__ + "." + value.__name__] = len(value.signatures)
    return found

warm_up(frames=sys.argv[2], identities=sys.argv[1])
before = compiled()
if sys.argv[1] == "associated":
    from tests.test_frames_associated import SETTINGS, FramedFilter, flight, restarted
    framed = FramedFilter(SETTINGS.model_copy(update={"frames": sys.argv[2]}))
    framed.start(flight().start)
    for each in flight().readings:
        framed.step(each)
        framed.localise()
    framed = restarted(framed)
    framed.step(flight().readings[0])
    framed.end()
    framed.localise()
print(json.dumps([before, compiled()]))
"""


def compiled(identities: str, frames: str = "adaptive") -> tuple[dict[str, int], dict[str, int]]:
    """How many variants of each kernel there are in a new process after warm-up, and after a flight."""
    run = subprocess.run(
        [sys.executable, "-c", CODE, identities, frames],
        check=True, capture_output=True, text=True, timeout=500, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    before, after = json.loads(run.stdout)
    return before, after


@pytest.mark.parametrize("frames", ["adaptive", "single"])
def test_after_warm_up_nothing_is_compiled_any_more_where_a_vehicle_finds_out_what_it_sees(frames: str) -> None:
    """Nor after its state was taken up again: arrays that cannot be written to would be another type."""
    before, after = compiled("associated", frames)
    assert {name: count for name, count in after.items() if count != before.get(name, 0)} == {}
    assert before["fleet_seif.local_map.in_reach"] == 1


def test_a_vehicle_that_is_told_what_it_sees_compiles_nothing_of_that() -> None:
    before, _ = compiled("signatures")
    own = ("association", "association_guards", "jcbb", "local_map", "consistent")
    assert {name for name, count in before.items() if count and name.split(".")[1] in own} == set()
