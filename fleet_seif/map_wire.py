"""Bytes of the joint map, whole and in pieces; FORMAT.md is the specification."""

from dataclasses import dataclass
from typing import Any

from fleet_seif.envelope import (
    COUNTERS_MAX,
    ENTRIES_MAX,
    KIND_MAP,
    KIND_PIECE,
    PIECE_BYTES,
    PIECES_MAX,
    SEQUENCE_MAX,
    array_of,
    bool_of,
    digest_of,
    epoch_of,
    fields_of,
    int_of,
    items_of,
    landmark_name_of,
    name_of,
    raw_bytes,
    seal,
    text_of,
    unseal,
)
from fleet_seif.errors import WireError
from fleet_seif.information import VARIABLE_MAX
from fleet_seif.messages import JointMap, VehicleState
from fleet_seif.signing import Signer


def encode_map(joint: JointMap, signer: Signer | None = None) -> bytes:
    """Bytes of a JointMap."""
    return seal(
        KIND_MAP,
        (
            (
                joint.fleet,
                joint.node,
                joint.version,
                joint.canonical,
                joint.final,
                joint.map_digest,
                joint.ledger_digest,
            ),
            (raw_bytes(joint.landmark_mean), raw_bytes(joint.landmark_cov), joint.cov_version),
            tuple(tuple(tuple(name) for name in names) for names in joint.names),
            joint.signature,
            (joint.poses, raw_bytes(joint.pose_mean), raw_bytes(joint.pose_cov)),
            tuple(_pack_state(state) for state in joint.vehicles),
            dict(sorted(joint.counters.items())),
        ),
        signer,
    )


def _pack_state(s: VehicleState) -> tuple[object, ...]:
    counts = (s.cut, s.checked, s.behind, s.parked, s.duplicates, s.gaps_repaired, s.refused)
    return s.name, s.life, tuple(s.epoch), counts, (s.placed, s.stalled, s.ended, s.healthy), s.fault


def _read_state(value: Any) -> VehicleState:
    name, life, epoch, counts, flags, fault = fields_of(value, 6, "vehicle state")
    cut, checked, behind, parked, duplicates, gaps_repaired, refused = (
        int_of(n, -1, SEQUENCE_MAX, "count") for n in fields_of(counts, 7, "counts")
    )
    placed, stalled, ended, healthy = (bool_of(flag, "flag") for flag in fields_of(flags, 4, "flags"))
    return VehicleState(
        name=name_of(name, "vehicle"),
        life=int_of(life, 0, VARIABLE_MAX, "life"),
        epoch=epoch_of(epoch),
        cut=cut,
        checked=checked,
        behind=behind,
        parked=parked,
        duplicates=duplicates,
        gaps_repaired=gaps_repaired,
        refused=refused,
        placed=placed,
        stalled=stalled,
        ended=ended,
        healthy=healthy,
        fault=text_of(fault, "fault"),
    )


def decode_map(data: bytes) -> JointMap:
    """A JointMap from bytes. Raises WireError."""
    head, landmarks, names, signature, poses, vehicles, counters = fields_of(unseal(KIND_MAP, data), 7, "map")
    fleet, node, version, canonical, final, map_digest, ledger_digest = fields_of(head, 7, "map head")
    mean, cov, cov_version = fields_of(landmarks, 3, "map landmarks")
    pose_names, pose_mean, pose_cov = fields_of(poses, 3, "map poses")
    table = isinstance(counters, dict) and all(isinstance(key, str) for key in counters)
    if not table or len(counters) > COUNTERS_MAX or list(counters) != sorted(counters):
        raise WireError(f"map counters: expected a table of at most {COUNTERS_MAX}, in order of its keys")
    joint = JointMap(
        fleet=name_of(fleet, "fleet"),
        node=name_of(node, "node"),
        version=int_of(version, 0, SEQUENCE_MAX, "version"),
        canonical=bool_of(canonical, "canonical"),
        final=bool_of(final, "final"),
        map_digest=digest_of(map_digest, "map digest"),
        ledger_digest=digest_of(ledger_digest, "ledger digest"),
        landmark_mean=array_of(mean, (-1, 2), "landmark means"),
        landmark_cov=array_of(cov, (-1, 2, 2), "landmark covariances"),
        cov_version=int_of(cov_version, -1, SEQUENCE_MAX, "covariance version"),
        names=tuple(
            tuple(landmark_name_of(name) for name in items_of(group, ENTRIES_MAX, "names"))
            for group in items_of(names, ENTRIES_MAX, "landmark names")
        ),
        signature=tuple(int_of(s, -1, 2**63 - 1, "signature") for s in items_of(signature, ENTRIES_MAX, "signatures")),
        poses=tuple(name_of(name, "vehicle") for name in items_of(pose_names, ENTRIES_MAX, "poses")),
        pose_mean=array_of(pose_mean, (-1, 3), "poses"),
        pose_cov=array_of(pose_cov, (-1, 3, 3), "pose covariances"),
        vehicles=tuple(_read_state(state) for state in items_of(vehicles, ENTRIES_MAX, "vehicles")),
        counters={text_of(key, "counter"): int_of(n, 0, SEQUENCE_MAX, "counter") for key, n in counters.items()},
    )
    n = len(joint.landmark_mean)
    if len(joint.names) != n or len(joint.signature) != n or len(joint.landmark_cov) not in (0, n):
        raise WireError("map: tables of landmarks differ in length")
    if len(joint.pose_mean) != len(joint.poses) or len(joint.pose_cov) not in (0, len(joint.poses)):
        raise WireError("map: tables of poses differ in length")
    return joint


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A part of an encoded map: piece `index` of `count`."""

    node: str
    version: int
    index: int
    count: int
    data: bytes


def map_pieces(data: bytes, node: str, version: int) -> list[bytes]:
    """An encoded map in pieces that fit small links; each says which map it belongs to. Only the whole is signed."""
    chunks = [data[i : i + PIECE_BYTES] for i in range(0, len(data), PIECE_BYTES)]
    return [seal(KIND_PIECE, (node, version, k, len(chunks), chunk)) for k, chunk in enumerate(chunks)]


def read_piece(data: bytes) -> Piece:
    """One piece from bytes. Raises WireError."""
    node, version, index, count, chunk = fields_of(unseal(KIND_PIECE, data), 5, "piece")
    count = int_of(count, 1, PIECES_MAX, "pieces")
    if type(chunk) is not bytes or len(chunk) > PIECE_BYTES:
        raise WireError(f"piece: expected at most {PIECE_BYTES} bytes")
    return Piece(
        node=name_of(node, "node"),
        version=int_of(version, 0, SEQUENCE_MAX, "version"),
        index=int_of(index, 0, count - 1, "piece"),
        count=count,
        data=chunk,
    )
