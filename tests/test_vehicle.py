"""The vehicle for one's own robot: alone, connected, and refusing bad readings."""

import threading

import numpy as np
import pytest
from numpy.typing import ArrayLike

from fleet_seif.bus import open_bus
from fleet_seif.config import FusionSettings, PublishSettings
from fleet_seif.errors import ReadingRefused
from fleet_seif.records import Sightings
from fusion.core import FusionCore
from fusion.ledger import Ledger, Receipt
from fusion.service import FusionService
from tests.conftest import Network
from tests.drives import put
from vehicles import Vehicle

COV = np.diag([1e-4, 1e-8, 1e-4])


def sighting(range_m: float = 1.0, bearing_rad: float = 0.0, signature: int = 0) -> Sightings:
    return Sightings(
        z=np.array([[range_m, bearing_rad]]), cov=np.array([1e-4 * np.eye(2)]), signature=np.array([signature])
    )


def test_a_vehicle_maps_alone() -> None:
    with Vehicle("mine", start_pose=(1.0, 2.0, np.pi / 2)) as vehicle:
        for k in range(1, 11):
            vehicle.step((0.1, 0.0, 0.0), COV, sighting(2.0 - 0.1 * k))
    assert vehicle.pose == pytest.approx([1.0, 3.0, np.pi / 2], abs=1e-6)
    assert vehicle.landmarks[0] == pytest.approx([1.0, 4.0], abs=1e-6)
    assert vehicle.signatures == [0]


def test_late_and_repeated_readings_are_refused_with_the_reason_and_change_nothing() -> None:
    vehicle = Vehicle("mine")
    vehicle.step((0.1, 0, 0), COV, sighting(), time_s=5.0)
    before = vehicle.pose
    for time_s in (5.0, 4.9, float("nan")):
        with pytest.raises(ReadingRefused, match="time"):
            vehicle.step((0.1, 0, 0), COV, time_s=time_s)
    assert np.array_equal(vehicle.pose, before)
    assert vehicle.counters.readings_refused == 3
    vehicle.step((0.1, 0, 0), COV, time_s=5.1)


@pytest.mark.parametrize(
    ("odometry", "cov", "sightings", "word"),
    [
        ((np.nan, 0, 0), COV, None, "finite"),
        ((0, 0, 0), np.diag([1e-4, 0.0, 1e-4]), None, "odometry_cov"),
        ((0, 0, 0), COV, sighting(np.inf), "finite"),
        ((0, 0, 0), COV, sighting(signature=-1), 'filter.identities = "associated"'),
    ],
)
def test_bad_readings_are_refused_by_name(
    odometry: tuple[float, float, float], cov: np.ndarray, sightings: Sightings | None, word: str
) -> None:
    vehicle = Vehicle("mine")
    vehicle.start(sighting())
    with pytest.raises(ReadingRefused, match=word):
        vehicle.step(odometry, cov, sightings)
    assert np.array_equal(vehicle.pose, [0, 0, 0])


def test_nothing_follows_the_end() -> None:
    vehicle = Vehicle("mine")
    vehicle.start(time_s=0.0)
    vehicle.end()
    with pytest.raises(ReadingRefused, match="ended"):
        vehicle.step((0, 0, 0), COV, time_s=1.0)


@pytest.mark.parametrize("name", ["", "a/b", "x" * 33, "*", "ü"])
def test_names_that_cannot_be_keys_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="characters"):
        Vehicle(name)


def test_a_vehicle_that_nobody_hears_keeps_a_bounded_outbox() -> None:
    vehicle = Vehicle("mine", publish=PublishSettings(outbox_max=16))
    for k in range(200):
        vehicle.step((0.01, 0, 0), COV, sighting(), time_s=float(k))
    assert len(vehicle._core.outbox._unsent) <= 17


def test_a_connected_vehicle_is_fused_and_acknowledged(network: Network) -> None:
    core = FusionCore("fleet", "node", FusionSettings(), expected=1)
    service = FusionService(network.bus, core, FusionSettings(map_s=0.02))
    fusing = threading.Thread(target=service.run)
    fusing.start()
    with open_bus(connect=[network.endpoint]) as bus, Vehicle("mine", bus=bus, start_pose=(1, 1, 0)) as vehicle:
        for k in range(1, 51):
            vehicle.step((0.01, 0, 0), COV, sighting(2.0 - 0.01 * k), time_s=float(k))
        vehicle.end()
        assert vehicle.wait_until_acknowledged(20.0)
    fusing.join()
    final = service.newest
    assert final.final
    assert final.landmark_mean[0] == pytest.approx([3.0, 1.0], abs=1e-3)
    assert final.pose_mean[0] == pytest.approx(vehicle.pose, abs=1e-6)


@pytest.mark.parametrize(
    ("pose", "cov"),
    [
        ((np.nan, 0, 0), None),
        ((0, 0), None),
        ((0, 0, 0), np.ones((3, 3))),
        ((0, 0, 0), [[25, 15, 0], [15, 9, 0], [0, 0, 1]]),
        ((0, 0, 0), np.eye(2)),
    ],
)
def test_start_poses_that_no_node_could_use_are_refused(pose: tuple[float, ...], cov: ArrayLike | None) -> None:
    with pytest.raises(ValueError, match="start_pose"):
        Vehicle("mine", start_pose=pose, start_pose_cov=cov)


def test_whatever_numbers_a_vehicle_takes_a_node_can_read() -> None:
    vehicle = Vehicle("mine", start_pose=(1, 2, 0), start_pose_cov=np.diag([1, 2, 3]) * 1e-3)
    seen = Sightings(z=np.array([[2, 0]]), cov=np.array([np.eye(2)]), signature=np.array([3], np.int32))
    vehicle.start(seen, time_s=0)
    for time_s in (1, np.int64(2), np.float32(3.5)):
        vehicle.step([1, 0, 0], np.eye(3), seen, time_s=time_s)  # type: ignore[arg-type]
    ledger = Ledger("fleet")
    for data in put(vehicle._core):
        assert ledger.accept(data)[0] is Receipt.FOLDED


def test_signatures_that_are_not_integers_are_refused() -> None:
    seen = Sightings(z=np.array([[2.0, 0]]), cov=np.array([np.eye(2)]), signature=np.array([3.0]))
    with pytest.raises(ReadingRefused, match="integers"):
        Vehicle("mine").start(seen, time_s=0.0)


def test_a_sighting_too_sharp_for_the_fixed_point_is_refused_and_the_vehicle_stays_healthy() -> None:
    vehicle = Vehicle("mine")
    sharp = Sightings(z=np.array([[2.0, 0]]), cov=np.array([1e-11 * np.eye(2)]), signature=np.array([3]))
    with pytest.raises(ReadingRefused, match="quanta"):
        vehicle.step((0.1, 0, 0), COV, sharp)
    vehicle.step((0.1, 0, 0), COV, sighting())
    assert vehicle._core.healthy
