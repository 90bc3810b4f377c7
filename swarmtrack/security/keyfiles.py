"""Key files and the cryptography on them. Imports `cryptography`: only for processes with keys."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.x509.oid import NameOID

from swarmtrack.errors import KeysError
from swarmtrack.security.roster import MAX_ROSTER_BYTES, Roster, read_roster

PRIVATE_FILE_MODE: Final = 0o600
PUBLIC: Final = 0o644

CA_CERTIFICATE: Final = "ca.pem"
ROSTER: Final = "roster.toml"
ROSTER_SIGNATURE: Final = "roster.sig"

# What the CA signs here is never a certificate, and the other way round.
_ROSTER_CONTEXT: Final = b"swarmtrack roster\0"

PrivateKey = ec.EllipticCurvePrivateKey | Ed25519PrivateKey


def certificate_file(name: str) -> str:
    return f"{name}.pem"


def key_file(name: str) -> str:
    return f"{name}.key"


def signing_key_file(name: str) -> str:
    return f"{name}.sign.key"


# --- reading ----------------------------------------------------------------------------


def read_file(path: Path, expected: str) -> bytes:
    """Read a file. Raises KeysError."""
    try:
        with path.open("rb") as file:
            return file.read(MAX_ROSTER_BYTES)
    except OSError as error:
        raise KeysError(f"{path}: cannot be read ({error.strerror}), expected {expected}") from None


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate. Raises KeysError."""
    data = read_file(path, "a certificate, PEM")
    try:
        return x509.load_pem_x509_certificate(data)
    except ValueError:
        raise KeysError(
            f"{path}: is not a certificate, expected PEM, as `swarmtrack keys` writes it"
        ) from None


def read_private_key(path: Path) -> PrivateKey:
    """Read a P-256 or Ed25519 key. Raises KeysError, also for a file that others than its owner may read."""
    data = read_file(path, "a private key")
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o077:
        raise KeysError(
            f"{path}: mode {mode:04o} lets others on this machine read the key, expected 0600; run: chmod 600 {path}"
        )
    try:
        key = serialization.load_pem_private_key(data, password=None)
    except (ValueError, TypeError):  # TypeError: it is encrypted
        key = None
    if not isinstance(key, ec.EllipticCurvePrivateKey | Ed25519PrivateKey):
        raise KeysError(
            f"{path}: is not a private key for swarmtrack, expected PEM, as `swarmtrack keys` writes it"
        )
    return key


def read_signed_roster(folder: Path, ca: x509.Certificate) -> Roster:
    """Read the roster of a folder and verify the CA's signature. Raises KeysError."""
    path = folder / ROSTER
    data = read_file(path, "the team's roster")
    signature = read_file(folder / ROSTER_SIGNATURE, "the roster's signature")
    public_key = ca.public_key()
    try:
        if not isinstance(public_key, ec.EllipticCurvePublicKey):
            raise InvalidSignature
        public_key.verify(
            bytes.fromhex(signature.decode()), _ROSTER_CONTEXT + data, ec.ECDSA(hashes.SHA256())
        )
    except (InvalidSignature, ValueError):
        raise KeysError(
            f"{path}: is not what this team's CA signed in {ROSTER_SIGNATURE}, expected both as `swarmtrack keys` "
            f"left them, and {CA_CERTIFICATE} of the same team"
        ) from None
    return read_roster(data, str(path))


def common_name(certificate: x509.Certificate) -> str:
    found = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else ""


# --- writing ----------------------------------------------------------------------------


def write_file(path: Path, data: bytes, mode: int) -> None:
    """Write atomically, and never for a moment readable by more than `mode` allows. Raises KeysError."""
    unfinished = path.with_name(f".{path.name}.new")
    try:
        unfinished.unlink(missing_ok=True)
        with os.fdopen(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            os.fchmod(file.fileno(), mode)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except OSError as error:
        raise KeysError(f"{path}: {error.strerror}, expected to be able to write it") from None


def pem_of_key(key: PrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def pem_of_certificate(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def write_signed_roster(folder: Path, roster: Roster, ca_key: ec.EllipticCurvePrivateKey) -> None:
    data = roster.to_toml()
    signature = ca_key.sign(_ROSTER_CONTEXT + data, ec.ECDSA(hashes.SHA256()))
    # A reader between the two would find a wrong signature and say so; the next start finds both.
    write_file(folder / ROSTER, data, PUBLIC)
    write_file(folder / ROSTER_SIGNATURE, signature.hex().encode() + b"\n", PUBLIC)
