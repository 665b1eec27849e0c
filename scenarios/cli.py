"""The fleet-seif command. Exit code 2: asked wrongly; 1: the run failed; 130: interrupted."""

import asyncio
import contextlib
import json
import logging
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler

from fleet_seif.bus import open_bus
from fleet_seif.errors import NumericalError, RunError
from fleet_seif.messages import Action, check_name
from fleet_seif.warm_up import warm_up
from scenarios import chaos_runs, children, decisions, output, tools, watch
from scenarios.access import Kind
from scenarios.batch import STAGES
from scenarios.config import ScenarioError, load_scenario, shipped
from scenarios.evaluate import score_run, score_table, score_with_batch
from scenarios.experiments.names import EXPERIMENTS, find_experiment, run_experiment, summary_table
from scenarios.experiments.study import png_of, summary_of
from scenarios.launch import run_processes
from scenarios.progress import progress_bars
from scenarios.report import evaluate, write_folder
from scenarios.source import check_names, record
from scenarios.stored_run import read_run
from scenarios.table import report_table
from scenarios.virtual import run_virtual

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)
ledger = typer.Typer(no_args_is_help=True, help="Look after the store of a fusion node.")
app.add_typer(ledger, name="ledger")
console = Console()
errors = Console(stderr=True)


def _fleet_name(name: str | None) -> str | None:
    """The name, if it can be part of a key."""
    return None if name is None else _checked_name(name, "fleet")


def _node_name(name: str) -> str:
    return _checked_name(name, "node")


def _checked_name(name: str, what: str) -> str:
    try:
        return check_name(name, what)
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
NamedFleetOption = Annotated[str, typer.Option("--fleet", help="Name of the fleet.", callback=_fleet_name)]
EndpointsArgument = Annotated[list[str] | None, typer.Argument(help="Fusion nodes; tcp/127.0.0.1:7447 by default.")]
StoreOption = Annotated[Path | None, typer.Option(metavar="FILE", help="Where it keeps what it must not lose.")]
SigningKeyOption = Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Its private signing key.")]
KeyRingOption = Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Public keys of the fleet.")]
FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="The store of a fusion node.")]
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
    if chosen.fleet.nodes > 1 and not chosen.fusion.required_acks:
        names = list(chosen.fleet.node_names)  # no vehicle leaves before every node has all of it
        settings = [*(settings or ()), f"fusion.required_acks={names}"]
        chosen = load_scenario(scenario, tuple(settings), seed)
    check_names(chosen)
    say = _nothing if quiet else _say
    if out is not None:
        output.prepare_folder(out)
    recording = record(chosen)
    warm_up(say, frames=chosen.filter.frames, identities=chosen.filter.identities)
    totals = {name: log.steps for name, log in recording.logs.items()}
    with progress_bars(console, totals, quiet) as progress:
        if virtual:
            finished = run_virtual(scenario, chosen, recording, progress)
            if out is not None:  # in a real run the fusion process writes it
                output.write_ledger(out / "process" / "fusion.ledger", finished.ledger)
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
    connect: Annotated[list[str] | None, typer.Option(help="Other fusion nodes or hubs to link to.")] = None,
    name: Annotated[str, typer.Option(help="Name of this node.", callback=_node_name)] = "fusion",
    fleet: FleetOption = None,
    store: StoreOption = None,
    expected: Annotated[int, typer.Option(min=0, help="End after so many vehicles have ended; 0: go on.")] = 0,
    scenario: Annotated[str | None, typer.Option(help="Take [fusion] and [link] settings from a scenario.")] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
    signing_key: SigningKeyOption = None,
    key_ring: KeyRingOption = None,
    result: ResultOption = None,
    supervised: SupervisedOption = False,
) -> None:
    """Run one fusion node: host a Zenoh router, fold what vehicles publish, serve the joint map."""
    chosen = load_scenario(scenario or "three_air_vehicles", tuple(settings or ()), seed)
    say, supervision = _as_child(supervised)
    children.run_fusion(
        fleet=fleet or (chosen.fleet.name if scenario else "fleet"),
        name=name,
        settings=chosen.fusion,
        link=chosen.link,
        faults=chosen.faults,
        seed=chosen.run.seed,
        place=children.Place(
            listen=_endpoints(listen, config),
            connect=connect or [],
            config=config,
            insecure=insecure,
            store=store,
            result=result,
            signing_key=signing_key,
            key_ring=key_ring,
        ),
        expected=expected,
        say=say,
        supervision=supervision,
    )


