"""The vehicle: a SEIF on its own odometry and sightings, publishing what it learned."""

from vehicles.vehicle import Vehicle, open_store

__all__ = ["Vehicle", "open_store"]
