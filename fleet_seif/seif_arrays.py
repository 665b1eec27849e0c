"""Where a filter keeps its numbers: address space reserved for the largest map, used as the map grows.

1. Two flat buffers, one of floats and one of integers, are all that crosses into a kernel; `arrays` shows them as the
   named arrays of `SeifArrays`. Both begin as zeros, so that 0 has to mean "none" everywhere.
2. They are reserved once for `landmarks_max` landmarks and become memory page by page as they are touched: no step
   copies the map. Only where landmarks have more than LINKS_EACH links each on average does a larger reserve
   take over what is used.
3. The links of a landmark are a list threaded through the links themselves: no landmark owns space for neighbours
   that it does not have.
"""

import mmap
import sys
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints

LANDMARKS: Final = 0
LINKS: Final = 1
ACTIVE: Final = 2
DEGREE_MAX: Final = 3
QUEUED: Final = 4
QUEUE_FIRST: Final = 5
QUEUE_LAST: Final = 6
COUNTS: Final = 8

LINKS_EACH: Final = 32
"""Links a landmark that are reserved; twice as many neighbours."""
HEAD: Final = 2


class SeifArrays(NamedTuple):
    """The filter's state. N, E are capacities for landmarks and links.

    counts: how much of each is used, and the queue, indexed by LANDMARKS ... QUEUE_LAST.
    mu_x (3,), b_x (3,), H_xx (3, 3); active (N,) ascending; H_xa (N, 3, 2) in the order of `active`.
    mu_y (N, 2), b_y (N, 2), H_yy (N, 2, 2).
    H_link (E, 2, 2): rows of the lower landmark, columns of the higher; ends (E, 2): these two.
    first (N,), following (E, 2): the half links of a landmark, 1 + 2 e + side, side 0 at the lower end; 0 ends a list.
    degree (N,): neighbours. refusals (N,): in a row.
    queue (N,): 1 + the next landmark whose mean waits to be relaxed, 1 + itself for the last; 0 for none.
    q_*: the same quantities as last published, in quanta. local (N,): scratch, zeros between steps.
    """

    counts: Ints
    active: Ints
    degree: Ints
    first: Ints
    refusals: Ints
    queue: Ints
    local: Ints
    ends: Ints
    following: Ints
    q_b_x: Ints
    q_xx: Ints
    q_xa: Ints
    q_b_y: Ints
    q_yy: Ints
    q_link: Ints
    mu_x: Floats
    b_x: Floats
    H_xx: Floats
    H_xa: Floats
    mu_y: Floats
    b_y: Floats
    H_yy: Floats
    H_link: Floats


@kernel
def arrays(floats: Floats, ints: Ints) -> SeifArrays:
    """The named arrays in two buffers; ints[:2] are the capacities N and E."""
    N, E = ints[0], ints[1]
    i = HEAD
    counts = ints[i : i + COUNTS]
    i += COUNTS
    q_b_x = ints[i : i + 3]
    i += 3
    q_xx = ints[i : i + 9].reshape(3, 3)
    i += 9
    active = ints[i : i + N]
    i += N
    degree = ints[i : i + N]
    i += N
    first = ints[i : i + N]
    i += N
    refusals = ints[i : i + N]
    i += N
    queue = ints[i : i + N]
    i += N
    local = ints[i : i + N]
    i += N
    q_b_y = ints[i : i + 2 * N].reshape(N, 2)
    i += 2 * N
    q_yy = ints[i : i + 4 * N].reshape(N, 2, 2)
    i += 4 * N
    q_xa = ints[i : i + 6 * N].reshape(N, 3, 2)
    i += 6 * N
    ends = ints[i : i + 2 * E].reshape(E, 2)
    i += 2 * E
    following = ints[i : i + 2 * E].reshape(E, 2)
    i += 2 * E
    q_link = ints[i : i + 4 * E].reshape(E, 2, 2)
    f = 15
    mu_x, b_x, H_xx = floats[:3], floats[3:6], floats[6:15].reshape(3, 3)
    mu_y = floats[f : f + 2 * N].reshape(N, 2)
    f += 2 * N
    b_y = floats[f : f + 2 * N].reshape(N, 2)
    f += 2 * N
    H_yy = floats[f : f + 4 * N].reshape(N, 2, 2)
    f += 4 * N
    H_xa = floats[f : f + 6 * N].reshape(N, 3, 2)
    f += 6 * N
    H_link = floats[f : f + 4 * E].reshape(E, 2, 2)
    return SeifArrays(
        counts, active, degree, first, refusals, queue, local, ends, following, q_b_x, q_xx, q_xa, q_b_y, q_yy, q_link,
        mu_x, b_x, H_xx, H_xa, mu_y, b_y, H_yy, H_link,
    )  # fmt: skip


def reserve(landmarks: int, links: int) -> tuple[Floats, Ints]:
    """Two buffers of zeros for so many landmarks and links, which take no memory before they are used."""
    sizes = 15 + 14 * landmarks + 4 * links, HEAD + COUNTS + 12 + 18 * landmarks + 8 * links
    floats = np.frombuffer(_pages(8 * sizes[0]), np.float64)
    ints = np.frombuffer(_pages(8 * sizes[1]), np.int64)
    ints[0], ints[1] = landmarks, links
    return floats, ints


def _pages(size: int) -> mmap.mmap:
    """Address space that becomes memory when touched; without large pages, of which every array would take one."""
    if sys.platform == "win32":
        return mmap.mmap(-1, size)
    no_reserve = 0x4000 if sys.platform == "linux" else 0  # MAP_NORESERVE: the mmap module names it from 3.13 on
    return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | no_reserve)


def used(s: SeifArrays) -> dict[str, Any]:
    """The part of each array that holds something, by name; `local` is scratch."""
    n, links, active = (int(s.counts[k]) for k in (LANDMARKS, LINKS, ACTIVE))
    by = {"active": active, "H_xa": active, "q_xa": active}
    by |= dict.fromkeys(("ends", "following", "q_link", "H_link"), links)
    whole = ("counts", "q_b_x", "q_xx", "mu_x", "b_x", "H_xx")
    return {
        name: array if name in whole else array[: by.get(name, n)]
        for name, array in s._asdict().items()
        if name != "local"
    }


def put_back(s: SeifArrays, parts: Mapping[str, Any]) -> None:
    """Fill empty arrays with what `used` gave. Raises ValueError or KeyError where it does not fit."""
    for name, target in s._asdict().items():
        if name != "local":
            part = parts[name]
            target[: len(part)] = part