@app.command()
@_clear_errors()
def hub(
    listen: Annotated[list[str] | None, typer.Option(help="Where to listen, e.g. tcp/127.0.0.1:7447.")] = None,
    connect: Annotated[list[str] | None, typer.Option(help="Fusion nodes or hubs to link to.")] = None,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
) -> None:
    """Run a Zenoh router alone: what fusion nodes host anyway, where a network needs one more."""
    children.end_on_sigterm()
    with open_bus(
        listen=_endpoints(listen, config), connect=connect or [], config=config, insecure=insecure, mode="router"
    ) as bus:
        _say(f"listening on {bus.endpoints()[0]}")
        threading.Event().wait()


@app.command()
@_clear_errors()
def vehicle(
    scenario: ScenarioArgument,
    name: Annotated[str, typer.Option(help="Which of the scenario's vehicles.")],
    connect: Annotated[list[str] | None, typer.Option(help="Fusion nodes, e.g. tcp/127.0.0.1:7447.")] = None,
    fleet: FleetOption = None,
    store: StoreOption = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Begin a new life though the store knows one.")] = False,
    life: Annotated[int, typer.Option(min=0, help="Number of the first life of a new store.")] = 0,
    seed: SeedOption = None,
    settings: SetOption = None,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
    signing_key: SigningKeyOption = None,
    key_ring: KeyRingOption = None,
    result: ResultOption = None,
    supervised: SupervisedOption = False,
) -> None:
    """Run one vehicle of a scenario against a fusion node."""
    say, supervision = _as_child(supervised)
    overrides = [*(settings or ()), *([f"fleet.name='{fleet}'"] if fleet else [])]
    children.run_vehicle(
        load_scenario(scenario, tuple(overrides), seed),
        name=name,
        place=children.Place(
            connect=_endpoints(connect, config),
            config=config,
            insecure=insecure,
            store=store,
            result=result,
            signing_key=signing_key,
            key_ring=key_ring,
        ),
        say=say,
        supervision=supervision,
        fresh=fresh,
        life=life,
    )


@app.command("watch")
@_clear_errors()
def watch_map(
    endpoint: EndpointsArgument = None,
    fleet: NamedFleetOption = "fleet",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a map.")] = False,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
    key_ring: KeyRingOption = None,
) -> None:
    """Show the joint map of a fleet as it grows."""
    source = watch.Source(_endpoints(endpoint, config), fleet, config, insecure, key_ring)
    asyncio.run(watch.watch(source, as_json, console))


@app.command()
@_clear_errors()
def status(
    endpoint: EndpointsArgument = None,
    fleet: NamedFleetOption = "fleet",
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
    key_ring: KeyRingOption = None,
) -> None:
    """Say once how every vehicle of a fleet is, and why one is quarantined."""
    source = watch.Source(_endpoints(endpoint, config), fleet, config, insecure, key_ring)
    tools.show_status(source, as_json, console)


ConnectOption = Annotated[list[str] | None, typer.Option(help="Fusion nodes; tcp/127.0.0.1:7447 by default.")]
OperatorOption = Annotated[str, typer.Option(help="Who decides; with --signing-key its name counts.")]
DownOption = Annotated[
    Path | None, typer.Option("--store", metavar="FILE", exists=True, dir_okay=False, help="Of a node that is down.")
]
LandmarkArgument = Annotated[
    str, typer.Argument(metavar="VEHICLE/LIFE/NUMBER", help="A landmark, as 'watch' names it.")
]


