"""Who said it: Ed25519 signatures (RFC 8032), one private key a process, one file with the public keys of a fleet.

1. A name counts together with its role: a vehicle cannot speak for a node of the same name.
2. No two names share a key, so a signature names its signer.
3. A private key that other users of the machine can read is refused.
"""

import os
import stat
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final, Literal, TypeVar

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fleet_seif.errors import RunError
from fleet_seif.messages import check_name

FORMAT: Final = 1
SIGNATURE: Final = 64
FILE_MAX: Final = 2**20
REMEDY: Final = "`fleet-seif keys DIR --fleet NAME ...` makes these files"


class Role(StrEnum):
    VEHICLE = "vehicle"
    NODE = "node"
    OPERATOR = "operator"


_Key = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    format: Literal[1] = FORMAT
    fleet: str


class _PrivateFile(_File):
    role: Role
    name: str
    private_key: _Key


class _RingFile(_File):
    public_keys: dict[Role, dict[str, _Key]]


_AnyFile = TypeVar("_AnyFile", bound=_File)


class Signer:
    """One process's private key. Signing is thread-safe."""

    def __init__(self, fleet: str, role: Role, name: str, private_key: bytes) -> None:
        """private_key: 32 bytes. Raises ValueError for names that cannot be part of a key expression."""
        self.fleet: Final = check_name(fleet, "fleet")
        self.role: Final = Role(role)
        self.name: Final = check_name(name, role)
        self._key: Final = Ed25519PrivateKey.from_private_bytes(private_key)

    def sign(self, data: bytes) -> bytes:
        """The signature, 64 bytes; the same data gives the same signature."""
        return self._key.sign(data)

    def public_key(self) -> bytes:
        """32 bytes, for a key ring."""
        return self._key.public_key().public_bytes_raw()

    def private_key(self) -> bytes:
        """32 bytes, for this process's own file and nothing else."""
        return self._key.private_bytes_raw()


class KeyRing:
    """The public keys of one fleet. Checking is thread-safe."""

    def __init__(self, fleet: str, public_keys: Mapping[tuple[Role, str], bytes]) -> None:
        """public_keys: 32 bytes each, no two alike. Raises ValueError otherwise, and for malformed names."""
        self.fleet: Final = check_name(fleet, "fleet")
        if len(set(public_keys.values())) < len(public_keys):
            raise ValueError("two names share one key: nobody could tell who signed")
        self.public_keys: Final = {(Role(role), check_name(name, role)): k for (role, name), k in public_keys.items()}
        self._keys: Final = {who: Ed25519PublicKey.from_public_bytes(key) for who, key in self.public_keys.items()}

    def verify(self, role: Role, name: str, data: bytes, signature: bytes) -> bool:
        """Whether `name` in this role signed these bytes. False too for somebody who is not in the ring."""
        key = self._keys.get((role, name))
        if key is None:
            return False
        try:
            key.verify(signature, data)
        except InvalidSignature:
            return False
        return True

    def names(self, role: Role) -> list[str]:
        """Everybody in this role, sorted."""
        return sorted(name for known, name in self.public_keys if known is role)

    def with_signers(self, *signers: Signer) -> "KeyRing":
        """This ring with further keys; one that is already there is replaced."""
        return KeyRing(self.fleet, {**self.public_keys, **{(s.role, s.name): s.public_key() for s in signers}})


def generate_signer(fleet: str, role: Role, name: str) -> Signer:
    """A fresh key."""
    return Signer(fleet, role, name, Ed25519PrivateKey.generate().private_bytes_raw())


def load_signer(path: Path) -> Signer:
    """Raises RunError where the file is missing, damaged or readable by others."""
    file = _read(path, _PrivateFile, "private key", private=True)
    try:
        return Signer(file.fleet, file.role, file.name, bytes.fromhex(file.private_key))
    except ValueError as error:
        raise RunError(f"private key {path}: {error}; {REMEDY}") from None


def load_key_ring(path: Path) -> KeyRing:
    """Raises RunError where the file is missing or damaged."""
    file = _read(path, _RingFile, "key ring", private=False)
    keys = {(role, name): bytes.fromhex(key) for role, named in file.public_keys.items() for name, key in named.items()}
    try:
        return KeyRing(file.fleet, keys)
    except ValueError as error:
        raise RunError(f"key ring {path}: {error}; {REMEDY}") from None


def write_signer(path: Path, signer: Signer, *, replace: bool = False) -> None:
    """A file that only its owner can read. Raises RunError where there is one already, unless it is to be replaced."""
    file = _PrivateFile(fleet=signer.fleet, role=signer.role, name=signer.name, private_key=signer.private_key().hex())
    write_file(path, file.model_dump_json(indent=2) + "\n", private=True, replace=replace)


def write_key_ring(path: Path, ring: KeyRing) -> None:
    """Replaces the file in one go. Raises RunError where that cannot be."""
    keys = {role: {name: ring.public_keys[role, name].hex() for name in ring.names(role)} for role in Role}
    write_file(path, _RingFile(fleet=ring.fleet, public_keys=keys).model_dump_json(indent=2) + "\n", private=False)


def write_file(path: Path, text: str, *, private: bool, replace: bool = True) -> None:
    """Write a file whole or not at all; a private one is never readable by others, not even for a moment."""
    draft = path.with_name(path.name + ".new")
    try:
        if not replace and path.exists():
            raise RunError(f"{path} exists already, and a key is never overwritten: remove it, or give another folder")
        draft.unlink(missing_ok=True)
        handle = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if private else 0o644)
        with os.fdopen(handle, "w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror or error}; give another folder") from None


def _read(path: Path, kind: type[_AnyFile], what: str, private: bool) -> _AnyFile:
    try:
        with path.open("rb") as file:
            shared = os.name == "posix" and stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o077
            data = file.read(FILE_MAX + 1)
    except OSError as error:
        raise RunError(f"{what} {path}: {error.strerror or error}; {REMEDY}") from None
    if private and shared:
        raise RunError(f"{what} {path}: other users can read it; if nobody else has seen it: chmod 600 '{path}'")
    if len(data) > FILE_MAX:
        raise RunError(f"{what} {path}: more than {FILE_MAX} bytes, so it is not one; {REMEDY}")
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RunError(f"{what} {path}: damaged at {where}: {first['msg']}; {REMEDY}") from None
