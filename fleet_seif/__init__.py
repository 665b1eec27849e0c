"""Multi-robot distributed SLAM: a sparse extended information filter per vehicle, additive fusion over Zenoh."""

from importlib.metadata import version as _version

from fleet_seif.client import FleetClient, connect
from fleet_seif.messages import JointMap, VehicleState
from fleet_seif.records import Reading, Sightings

__version__ = _version("fleet-seif")
__all__ = ["FleetClient", "JointMap", "Reading", "Sightings", "VehicleState", "__version__", "connect"]
