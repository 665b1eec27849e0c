"""Bytes of what a fusion node says of its merges; FORMAT.md is the specification. Readers raise WireError."""

from typing import Any, Final

from fleet_seif.envelope import (
    ENTRIES_MAX,
    KIND_MERGES,
    SEQUENCE_MAX,
    bool_of,
    digest_of,
    fields_of,
    float_of,
    int_of,
    items_of,
    landmark_name_of,
    name_of,
    seal,
    text_of,
    unseal,
)
from fleet_seif.errors import WireError
from fleet_seif.joint_records import Classes
from fleet_seif.merge_records import DIFFERING_MAX, NEAREST_MAX, Differing, KeptApart, MergeReport, Reason
from fleet_seif.messages import LandmarkName
from fleet_seif.signing import Signer

APART: Final = {reason.name.lower(): reason for reason in Reason if reason is not Reason.MERGED}
"""Why pairs are kept apart, by what the wire says: the sentences for people may change."""


def encode_merges(report: MergeReport, signer: Signer | None = None) -> bytes:
    """Bytes of a MergeReport."""
    r = report
    return seal(
        KIND_MERGES,
        (
            (r.fleet, r.node, r.version, r.canonical, r.map_digest, r.ledger_digest),
            tuple((reason.name.lower(), count) for reason, count in r.kept_apart),
            tuple(_pack_pair(each) for each in r.nearest),
            tuple((d.node, _pack_names(d.ours), tuple(map(_pack_names, d.theirs))) for d in r.differing),
        ),
        signer,
    )


def decode_merges(data: bytes) -> MergeReport:
    """A MergeReport from bytes. Raises WireError."""
    head, kept_apart, nearest, differing = fields_of(unseal(KIND_MERGES, data), 4, "merges")
    fleet, node, version, canonical, map_digest, ledger_digest = fields_of(head, 6, "merges head")
    return MergeReport(
        fleet=name_of(fleet, "fleet"),
        node=name_of(node, "node"),
        version=int_of(version, 0, SEQUENCE_MAX, "version"),
        canonical=bool_of(canonical, "canonical"),
        map_digest=digest_of(map_digest, "map digest"),
        ledger_digest=digest_of(ledger_digest, "ledger digest"),
        kept_apart=tuple(_read_count(item) for item in items_of(kept_apart, len(APART), "kept apart")),
        nearest=tuple(_read_pair(item) for item in items_of(nearest, len(APART) * NEAREST_MAX, "nearest")),
        differing=tuple(_read_differing(item) for item in items_of(differing, DIFFERING_MAX, "differing")),
    )


def _pack_names(names: tuple[LandmarkName, ...]) -> tuple[object, ...]:
    return tuple(tuple(name) for name in names)


def _pack_pair(each: KeptApart) -> tuple[object, ...]:
    return tuple(each.a), tuple(each.b), each.reason.name.lower(), each.d2


def _reason_of(value: Any) -> Reason:
    text = text_of(value, "reason")
    if text not in APART:
        raise WireError(f"merges: unknown reason {text!r}, one of {', '.join(APART)}")
    return APART[text]


def _read_count(value: Any) -> tuple[Reason, int]:
    reason, count = fields_of(value, 2, "kept apart")
    return _reason_of(reason), int_of(count, 1, SEQUENCE_MAX, "pairs kept apart")


def _read_pair(value: Any) -> KeptApart:
    a, b, reason, d2 = fields_of(value, 4, "pair kept apart")
    if d2 is not None and float_of(d2, "squared distance") < 0.0:
        raise WireError(f"merges: squared distance {d2} is below 0")
    return KeptApart(landmark_name_of(a), landmark_name_of(b), _reason_of(reason), d2)


def _read_names(value: Any) -> tuple[LandmarkName, ...]:
    return tuple(landmark_name_of(name) for name in items_of(value, ENTRIES_MAX, "names"))


def _read_differing(value: Any) -> Differing:
    node, ours, theirs = fields_of(value, 3, "differing landmark")
    classes: Classes = tuple(_read_names(names) for names in items_of(theirs, ENTRIES_MAX, "landmarks there"))
    return Differing(name_of(node, "node"), _read_names(ours), classes)
