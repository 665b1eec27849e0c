"""Served maps and merges: a canonical map has its own, live ones keep the last, and looking for more has a cadence."""

from fleet_seif.config import FusionSettings
from fleet_seif.joint import landmark_classes
from fleet_seif.merging import merged
from fusion.core import FusionCore
from fusion.mapping import CANDIDATES, MERGE_PAUSE, REFUSED, MapMaker, make_map, map_input
from fusion.merges import merges_of, run_digest
from tests.histories import FLEET
from tests.test_merge_runs import VEHICLES, history


def core_with(count: int, core: FusionCore | None = None) -> FusionCore:
    core = core or FusionCore(FLEET, "node", FusionSettings())
    for vehicle in VEHICLES:
        for data in history(vehicle)[:count]:
            core.on_delta(vehicle, data, 0.0)
    return core


class Clock:
    """A clock that goes on by a second each time it is looked at."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        self.now_s += 1.0
        return self.now_s


def test_a_final_map_has_the_merges_of_its_ledger_and_the_digest_of_the_run() -> None:
    core = core_with(3)
    joint = make_map(map_input(core, 0.0), 0, final=True)
    merges = merges_of(core.ledger)
    assert joint.canonical
    assert joint.names == merges.classes
    assert sum(len(names) == 3 for names in joint.names) == 5
    assert joint.map_digest == run_digest(core.ledger) != core.ledger.map_digest()
    assert joint.counters[CANDIDATES] == len(merges.considered)
    assert joint.counters[REFUSED] == len(merges.refused) > 0


def test_a_live_map_keeps_the_last_merges_with_what_is_new_unmerged_until_they_are_looked_for() -> None:
    maker, core = MapMaker(Clock()), core_with(1)
    first = maker.make(map_input(core, 0.0), 0, final=False)
    assert first.canonical
    known = set(first.names)
    live = maker.make(map_input(core_with(2, core), 0.0), 1, final=False)
    assert not live.canonical
    assert {names for names in live.names if len(names) > 1} <= known
    assert any(len(names) == 1 and names[0].number > 2 for names in live.names)
    assert maker.look_for_merges()
    after = maker.make(map_input(core, 0.0), 2, final=False)
    assert after.names == merged(core.ledger.lives(live=True)).classes
    assert len(after.names) < len(live.names)


def test_merges_are_looked_for_a_share_of_the_time_and_only_where_something_has_changed() -> None:
    clock = Clock()
    maker, core = MapMaker(clock), core_with(1)
    maker.make(map_input(core, 0.0), 0, final=False)
    assert not maker.look_for_merges()  # the first map has its own
    maker.make(map_input(core_with(2, core), 0.0), 1, final=False)
    assert maker.look_for_merges()
    maker.make(map_input(core_with(3, core), 0.0), 2, final=False)
    assert not maker.look_for_merges()  # too early
    clock.now_s += MERGE_PAUSE
    maker.look_for_merges()
    assert maker.make(map_input(core, 0.0), 3, final=False).names == merges_of(core.ledger).classes


def test_a_doubtful_vehicle_is_not_fused_until_it_is_healthy_again() -> None:
    """cat says from its fourth message to its fifth that it is doubtful."""
    core = core_with(5)
    joint = make_map(map_input(core, 0.0), 0, final=True)
    assert joint.poses == ("ann", "bob")
    assert [state.healthy for state in joint.vehicles] == [True, True, False]
    assert all(name.vehicle != "cat" for names in joint.names for name in names)
    again = make_map(map_input(core_with(7, core), 0.0), 1, final=True)
    assert again.poses == VEHICLES
    assert any({name.vehicle for name in names} == set(VEHICLES) for names in again.names)


def test_aliases_are_one_landmark_of_the_served_map() -> None:
    core = core_with(7)
    lives = core.ledger.lives()
    assert [life.aliases for life in lives] == [(), ((0, 6),), ((0, 6),)]
    joint = make_map(map_input(core, 0.0), 0, final=True)
    for names in joint.names:
        numbers = {name.number for name in names if name.vehicle == "bob"}
        assert (0 in numbers) == (6 in numbers)
    assert core.ledger.map_digest() == core.ledger.map_digest(landmark_classes(lives))
