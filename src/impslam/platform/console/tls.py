"""The certificate: a given one, or a self-signed one.

A self-signed certificate protects from eavesdropping and, once its fingerprint has been compared, from
impostors; the fingerprint is printed for that.
"""

from __future__ import annotations

import datetime
import ipaddress
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from impslam.errors import ImpError
from impslam.platform.console.accounts import write_private

LIFETIME = datetime.timedelta(days=825)  # the maximum of browsers of Apple
RENEWAL_TIME = datetime.timedelta(days=30)  # before its end
BACKDATING = datetime.timedelta(days=1)  # valid from the day before: a robot's clock may be wrong
MAX_NAMES = 64  # of a certificate; more names of earlier networks are dropped


class CertificateError(ImpError):
    """A certificate or key that cannot be used or made; the message says what to do."""


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """A certificate and its key, PEM files."""

    certificate: Path
    key: Path

    def fingerprint(self) -> str:
        """Return the SHA-256 of the certificate as browsers show it: `AB:CD:...`."""
        return _read(self.certificate).fingerprint(hashes.SHA256()).hex(":").upper()

    def context(self) -> ssl.SSLContext:
        """Return the context of a server: TLS 1.2 or later, Python's default ciphers.

        Raises
        ------
        CertificateError
            If the files cannot be read, or do not belong together.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_NO_COMPRESSION
        try:
            # Without a password, OpenSSL would prompt for that of an encrypted key.
            context.load_cert_chain(self.certificate, self.key, password="")
        except (OSError, ValueError) as error:  # SSLError is an OSError
            raise CertificateError(
                f"{self.certificate} and {self.key}: {_reason(error)}; give a PEM certificate and "
                "its key without password, or neither, and one is made"
            ) from None
        return context


def own_certificate(
    folder: Path, names: Sequence[str], addresses: Sequence[str]
) -> CertificateFiles:
    """Return a certificate for names and addresses; make a new one if necessary.

    It is renewed when it ends soon and when it lacks a name or an address. The new one keeps the
    names of the old one, so that a robot that alternates between two networks keeps one certificate
    and fingerprint.

    Raises
    ------
    CertificateError
        If it cannot be stored in `folder`.
    """
    pem = CertificateFiles(folder / "certificate.pem", folder / "key.pem")
    wanted = _alternatives(names, addresses)
    existing = _existing(pem)
    moment = _now()
    if existing is not None:
        covered = _covered(existing)
        lasts = (
            existing.not_valid_before_utc <= moment < existing.not_valid_after_utc - RENEWAL_TIME
        )
        if lasts and set(wanted) <= set(covered):
            return pem
        wanted = list(dict.fromkeys([*wanted, *covered]))[:MAX_NAMES]
    try:
        _write_new(pem, wanted, moment)
    except OSError as error:
        raise CertificateError(
            f"{folder}: {_reason(error)}; make it writable for your user"
        ) from None
    return pem


def _write_new(
    pem: CertificateFiles, alternatives: Sequence[x509.GeneralName], moment: datetime.datetime
) -> None:
    """Write a P-256 key and a self-signed certificate (RFC 5280; names by RFC 6125)."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "impslam robot")])
    usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(moment - BACKDATING)
        .not_valid_after(moment - BACKDATING + LIFETIME)
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=False)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    write_private(pem.key, secret)
    write_private(pem.certificate, certificate.public_bytes(serialization.Encoding.PEM))


def _existing(pem: CertificateFiles) -> x509.Certificate | None:
    """Return the existing certificate, None if it or its key is missing or invalid."""
    try:
        pem.context()
        return _read(pem.certificate)
    except CertificateError:
        return None


def _read(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise CertificateError(f"{path}: {_reason(error)}; give a certificate in PEM") from None


def _covered(certificate: x509.Certificate) -> list[x509.GeneralName]:
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return []
    return list(found.value)


def _alternatives(names: Sequence[str], addresses: Sequence[str]) -> list[x509.GeneralName]:
    by_name: list[x509.GeneralName] = [x509.DNSName(name) for name in names if name.isascii()]
    return by_name + [x509.IPAddress(ipaddress.ip_address(address)) for address in addresses]


def _now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error).partition("\n")[0] or "cannot be read"