def _about_landmarks(decided: Action) -> Callable[..., None]:
    """A command that decides about two landmarks, and can undo that."""

    @_clear_errors()
    def command(
        one: LandmarkArgument,
        other: LandmarkArgument,
        undo: Annotated[bool, typer.Option("--undo", help="Leave it to what is seen again.")] = False,
        connect: ConnectOption = None,
        fleet: NamedFleetOption = "fleet",
        operator: OperatorOption = "operator",
        store: DownOption = None,
        config: ConfigOption = None,
        insecure: InsecureOption = False,
        signing_key: SigningKeyOption = None,
    ) -> None:
        action = Action.RELEASE if undo else decided
        desk = _desk(connect, fleet, operator, store, config, insecure, signing_key)
        decisions.decide(desk, decisions.about_landmarks(action, one, other), console)

    return command


MERGE_HELP = "Decide that two landmarks are one. Lasts until it is undone, on every node."
SPLIT_HELP = "Decide that two landmarks are two. Lasts until it is undone, on every node."
app.command("merge", help=MERGE_HELP)(_about_landmarks(Action.FORCE))
app.command("split", help=SPLIT_HELP)(_about_landmarks(Action.FORBID))


@app.command()
@_clear_errors()
def retract(
    vehicle: Annotated[str, typer.Argument(help="Its name.")],
    undo: Annotated[bool, typer.Option("--undo", help="Take it into the map again.")] = False,
    connect: ConnectOption = None,
    fleet: NamedFleetOption = "fleet",
    operator: OperatorOption = "operator",
    store: DownOption = None,
    config: ConfigOption = None,
    insecure: InsecureOption = False,
    signing_key: SigningKeyOption = None,
) -> None:
    """Leave all that a vehicle has said, and will say, out of the map; it is kept, and can come back."""
    action = Action.RESTORE if undo else Action.RETRACT
    desk = _desk(connect, fleet, operator, store, config, insecure, signing_key)
    decisions.decide(desk, decisions.about_vehicle(action, vehicle), console)


def _desk(
    connect: list[str] | None, fleet: str, operator: str, store: Path | None, config: Path | None, insecure: bool,
    signing_key: Path | None,
) -> decisions.Desk:  # fmt: skip
    return decisions.Desk(
        endpoints=_endpoints(connect, config), fleet=fleet, operator=_checked_name(operator, "operator"), store=store,
        signing_key=signing_key, config=config, insecure=insecure,
    )  # fmt: skip


@ledger.command()
@_clear_errors()
def info(file: FileArgument) -> None:
    """Say what a store holds."""
    tools.ledger_info(file, console)


@ledger.command()
@_clear_errors()
def merges(file: FileArgument) -> None:
    """Say which landmarks of different vehicles were compared by place, and why some were kept apart."""
    tools.ledger_merges(file, console)


@ledger.command()
@_clear_errors()
def verify(file: FileArgument, key_ring: KeyRingOption = None) -> None:
    """Check a store: the file, every message in it (with --key-ring its signature), and the verdicts."""
    tools.ledger_verify(file, key_ring, console)


@ledger.command()
@_clear_errors()
def compact(file: FileArgument, signing_key: SigningKeyOption = None) -> None:
    """Replace single messages by snapshots, and give back the space. The node must not be running."""
    tools.ledger_compact(file, signing_key, console)


@app.command()
@_clear_errors()
def keys(
    folder: Annotated[Path, typer.Argument(metavar="DIR", file_okay=False, help="Keep them here; made before: add.")],
    fleet: NamedFleetOption = "fleet",
    node: Annotated[list[str] | None, typer.Option(help="A fusion node; each with an --endpoint.")] = None,
    endpoint: Annotated[
        list[str] | None, typer.Option(metavar="tls/HOST:PORT", help="Where others reach the --node of the same place.")
    ] = None,
    host: Annotated[list[str] | None, typer.Option(help="A further name or address of these nodes.")] = None,
    vehicle: Annotated[list[str] | None, typer.Option(help="A vehicle.")] = None,
    operator: Annotated[list[str] | None, typer.Option(help="Who decides about vehicles.")] = None,
    viewer: Annotated[list[str] | None, typer.Option(help="Who looks at maps.")] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="How long certificates are valid.")] = 365,
    renew: Annotated[bool, typer.Option("--renew", help="New keys for those named; the old are void.")] = False,
) -> None:
    """Make certificates, signing keys and Zenoh configurations for a fleet, or for more of its members."""
    named = {Kind.VEHICLE: vehicle or [], Kind.OPERATOR: operator or [], Kind.VIEWER: viewer or []}
    members = tools.members_of(node or [], endpoint or [], host or [], named)
    tools.make_fleet_keys(folder, fleet, members, days, renew, console)


