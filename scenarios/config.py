"""Scenario files: TOML, checked before anything starts, every error with file, table, key and what is allowed."""

import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from fleet_seif.config import FilterSettings, FusionSettings, NotNegative, PublishSettings, Settings
from fleet_seif.link import LinkSettings
from fleet_seif.messages import NAME_MAX
from scenarios.detection import DetectionSettings
from scenarios.faults import FaultSettings
from scenarios.mrclam import DatasetSettings
from scenarios.world import NoiseSettings, WorldSettings

VEHICLES_MAX = 100
NODES_MAX = 10


class ScenarioError(ValueError):
    """A scenario that does not exist, or a file that is not one."""


class FleetSettings(Settings):
    """Who takes part. vehicles: how many simulated ones (a data set brings its own). nodes: fusion nodes."""

    name: Annotated[str, Field(pattern=rf"^[A-Za-z0-9_-]{{1,{NAME_MAX}}}$")] = "fleet"
    vehicles: Annotated[int, Field(ge=1, le=VEHICLES_MAX)] = 3
    nodes: Annotated[int, Field(ge=1, le=NODES_MAX)] = 1

    @property
    def node_names(self) -> tuple[str, ...]:
        """fusion, fusion2, fusion3, ..."""
        return tuple("fusion" if i == 0 else f"fusion{i + 1}" for i in range(self.nodes))


class RunSettings(Settings):
    """How it is run. rate_hz: readings a vehicle and second; 0: as fast as acknowledgements allow."""

    rate_hz: NotNegative = 0.0
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1


class Scenario(Settings):
    """One scenario: a simulated world with its noise, or a data set."""

    description: str = ""
    figure: Literal["meetings", "overview"] = "overview"
    fleet: FleetSettings = FleetSettings()
    world: WorldSettings | None = None
    noise: NoiseSettings = NoiseSettings()
    detection: DetectionSettings = DetectionSettings()
    dataset: DatasetSettings | None = None
    filter: FilterSettings = FilterSettings()
    publish: PublishSettings = PublishSettings()
    fusion: FusionSettings = FusionSettings()
    link: LinkSettings = LinkSettings()
    faults: FaultSettings = FaultSettings()
    run: RunSettings = RunSettings()

    @model_validator(mode="after")
    def _one_source(self) -> "Scenario":
        if (self.world is None) == (self.dataset is None):
            raise ValueError("give either a [world] table (simulated) or a [dataset] table (recorded), not both")
        if self.world is not None and self.world.routes == "meetings" and self.fleet.vehicles != 3:
            raise ValueError(
                f'world.routes = "meetings" is for three vehicles, fleet.vehicles is {self.fleet.vehicles}: '
                'use world.routes = "coverage"'
            )
        if self.dataset is not None and not self.detection.is_of_recorded_data:
            raise ValueError("of [detection] a [dataset] takes signatures only: the rest is for a simulated [world]")
        return self

    @model_validator(mode="after")
    def _somebody_knows_what_is_seen(self) -> "Scenario":
        if self.detection.signatures == "none" and self.filter.identities == "signatures":
            raise ValueError(
                'detection.signatures = "none" hides what filter.identities = "signatures" needs: every reading would'
                ' be refused; remedy: filter.identities = "associated"'
            )
        return self


def shipped() -> dict[str, str]:
    """Names and descriptions of the scenarios that come with the package."""
    folder = resources.files("scenarios")
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {f.name[:-5]: str(tomllib.loads(f.read_text())["description"]) for f in files}


def load_scenario(name: str, overrides: tuple[str, ...] = (), seed: int | None = None) -> Scenario:
    """A shipped scenario by name, or one from a file, with `table.key=value` overrides.

    Raises ScenarioError naming file, table, key and what is allowed.
    """
    path = Path(name)
    if name in shipped():
        source, text = f"scenario {name}", (resources.files("scenarios") / f"{name}.toml").read_text()
    elif path.suffix == ".toml" and path.is_file():
        source = str(path)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ScenarioError(f"{source}: cannot be read as UTF-8 text: {error}") from None
    else:
        raise ScenarioError(f"no scenario {name!r}: use one of {', '.join(shipped())}, or the path of a .toml file")
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{source}: not TOML: {error}") from None
    for override in overrides:
        _override(tables, override)
    if seed is not None:
        _override(tables, f"run.seed={seed}")
    try:
        return Scenario.model_validate(tables)
    except ValidationError as error:
        raise ScenarioError(_explain(source, error)) from None


def _override(tables: dict[str, Any], override: str) -> None:
    key, equals, value = override.partition("=")
    *path, name = key.strip().split(".")
    if not equals or not path or not all((*path, name)):
        raise ScenarioError(f"--set {override!r}: expected TABLE.KEY=VALUE, for instance fleet.vehicles=5")
    try:
        parsed = tomllib.loads(f"v = {value}")["v"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    table: Any = tables
    for part in path:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {override!r}: {part} is a key, not a table")
    table[name] = parsed


def _explain(source: str, error: ValidationError) -> str:
    lines = []
    told = [fault for fault in error.errors() if fault["type"] != "default_factory_not_called"]  # follows from another
    for fault in told:
        where = ".".join(str(part) for part in fault["loc"])
        text = fault["msg"].removeprefix("Value error, ")
        if fault["type"] == "extra_forbidden":
            known = _known_keys(tuple(str(part) for part in fault["loc"][:-1]))
            text = f"unknown key; known here: {', '.join(known)}"
        elif "input" in fault and not isinstance(fault["input"], dict):
            text += f", got {fault['input']!r}"
        lines.append(f"{source}: [{where}] {text}" if where else f"{source}: {text}")
    return "\n".join(lines)


def _known_keys(path: tuple[str, ...]) -> list[str]:
    model: type[Settings] = Scenario
    for name in path:
        annotation: Any = model.model_fields[name].annotation
        choices = [annotation, *getattr(annotation, "__args__", ())]
        model = next(choice for choice in choices if isinstance(choice, type) and issubclass(choice, Settings))
    return sorted(model.model_fields)
