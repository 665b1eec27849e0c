"""Signatures: only what was signed by that name in that role passes, and damaged files are refused by name."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.errors import RunError
from fleet_seif.signing import (
    SIGNATURE,
    KeyRing,
    Role,
    Signer,
    generate_signer,
    load_key_ring,
    load_signer,
    write_key_ring,
    write_signer,
)

ALICE, BOB = generate_signer("demo", Role.VEHICLE, "alice"), generate_signer("demo", Role.VEHICLE, "bob")
NODE = generate_signer("demo", Role.NODE, "alice")
RING = KeyRing("demo", {}).with_signers(ALICE, BOB, NODE)
DATA = st.binary(min_size=1, max_size=64)


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8 % len(data)] ^= 1 << bit % 8
    return bytes(changed)


@given(data=DATA)
def test_what_a_name_signed_passes_under_that_name_and_role_only(data: bytes) -> None:
    signature = ALICE.sign(data)
    assert len(signature) == SIGNATURE
    assert RING.verify(Role.VEHICLE, "alice", data, signature)
    others = [(Role.VEHICLE, "bob"), (Role.NODE, "alice"), (Role.OPERATOR, "alice"), (Role.VEHICLE, "nobody")]
    assert not any(RING.verify(role, name, data, signature) for role, name in others)


@given(data=DATA, bit=st.integers(0, 8 * SIGNATURE - 1))
def test_a_flipped_bit_is_noticed(data: bytes, bit: int) -> None:
    signature = ALICE.sign(data)
    assert not RING.verify(Role.VEHICLE, "alice", flipped(data, bit), signature)
    assert not RING.verify(Role.VEHICLE, "alice", data, flipped(signature, bit))


@given(data=DATA, signature=st.binary(max_size=2 * SIGNATURE))
def test_bytes_that_are_no_signature_are_false_and_never_an_error(data: bytes, signature: bytes) -> None:
    assert not RING.verify(Role.VEHICLE, "alice", data, signature)


def test_files_bring_back_what_was_written(tmp_path: Path) -> None:
    write_signer(tmp_path / "alice.key.json", ALICE)
    write_key_ring(tmp_path / "ring.json", RING)
    signer, ring = load_signer(tmp_path / "alice.key.json"), load_key_ring(tmp_path / "ring.json")
    assert (signer.fleet, signer.role, signer.name) == ("demo", Role.VEHICLE, "alice")
    assert signer.sign(b"data") == ALICE.sign(b"data")
    assert (ring.fleet, ring.public_keys) == ("demo", RING.public_keys)
    assert ring.names(Role.VEHICLE) == ["alice", "bob"]
    assert ALICE.private_key().hex() not in (tmp_path / "ring.json").read_text()


def test_a_private_key_is_never_overwritten_unless_that_is_meant(tmp_path: Path) -> None:
    path = tmp_path / "key.json"
    write_signer(path, ALICE)
    with pytest.raises(RunError, match="never overwritten"):
        write_signer(path, BOB)
    assert load_signer(path).name == "alice"
    write_signer(path, BOB, replace=True)
    assert load_signer(path).name == "bob"
    assert [found.name for found in tmp_path.iterdir()] == ["key.json"]


def test_a_private_key_that_others_can_read_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "key.json"
    write_signer(path, ALICE)
    assert path.stat().st_mode & 0o777 == 0o600
    for mode in (0o640, 0o604, 0o620):
        path.chmod(mode)
        with pytest.raises(RunError, match="chmod 600"):
            load_signer(path)
    path.chmod(0o400)
    assert load_signer(path).name == "alice"


def test_missing_files_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"private key .*none\.json: No such file.*fleet-seif keys"):
        load_signer(tmp_path / "none.json")
    with pytest.raises(RunError, match=r"key ring .*none\.json: No such file.*fleet-seif keys"):
        load_key_ring(tmp_path / "none.json")
    with pytest.raises(RunError, match="cannot write"):
        write_key_ring(tmp_path / "no" / "folder.json", RING)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"format": 2}, "format"),
        ({"fleet": "a/b"}, "fleet"),
        ({"public_keys": {"captain": {}}}, "public_keys"),
        ({"public_keys": {"vehicle": {"alice": "00"}}}, "alice"),
        ({"public_keys": {"vehicle": {"*": "11" * 32}}}, "vehicle"),
        ({"public_keys": {"vehicle": {"alice": "11" * 32}, "node": {"n": "11" * 32}}}, "share one key"),
        ({"private_key": "11" * 32}, "private_key"),
    ],
)
def test_a_damaged_key_ring_is_refused_by_name(tmp_path: Path, change: dict[str, object], where: str) -> None:
    path = tmp_path / "ring.json"
    write_key_ring(path, RING)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(RunError, match=rf"key ring .*ring\.json: .*{where}"):
        load_key_ring(path)


@given(cut=st.integers(0, 200), junk=st.binary(max_size=20))
def test_a_file_that_was_cut_or_overwritten_is_refused_by_name(
    tmp_path_factory: pytest.TempPathFactory, cut: int, junk: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.key.json"
    write_signer(path, ALICE, replace=True)
    with path.open("r+b") as file:
        file.truncate(min(cut, path.stat().st_size - 10))
        file.seek(0, 2)
        file.write(junk)
    with pytest.raises(RunError, match=r"private key .*damaged\.key\.json: damaged"):
        load_signer(path)


def test_what_is_far_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "ring.json"
    path.write_bytes(b" " * 2**21)
    with pytest.raises(RunError, match="more than"):
        load_key_ring(path)


def test_an_error_does_not_show_the_key(tmp_path: Path) -> None:
    path = tmp_path / "key.json"
    write_signer(path, ALICE)
    path.write_text(path.read_text().replace(ALICE.private_key().hex(), ALICE.private_key().hex() + "0"))
    with pytest.raises(RunError) as caught:
        load_signer(path)
    assert ALICE.private_key().hex()[:8] not in str(caught.value)


def test_a_name_that_could_be_mistaken_is_refused() -> None:
    with pytest.raises(ValueError, match="vehicle"):
        Signer("demo", Role.VEHICLE, "a/b", bytes(32))
    with pytest.raises(ValueError, match="fleet"):
        KeyRing("", {})
