"""A fleet's own certificate authority, and the certificates of its processes."""

import base64
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fleet_seif.errors import RunError
from fleet_seif.signing import write_file

AUTHORITY_DAYS: Final = 7300
CLOCKS_APART: Final = timedelta(days=1)


@dataclass(frozen=True)
class Identity:
    """A certificate and its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    def certificate_pem(self) -> bytes:
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    def key_pem(self) -> bytes:
        return self.key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )


def open_authority(folder: Path, fleet: str, now: datetime) -> Identity:
    """The authority in a folder, made where there is none. Raises RunError where it cannot be read or written."""
    certificate_path, key_path = folder / "ca.pem", folder / "ca.key"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if certificate_path.exists():
            certificate = x509.load_pem_x509_certificate(certificate_path.read_bytes())
            key = serialization.load_pem_private_key(key_path.read_bytes(), password=None)
            if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
                raise ValueError("ca.key does not belong to ca.pem")
            return Identity(certificate, key)
    except (OSError, ValueError) as error:
        raise RunError(f"{folder}: {error}; put back what was there, or give another folder") from None
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"fleet_seif {fleet}")
    builder = _builder(name, name, key, now, now + timedelta(days=AUTHORITY_DAYS))
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(authority=True), critical=True)
    authority = Identity(builder.sign(key, hashes.SHA256()), key)
    write_file(key_path, authority.key_pem().decode(), private=True)
    write_file(certificate_path, authority.certificate_pem().decode(), private=False)
    return authority


def issue(authority: Identity, label: str, hosts: Sequence[str], now: datetime, days: int) -> Identity:
    """A certificate with a common name. One without `hosts` can connect; one with them can also be connected to.

    Valid from a day ago, as clocks differ.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    end = min(now + timedelta(days=days), authority.certificate.not_valid_after_utc)
    builder = _builder(_name(label), authority.certificate.subject, key, now, end)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_usage(authority=False), critical=True)
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if hosts:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = x509.SubjectAlternativeName([general_name(host) for host in dict.fromkeys(hosts)])
        builder = builder.add_extension(names, critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    return Identity(builder.sign(authority.key, hashes.SHA256()), key)


def tls_settings(authority: Identity, identity: Identity, *, listens: bool) -> dict[str, object]:
    """The TLS part of a Zenoh configuration, with everything in it."""
    certificate, key = _base64(identity.certificate_pem()), _base64(identity.key_pem())
    sides = ("connect", "listen") if listens else ("connect",)
    return {
        "root_ca_certificate_base64": _base64(authority.certificate_pem()),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        **{f"{side}_certificate_base64": certificate for side in sides},
        **{f"{side}_private_key_base64": key for side in sides},
    }


def is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def general_name(host: str) -> x509.GeneralName:
    """A host name or address as certificates hold it. Raises RunError for what is neither."""
    try:
        return x509.IPAddress(ipaddress.ip_address(host)) if is_address(host) else x509.DNSName(host)
    except ValueError as error:
        raise RunError(f"host {host!r} is neither a name nor an address: {error}") from None


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: datetime, end: datetime
) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder(subject_name=subject, issuer_name=issuer, public_key=key.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    return builder.not_valid_before(now - CLOCKS_APART).not_valid_after(end)


def _usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        key_cert_sign=authority,
        crl_sign=authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
