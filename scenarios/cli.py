"""The fleet-seif command. Exit code 2: asked wrongly; 1: the run failed; 130: interrupted."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler

from fleet_seif.errors import NumericalError, RunError
from fleet_seif.messages import check_name
from fleet_seif.warm_up import warm_up
from scenarios import children, output, watch
from scenarios.config import ScenarioError, load_scenario, shipped
from scenarios.launch import run_processes
from scenarios.progress import progress_bars
from scenarios.report import evaluate, write_folder
from scenarios.source import record
from scenarios.table import report_table
from scenarios.virtual import run_virtual

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)
console = Console()
errors = Console(stderr=True)


def _fleet_name(name: str | None) -> str | None:
    """The name, if it can be part of a key."""
    try:
        return name if name is None else check_name(name, "fleet")
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


ScenarioArgument = Annotated[str, typer.Argument(help="A shipped scenario (see 'scenarios') or a TOML file.")]
SeedOption = Annotated[int | None, typer.Option(min=0, help="Seed of world, noise and link.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", metavar="TABLE.KEY=VALUE", help="Change a setting.")]
ConfigOption = Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="A Zenoh configuration file.")]
InsecureOption = Annotated[bool, typer.Option("--insecure", help="Allow unencrypted endpoints beyond loopback.")]
FleetOption = Annotated[
    str | None, typer.Option(help="Name of the fleet; the scenario's by default.", callback=_fleet_name)
]
SupervisedOption = Annotated[bool, typer.Option("--supervised", hidden=True)]
ResultOption = Annotated[Path | None, typer.Option(hidden=True)]


@contextlib.contextmanager
def _clear_errors() -> Iterator[None]:
    """Turn what can go wrong into one clear message and an exit code."""
    try:
        yield
    except ScenarioError as error:
        _fail(str(error), 2)
    except (RunError, NumericalError) as error:
        _fail(str(error), 1)
    except KeyboardInterrupt:
        _fail("interrupted", 130)


def _fail(text: str, code: int) -> None:
    errors.print(f"fleet-seif: {text}", highlight=False, markup=False, soft_wrap=True)
    raise SystemExit(code)


@app.command()
@_clear_errors()
def scenarios() -> None:
    """List the scenarios that come with the package."""
    for name, description in shipped().items():
        console.print(f"[bold]{name}[/bold]  {description}", highlight=False, soft_wrap=True)


@app.command()
@_clear_errors()
def run(
    scenario: ScenarioArgument,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep report, map, readings and figure here.")] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
    virtual: Annotated[bool, typer.Option("--virtual", help="One process, virtual clock, in-memory network.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Run a scenario: one process per vehicle and one for fusion, over Zenoh on loopback."""
    chosen = load_scenario(scenario, tuple(settings or ()), seed)
    say = _nothing if quiet else _say
    if out is not None:
        output.prepare_folder(out)
    recording = record(chosen)
    warm_up(say)
    totals = {name: log.steps for name, log in recording.logs.items()}
    with progress_bars(console, totals, quiet) as progress:
        if virtual:
            finished = run_virtual(scenario, chosen, recording, progress)
            if out is not None:  # in a real run the fusion process writes it
                output.write_ledger(out / "process" / "ledger.bin", finished.ledger)
        else:
            again = [scenario, *(part for item in settings or () for part in ("--set", item))]
            again += ["--seed", str(chosen.run.seed)]
            finished = run_processes(scenario, again, chosen, recording, out, say, progress)
    outcome = evaluate(finished)
    if out is not None:
        say(f"writing {out}")
        write_folder(out, finished, outcome)
    if not quiet:
        console.print(report_table(outcome.report))
        if out is not None:
            say(f"figure: {out / 'figure.png'}   report: {out / 'report.json'}")


@app.command()
@_clear_errors()
def fusion(
    listen: Annotated[list[str] | None, typer.Option(help="Where to listen, e.g. tcp/127.0.0.1:7447.")] = None,
    fleet: FleetOption = None,
    expected: Annotated[int, typer.Option(min=0, help="End after so many vehicles have ended; 0: go on.")] = 0,
    scenario: Annotated[str | None, typer.Option(help="Take [fusion] and [link] settings from a scenario.")] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
    result: ResultOption = None,
    supervised: SupervisedOption = False,
) -> None:
    """Run one fusion node: host a Zenoh router, fold what vehicles publish, serve the joint map."""
    chosen = load_scenario(scenario or "three_air_vehicles", tuple(settings or ()), seed)
    children.run_fusion(
        fleet=fleet or (chosen.fleet.name if scenario else "fleet"),
        settings=chosen.fusion,
        link=chosen.link,
        seed=chosen.run.seed,
        listen=_endpoints(listen, config),
        config=config,
        insecure=insecure,
        expected=expected,
        result=result,
        say=_as_child(supervised)[0],
    )


@app.command()
@_clear_errors()
def vehicle(
    scenario: ScenarioArgument,
    name: Annotated[str, typer.Option(help="Which of the scenario's vehicles.")],
    connect: Annotated[list[str] | None, typer.Option(help="The fusion node, e.g. tcp/127.0.0.1:7447.")] = None,
    fleet: FleetOption = None,
    seed: SeedOption = None,
    settings: SetOption = None,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
    result: ResultOption = None,
    supervised: SupervisedOption = False,
) -> None:
    """Run one vehicle of a scenario against a fusion node."""
    say, wait_for_go = _as_child(supervised)
    overrides = [*(settings or ()), *([f"fleet.name='{fleet}'"] if fleet else [])]
    children.run_vehicle(
        load_scenario(scenario, tuple(overrides), seed),
        name=name,
        connect=_endpoints(connect, config),
        config=config,
        insecure=insecure,
        result=result,
        say=say,
        wait_for_go=wait_for_go,
    )


@app.command("watch")
@_clear_errors()
def watch_map(
    endpoint: Annotated[str | None, typer.Argument(help="A fusion node, tcp/127.0.0.1:7447 by default.")] = None,
    fleet: Annotated[str, typer.Option(help="Name of the fleet.", callback=_fleet_name)] = "fleet",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a map.")] = False,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
) -> None:
    """Show the joint map of a fleet as it grows."""
    endpoints = _endpoints([endpoint] if endpoint else None, config)
    asyncio.run(watch.watch(endpoints, fleet, as_json, config, insecure, console))


def _endpoints(given: list[str] | None, config: Path | None) -> list[str]:
    """What was asked for; the default only where no configuration file says it."""
    return given or ([] if config else [DEFAULT_ENDPOINT])


def _as_child(supervised: bool) -> tuple[children.Say, Callable[[], None]]:
    """How a process speaks, and how it waits for the others: for the launcher, or for a person."""
    children.end_on_sigterm()
    if supervised:
        return children.say_json, children.supervise()
    last: dict[str, Any] = {}

    def tell(event: dict[str, Any]) -> None:
        nonlocal last
        if event != last:
            last = event
            console.print("  ".join(f"{key}={value}" for key, value in event.items()), highlight=False, soft_wrap=True)

    return tell, lambda: None


def _say(text: str) -> None:
    console.print(text, highlight=False, soft_wrap=True)


def _nothing(text: str) -> None:
    pass


def main() -> None:
    """Entry point of the fleet-seif command."""
    logging.basicConfig(
        level=logging.WARNING, format="%(message)s", handlers=[RichHandler(console=errors, show_path=False)]
    )
    app()
