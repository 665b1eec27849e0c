"""The peer: iSAM2 is fed the same readings, so on mild noise its map is that of our filters."""

import numpy as np
import pytest

from fleet_seif.config import FilterSettings
from fleet_seif.ekf import Ekf
from fleet_seif.errors import NumericalError, RunError
from fleet_seif.geometry import act_inverse
from fleet_seif.records import Reading, Sightings
from scenarios.experiments import isam2
from tests import reference
from tests.drives import drive, landmark_of, reading, square

SETTINGS = FilterSettings(gate=1e300)


def test_without_gtsam_it_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(isam2, "import_module", missing)
    assert not isam2.is_installed()
    with pytest.raises(RunError, match=r"pip install 'fleet-seif\[bench\]'"):
        isam2.Isam2(1e6)


def test_on_mild_noise_its_map_is_that_of_the_ekf_and_the_truth() -> None:
    pytest.importorskip("gtsam")
    truth = square(12, 4.0, 1)
    log = drive(truth, steps=200, seed=2)
    ekf, peer = Ekf(SETTINGS), isam2.Isam2(SETTINGS.start_information)
    ekf.start(log.start)
    peer.start(log.start)
    for each in log.readings:
        ekf.step(each)
        peer.step(each)
    assert peer.signatures == ekf.signatures
    assert peer.bytes_used() > 8 * 3 * 200
    in_frame = np.array([act_inverse(log.start_pose, truth[landmark_of(s)]) for s in peer.signatures])
    sigma = np.sqrt(np.diag(ekf.covariance_of(range(12))))
    assert np.max(np.abs(peer.landmarks - ekf.landmarks).ravel() / sigma[3:]) < 1.0
    assert np.max(np.abs(peer.landmarks - in_frame).ravel() / sigma[3:]) < 4.0
    difference = peer.pose - ekf.pose
    difference[2] = reference.difference(0, np.zeros(2), np.array([0.0, -difference[2]]))[1]
    assert np.max(np.abs(difference) / sigma[:3]) < 1.0


def test_its_covariances_are_those_of_the_ekf() -> None:
    """A motion and the first sighting of a landmark, with noise that is far from round, on one linearisation."""
    pytest.importorskip("gtsam")
    U = np.array([[4e-4, 1e-5, 0.0], [1e-5, 1e-6, 2e-6], [0.0, 2e-6, 9e-4]])
    Z = np.array([[[4e-4, 1e-4], [1e-4, 1e-4]]])
    seen = Sightings(z=np.array([[1.0, 0.7]]), cov=Z, signature=np.array([7]))
    ekf, peer = Ekf(SETTINGS), isam2.Isam2(SETTINGS.start_information)
    for each in (ekf, peer):
        each.start(Sightings.none())
        each.step(Reading(time_s=0.1, odometry=np.array([0.3, 0.1, 1.2]), odometry_cov=U, sightings=seen))
    P = ekf.covariance_of([0])
    J_tangent_x = np.eye(3)
    J_tangent_x[:2, :2] = reference.rotation(1.2).T
    np.testing.assert_allclose(peer.pose, ekf.pose, atol=1e-9)
    of_pose, of_landmark = (peer._isam.marginalCovariance(key) for key in (peer._at(1), peer._landmark(0)))
    np.testing.assert_allclose(of_pose, J_tangent_x @ P[:3, :3] @ J_tangent_x.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(of_landmark, P[3:, 3:], rtol=1e-6, atol=1e-12)


def test_where_isam2_gives_up_it_says_so() -> None:
    pytest.importorskip("gtsam")
    peer = isam2.Isam2(SETTINGS.start_information)
    peer.start(Sightings.none())
    peer._isam = BrokenIsam()
    with pytest.raises(NumericalError, match="gave up at step 1: indeterminate"):
        peer.step(reading(0.1, Sightings.none()))


class BrokenIsam:
    """Fails as gtsam does."""

    def update(self, factors: object, values: object) -> None:
        raise RuntimeError("indeterminate linear system\n")
