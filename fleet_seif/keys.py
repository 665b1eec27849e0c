"""Where things are on the bus: `fleet_seif/2/<fleet>/...`."""

from fleet_seif.messages import check_name

ROOT = "fleet_seif/2"


class Keys:
    """Keys of one fleet. Raises ValueError for a name that cannot be part of a key."""

    def __init__(self, fleet: str) -> None:
        self._stem = f"{ROOT}/{check_name(fleet, 'fleet')}"

    def deltas(self, vehicle: str) -> str:
        """Deltas are put here; `*` for all vehicles."""
        return f"{self._stem}/vehicle/{vehicle}/delta"

    def heartbeats(self, vehicle: str) -> str:
        return f"{self._stem}/vehicle/{vehicle}/heartbeat"

    def outbox(self, vehicle: str) -> str:
        """Answers range queries."""
        return f"{self._stem}/vehicle/{vehicle}/outbox"

    def alive(self, vehicle: str) -> str:
        """Liveliness token."""
        return f"{self._stem}/vehicle/{vehicle}/alive"

    def acks(self, vehicle: str) -> str:
        """Acknowledgements for a vehicle are put here."""
        return f"{self._stem}/vehicle/{vehicle}/ack"

    def ledger(self, vehicle: str) -> str:
        """Fusion nodes answer range queries here too; `*` for all vehicles."""
        return f"{self._stem}/vehicle/{vehicle}/ledger"

    def node_alive(self, node: str) -> str:
        """Liveliness token of a fusion node; `*` for all."""
        return f"{self._stem}/node/{node}/alive"

    def status(self, node: str) -> str:
        """Fusion nodes tell each other here how far they are."""
        return f"{self._stem}/node/{node}/status"

    def events(self, node: str) -> str:
        """Answers with the operator events and the evidence that a node holds."""
        return f"{self._stem}/node/{node}/events"

    def decisions(self, node: str) -> str:
        """Takes the decision of an operator, and answers what became of it."""
        return f"{self._stem}/node/{node}/decide"

    def map(self, node: str) -> str:
        """A node's maps are put here in pieces, and queried whole; `*` for all nodes."""
        return f"{self._stem}/node/{node}/map"

    def merges(self, node: str) -> str:
        """What a node says of its merges is put here, and queried; `*` for all nodes."""
        return f"{self._stem}/node/{node}/merges"


def vehicle_of(key: str) -> str:
    """The vehicle in a key that names one, "" otherwise."""
    return _named(key, "vehicle")


def node_of(key: str) -> str:
    """The fusion node in a key that names one, "" otherwise."""
    return _named(key, "node")


def _named(key: str, kind: str) -> str:
    parts = key.split("/")
    return parts[4] if len(parts) > 4 and parts[3] == kind else ""