@app.command("chaos")
@_clear_errors()
def run_chaos(
    scenario: ScenarioArgument,
    seeds: Annotated[str, typer.Option(metavar="A..B", help="Seeds of the faults.")] = "1..100",
    settings: SetOption = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes to spread them over.")] = 1,
    every_boundary: Annotated[
        bool, typer.Option("--every-boundary", help="Kill before every effect of every schedule in turn.")
    ] = False,
    schedule: Annotated[str | None, typer.Option(metavar="JSON", help="Run this schedule instead.")] = None,
) -> None:
    """Run a scenario many times in one process each, with faults drawn from seeds, and demand the same map."""
    chosen = load_scenario(scenario, tuple(settings or ()))
    chaos_runs.seed_range(seeds)
    warm_up(_say, frames=chosen.filter.frames, identities=chosen.filter.identities)
    if schedule is not None:
        tally = chaos_runs.Arena(chosen).run(chaos_runs.read_schedule(schedule))
    else:
        tally = chaos_runs.run_seeds(chosen, chaos_runs.seed_range(seeds), jobs, _say, every_boundary=every_boundary)
    for seed, reason, least in tally.failures:
        _say(f"seed {seed}: {reason}\nthe least that fails: fleet-seif chaos {scenario} --schedule '{least}'")
    _say(
        f"{tally.seeds} runs, {tally.kills} kills, {tally.boundaries} effects, {tally.virtual_s:.0f} virtual s: "
        f"{len(tally.failures)} failed"
    )
    if tally.failures:
        raise RunError("something that must always hold did not")


@app.command()
@_clear_errors()
def experiment(
    name: Annotated[str, typer.Argument(help=f"One of {', '.join(EXPERIMENTS)}.")],
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep figure, CSV and summary here; ./NAME.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first world; the others follow.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer worlds and steps: to try it, not to compare.")] = False,
) -> None:
    """Run an experiment of the SEIF paper: a figure, a CSV, and a summary that sets the paper's numbers beside ours."""
    chosen = find_experiment(name)
    folder = Path(name) if out is None else out
    warm_up(_say)
    with progress_bars(console, {f"{name}, %": 100}, quiet=False) as progress:
        rows = run_experiment(
            chosen, folder, seed, quick, lambda done, total: progress(f"{name}, %", 100 * done // total, 100)
        )
    console.print(summary_table(chosen, rows, quick))
    _say(f"figure: {png_of(folder, name)}   summary: {summary_of(folder)}")


@app.command("evaluate")
@_clear_errors()
def evaluate_run(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="What 'run SCENARIO --out DIR' has left.")],
    batch: Annotated[bool, typer.Option("--batch", help="Set gtsam's batch over all readings beside it.")] = False,
    robust: Annotated[bool, typer.Option("--robust", help="The same, robust: for recorded data.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Score a finished run against the truth: errors of maps and poses, NEES with its band, bytes a step."""
    stored = read_run(folder)
    if batch or robust:
        with progress_bars(errors, STAGES, quiet=False) as progress:
            scored = score_with_batch(stored, robust=robust, progress=progress)
    else:
        scored = score_run(stored)
    if as_json:
        console.print_json(json.dumps(scored, allow_nan=False))
    else:
        console.print(score_table(scored))


def _endpoints(given: list[str] | None, config: Path | None) -> list[str]:
    """What was asked for; the default only where no configuration file says it."""
    return given or ([] if config else [DEFAULT_ENDPOINT])


def _as_child(supervised: bool) -> tuple[children.Say, children.Supervision]:
    """How a process speaks, and how it waits for the others: for the launcher, or for a person."""
    children.end_on_sigterm()
    if supervised:
        return children.say_json, children.Supervision()
    last: dict[str, Any] = {}

    def tell(event: dict[str, Any]) -> None:
        nonlocal last
        if event != last:
            last = event
            console.print("  ".join(f"{key}={value}" for key, value in event.items()), highlight=False, soft_wrap=True)

    return tell, children.Supervision(alone=True)


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
