"""Routes of three vehicles that meet as in Fig. 17 of Thrun et al. (IJRR 2004).

Vehicle 1 has the upper half of the square, 0 the lower left quarter, 2 the lower right one. Their pens are more than
twice the sensor's range apart until 0 and then 2 fly out to meet 1 (rule 4 of `routes`).
"""

import math
from dataclasses import dataclass

import numpy as np

from fleet_seif.records import Floats
from scenarios.routes import WALL_M, Area, Craft, Mask, Walker, as_routes, draw_start, first_shared_step, roam

FIRST_MEETING = range(62, 65)
"""Steps at which vehicles 0 and 1 may first share a landmark."""
SECOND_MEETING = range(85, 90)
"""Steps at which vehicles 1 and 2 may; vehicles 0 and 2 share none before."""
HOSTS_MAX = 5
"""Routes tried for the vehicle that the others meet."""
VISITS_MAX = 200
"""Routes tried for each visitor of one such route."""


@dataclass(frozen=True, kw_only=True)
class Visit:
    """How a visitor keeps to itself in `home`, then flies out into `column` to meet the host at one of the steps."""

    home: Area
    column: Area
    steps: range


def reachable(pen: Area, landmarks: Floats, craft: Craft) -> Mask:
    """Which landmarks can be sighted from within a pen, whose corners the turning circle cuts."""
    cut_m = (math.sqrt(2.0) - 1.0) * craft.radius_m
    return pen.distance(landmarks) <= craft.range_max_m - cut_m


def try_visit(host: Walker, visit: Visit, rng: np.random.Generator) -> Walker | None:
    """A visitor's way up to the end of the second meeting; None if it met the host at another step than it should.

    The start is random, and so is the departure: at most the time it takes to turn round and cross the home earlier.
    """
    craft, landmarks = host.craft, host.landmarks
    crossing_m = visit.home.y_max - visit.home.y_min + math.pi * craft.radius_m
    lead = math.ceil(crossing_m / craft.step_m)
    departure = int(rng.integers(max(visit.steps.start - lead, 0), visit.steps.stop))
    walker = Walker(craft, landmarks, draw_start(visit.home, visit.home, craft, rng))
    at_home = reachable(visit.home, landmarks, craft)
    walker.fly(visit.home, at_home, departure)
    walker.fly(
        visit.column, reachable(visit.column, landmarks, craft) & (host.first_seen <= departure), visit.steps[-1]
    )
    if first_shared_step(walker.first_seen, host.first_seen) not in visit.steps:
        return None
    walker.fly(visit.column, at_home, host.step)
    return walker


def find_visit(host: Walker, visit: Visit, rng: np.random.Generator) -> Walker | None:
    """The first of VISITS_MAX tries that meets the host when it should, if any."""
    tries = (try_visit(host, visit, rng) for _ in range(VISITS_MAX))
    return next((walker for walker in tries if walker is not None), None)


def meeting_walkers(
    craft: Craft, landmarks: Floats, pen: Area, visits: list[Visit], rng: np.random.Generator
) -> list[Walker]:
    """The host in its pen, then its visitors, all of them up to the end of the second meeting."""
    wanted = reachable(pen, landmarks, craft)
    for _ in range(HOSTS_MAX):
        host = Walker(craft, landmarks, draw_start(pen, pen, craft, rng))
        host.fly(pen, wanted, SECOND_MEETING[-1])
        visitors: list[Walker] = []
        for visit in visits:
            visitor = find_visit(host, visit, rng)
            if visitor is None:
                break
            visitors.append(visitor)
        else:
            return [host, *visitors]
    raise ValueError(
        f"no routes meet at steps {FIRST_MEETING} and {SECOND_MEETING} after {HOSTS_MAX} x {VISITS_MAX} attempts; "
        f"have {len(landmarks)} landmarks, remedy: more landmarks, another seed, or coverage routes"
    )


def meeting_routes(craft: Craft, landmarks: Floats, side_m: float, steps: int, rng: np.random.Generator) -> Floats:
    """Routes (3, steps + 1, 3) on which the three vehicles first share landmarks in FIRST_MEETING, SECOND_MEETING.

    Each explores what it can sight without leaving its pen. The pens are two sensor ranges apart, until vehicle 0
    and later vehicle 2 flies up to where vehicle 1 has been; after both meetings all of them roam.

    Raises ValueError if the square is too small for three pens, or the steps end before the second meeting does.
    """
    near, half = side_m / 2.0 - craft.range_max_m, side_m / 2.0
    far = side_m - near
    if near < 2.0 * (craft.radius_m + WALL_M):
        raise ValueError(
            f"a square of side {side_m:.3f} m leaves {near:.3f} m for a pen, below the turning circle's "
            f"{2.0 * craft.radius_m:.3f} m; remedy: a larger side_m or turn_max_rad, or coverage routes"
        )
    if steps < SECOND_MEETING[-1]:
        raise ValueError(f"{steps} steps end before the meetings do; remedy: at least {SECOND_MEETING[-1]} steps")
    low, high = WALL_M, side_m - WALL_M
    left = Area(x_min=low, x_max=near, y_min=low, y_max=high)
    right = Area(x_min=far, x_max=high, y_min=low, y_max=high)
    top = Area(x_min=low, x_max=high, y_min=far, y_max=high)
    visits = [
        Visit(home=Area(x_min=low, x_max=near, y_min=low, y_max=near), column=left, steps=FIRST_MEETING),
        Visit(home=Area(x_min=far, x_max=high, y_min=low, y_max=near), column=right, steps=SECOND_MEETING),
    ]
    host, first, second = meeting_walkers(craft, landmarks, top, visits, rng)
    square = Area(x_min=low, x_max=high, y_min=low, y_max=high)
    roam(first, Area(x_min=0.0, x_max=half, y_min=0.0, y_max=half), square, steps)
    roam(host, Area(x_min=0.0, x_max=side_m, y_min=half, y_max=side_m), square, steps)
    roam(second, Area(x_min=half, x_max=side_m, y_min=0.0, y_max=half), square, steps)
    return as_routes([first, host, second])
