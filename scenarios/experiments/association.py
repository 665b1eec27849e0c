"""How far the likelihood of a sighting is off when the covariance comes from a Markov blanket (eq. 54, 55).

A filter that has to guess which landmark it sees needs p(z | landmark) = N(z - h; 0, S), S = J Sigma J' + Z, with the
joint covariance Sigma of pose and landmark. The SEIF paper takes Sigma from the neighbourhood of both alone.
"""

from typing import Final

import numpy as np

from fleet_seif.config import FilterSettings
from fleet_seif.jit import one_thread
from fleet_seif.models import innovation, move, sight
from fleet_seif.records import Floats, Reading
from fleet_seif.seif import Seif
from scenarios.experiments.worlds import World

EVERY_STEPS: Final = 10
"""Steps between those whose sightings are looked at: the exact covariance is a dense inverse."""


@one_thread
def likelihood_errors(settings: FilterSettings, world: World) -> Floats:
    """|p_blanket - p_exact| / p_exact of sightings of known landmarks along a drive, (s,)."""
    filter = Seif(settings, world.model)
    filter.start(world.log.sightings_at(0))
    errors: list[float] = []
    for k, reading in enumerate(world.log.readings()):
        if k % EVERY_STEPS == 0:
            errors += _errors_of_step(filter, world.model, reading)
        filter.step(reading)
    return np.array(errors)


def _errors_of_step(filter: Seif, model: int, reading: Reading) -> list[float]:
    """Of the sightings of a reading that the filter has not seen yet."""
    number_of = {signature: number for number, signature in enumerate(filter.signatures)}
    known = [(number_of[s], i) for i, s in enumerate(reading.sightings.signature.tolist()) if s in number_of]
    exact = filter.covariance_of([number for number, _ in known])
    landmarks = filter.landmarks
    x, J_new_x, J_new_u = move(model, filter.pose, reading.odometry)
    F = np.eye(5)
    F[:3, :3] = J_new_x
    U = np.zeros((5, 5))
    U[:3, :3] = J_new_u @ reading.odometry_cov @ J_new_u.T
    errors = []
    for k, (number, i) in enumerate(known):
        h, J_z_x, J_z_y = sight(model, x, landmarks[number])
        r, J = innovation(model, reading.sightings.z[i], h), np.hstack([J_z_x, J_z_y])
        rows = [0, 1, 2, 3 + 2 * k, 4 + 2 * k]
        likelihoods = [
            gaussian(r, J @ (F @ Sigma @ F.T + U) @ J.T + reading.sightings.cov[i])
            for Sigma in (exact[np.ix_(rows, rows)], filter.blanket_covariance([number]))
        ]
        errors.append(abs(likelihoods[1] / likelihoods[0] - 1.0))
    return errors


def gaussian(r: Floats, S: Floats) -> float:
    """N(r; 0, S) in two dimensions."""
    return float(np.exp(-0.5 * r @ np.linalg.solve(S, r)) / (2.0 * np.pi * np.sqrt(np.linalg.det(S))))
