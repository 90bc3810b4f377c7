"""Loading of a folder made by `swarmtrack keys issue`, with checks, so that silent failures are reported at once."""

from __future__ import annotations

import logging
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from swarmtrack.errors import KeysError
from swarmtrack.security import names
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.keyfiles import (
    CA_CERTIFICATE,
    certificate_file,
    common_name,
    key_file,
    read_certificate,
    read_private_key,
    read_signed_roster,
    signing_key_file,
)
from swarmtrack.security.names import Role
from swarmtrack.security.roster import Roster

log = logging.getLogger(__name__)

CERTIFICATE_EXPIRES_SOON: Final = timedelta(
    days=7
)  # an expiry within this time is worth a word before a flight


def load_credentials(folder: Path, name: str, utc_s: float) -> Credentials:
    """The credentials of `name`. utc_s: the present, s since 1970. Raises KeysError with what to do."""
    _check_whose(folder, name)
    ca = read_certificate(folder / CA_CERTIFICATE)
    certificate_path, key_path = folder / certificate_file(name), folder / key_file(name)
    certificate = read_certificate(certificate_path)
    if common_name(certificate) != name:
        raise KeysError(
            f"{certificate_path}: is the certificate of {common_name(certificate)!r}, expected that of {name}"
        )
    if read_private_key(key_path).public_key() != certificate.public_key():
        raise KeysError(f"{key_path}: does not belong to {certificate_path.name}, expected both of one issue")
    try:
        certificate.verify_directly_issued_by(ca)
    except (InvalidSignature, ValueError, TypeError):
        raise KeysError(
            f"{certificate_path}: was not issued by the CA in {CA_CERTIFICATE}, expected both of one team"
        ) from None
    now = datetime.fromtimestamp(utc_s, UTC)
    for path, each in ((folder / CA_CERTIFICATE, ca), (certificate_path, certificate)):
        _check_dates(path, each, now)
    roster = read_signed_roster(folder, ca)
    return Credentials(
        name=name,
        ca=folder / CA_CERTIFICATE,
        certificate=certificate_path,
        key=key_path,
        expires=certificate.not_valid_after_utc,
        roster=roster,
        sign=_signer(folder, name, roster),
        verify=_Verifier(roster),
    )


def find_name(folder: Path, *roles: Role) -> str:
    """Name whose keys are in a folder, of one of the roles. Raises KeysError."""
    wanted = " or ".join(roles)
    found = [name for name in _names_in(folder) if names.role(name) in roles]
    if len(found) != 1:
        others = ", ".join(_names_in(folder)) or "none"
        raise KeysError(
            f"{folder}: holds keys of {others}, expected those of one {wanted}, from `swarmtrack keys issue`"
        )
    return found[0]


def _names_in(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.pem") if names.role(path.stem) is not None)


def _check_whose(folder: Path, name: str) -> None:
    if not folder.is_dir():
        raise KeysError(
            f"no folder {folder}, expected the one that `swarmtrack keys issue` made for {name}, copied here"
        )
    if not (folder / certificate_file(name)).exists():
        found = _names_in(folder)
        whose = f"the keys of {', '.join(found)}" if found else "no keys"
        raise KeysError(f"{folder}: holds {whose}, expected those of {name}; or is drone.id wrong?")


def _check_dates(path: Path, certificate: x509.Certificate, now: datetime) -> None:
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now < begin:
        raise KeysError(
            f"{path}: is not valid before {begin:%Y-%m-%d %H:%M} UTC, and this machine's clock shows "
            f"{now:%Y-%m-%d %H:%M}: most likely the clock is off"
        )
    if now > end:
        raise KeysError(
            f"{path}: expired on {end:%Y-%m-%d %H:%M} UTC, and this machine's clock shows {now:%Y-%m-%d %H:%M}: "
            f"if the clock is right, make a new one with `swarmtrack keys issue --renew`"
        )
    if now > end - CERTIFICATE_EXPIRES_SOON:
        log.warning("%s expires on %s UTC: links close then", path, end.strftime("%Y-%m-%d %H:%M"))


def _signer(folder: Path, name: str, roster: Roster) -> _Signer | None:
    if names.role(name) != Role.DRONE:
        return None
    path = folder / signing_key_file(name)
    key = read_private_key(path)
    if not isinstance(key, Ed25519PrivateKey):
        raise KeysError(f"{path}: is not an Ed25519 key, expected the one from `swarmtrack keys issue`")
    if roster.drones.get(names.drone_id(name)) != key.public_key().public_bytes_raw():
        raise KeysError(
            f"{folder / 'roster.toml'}: number {roster.number} does not list this key of {name}, expected the newest "
            f"roster.toml and roster.sig from the CA's folder; teammates would reject our announcement"
        )
    return _Signer(key)


class _Signer:
    """Not a lambda: its repr must say nothing."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key

    def __call__(self, data: bytes) -> bytes:
        return self._key.sign(data)


class _Verifier:
    def __init__(self, roster: Roster) -> None:
        self._keys = {i: Ed25519PublicKey.from_public_bytes(key) for i, key in roster.drones.items()}

    def __call__(self, drone_id: int, data: bytes, signature: bytes) -> bool:
        key = self._keys.get(drone_id)
        if key is None:
            return False
        try:
            key.verify(signature, data)
        except InvalidSignature:
            return False
        return True
