"""Scenario files and overrides: what is wrong is named with file, table, key and what is allowed."""

from pathlib import Path

import pytest

from fleet_seif.config import AssociationSettings, FilterSettings
from scenarios.config import ScenarioError, load_scenario, shipped

WORLD = "[world]\nlandmarks = 10\nroutes = 'coverage'\n"


@pytest.mark.parametrize("name", [name for name in shipped() if name != "mrclam"])
def test_shipped_scenarios_load_and_describe_themselves(name: str) -> None:
    assert load_scenario(name).description == shipped()[name] != ""


def test_the_shipped_scenarios_are_those_of_the_readme() -> None:
    assert set(shipped()) == {
        "three_air_vehicles", "three_air_vehicles_mild", "fleet", "lossy_link", "mrclam",
        "crash_restart", "hostile_vehicle", "late_joiner", "partition", "three_air_vehicles_unknown", "grid",
    }  # fmt: skip


def test_an_unknown_scenario_is_answered_with_the_known_ones() -> None:
    with pytest.raises(ScenarioError, match=r"'nowhere'.*three_air_vehicles"):
        load_scenario("nowhere")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (WORLD + "[filter]\nactive = 6\n", ["[filter.active]", "unknown key", "active_max", "gate"]),
        (WORLD + "[filter]\nactive_max = 'six'\n", ["[filter.active_max]", "integer", "'six'"]),
        (WORLD + "[filter]\nactive_max = 0\n", ["[filter.active_max]", "greater than or equal to 1", "0"]),
        (WORLD + "[wheels]\nn = 4\n", ["[wheels]", "unknown key", "world", "filter"]),
        (WORLD + "[link]\nloss = 1.5\n", ["[link.loss]", "less than or equal to 1", "1.5"]),
        ("[fleet]\nvehicles = 2\n", ["[world]", "[dataset]"]),
        ("[world]\nroutes = 'meetings'\n[fleet]\nvehicles = 4\n", ["three vehicles", "coverage"]),
        (WORLD + "[fleet]\nname = 'a/b'\n", ["[fleet.name]", "a/b"]),
        (WORLD + "[detection]\nclutter_share = 0.1\n", ["[detection]", "no signature", 'signatures = "none"']),
        ("[dataset]\nkind = 'mrclam'\n[detection]\nmissed_share = 0.1\n", ["[detection]", "signatures only"]),
        (WORLD + "[detection]\nsignatures = 'none'\n", ["refused", 'filter.identities = "associated"']),
        (WORLD + "[filter]\nidentities = 'guessed'\n", ["[filter.identities]", "'signatures' or 'associated'"]),
        ("[world\n", ["not TOML"]),
    ],
)
def test_a_wrong_file_is_refused_with_the_place_and_what_is_allowed(
    tmp_path: Path, text: str, words: list[str]
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(path))
    for word in [str(path), *words]:
        assert word in str(caught.value)
    assert "default factory" not in str(caught.value)


def test_set_changes_a_key_and_keeps_the_rest() -> None:
    plain, changed = load_scenario("fleet"), load_scenario("fleet", ("fleet.vehicles=7",), seed=9)
    assert (changed.fleet.vehicles, changed.run.seed) == (7, 9)
    assert changed.world == plain.world


def test_set_reaches_the_keys_of_a_table_within_a_table() -> None:
    changed = load_scenario("fleet", ("filter.association.confirm_sightings=4",))
    assert changed.filter.association.confirm_sightings == 4
    with pytest.raises(ScenarioError, match="kind is a key, not a table"):
        load_scenario("fleet", ("filter.kind=eif", "filter.kind.x=3"))


def test_the_correction_of_a_frame_waits_for_landmarks_to_be_confirmed_where_the_vehicle_finds_out_which_they_are() -> (
    None
):
    told = AssociationSettings(confirm_steps=20)
    assert FilterSettings(association=told).close_lag_steps == 2
    assert FilterSettings(identities="associated").close_lag_steps == 12
    assert FilterSettings(identities="associated", association=told).close_lag_steps == 30
    assert FilterSettings(identities="associated", close_lag_steps=3).close_lag_steps == 3


@pytest.mark.parametrize("override", ["fleet.vehicles", "vehicles=3", "fleet..n=3", "=3"])
def test_a_malformed_set_option_is_refused(override: str) -> None:
    with pytest.raises(ScenarioError, match=r"TABLE\.KEY=VALUE"):
        load_scenario("fleet", (override,))


def test_texts_need_no_quotes_in_set_options() -> None:
    scenario = load_scenario("mrclam", ("dataset.path=/some where/MRCLAM_Dataset2",))
    assert scenario.dataset is not None
    assert scenario.dataset.path == Path("/some where/MRCLAM_Dataset2")
