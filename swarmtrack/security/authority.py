"""The team's CA: one folder that stays on one desk. A person with `ca.key` can issue a drone 3 of his own.

keys/ca.key ca.pem             the CA itself
keys/roster.toml roster.sig    who is in the team
keys/issued/NAME.pem           every certificate in force: public, so that expiry can be seen and renewed
keys/NAME/                     what goes to that machine, and there only
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from swarmtrack.errors import KeysError
from swarmtrack.security import names
from swarmtrack.security.keyfiles import (
    CA_CERTIFICATE,
    PRIVATE_FILE_MODE,
    PUBLIC,
    ROSTER,
    ROSTER_SIGNATURE,
    certificate_file,
    key_file,
    pem_of_certificate,
    pem_of_key,
    read_certificate,
    read_file,
    read_private_key,
    read_signed_roster,
    signing_key_file,
    write_file,
    write_signed_roster,
)
from swarmtrack.security.names import Role
from swarmtrack.security.roster import Roster

CA_KEY: Final = "ca.key"
ISSUED: Final = "issued"

CA_DAYS: Final = 3650
CERTIFICATE_DAYS: Final = 90  # nothing can be called back, so nothing lasts long
BACKDATED: Final = timedelta(days=30)  # a companion without a clock battery wakes up at its last shutdown

_TEAM = re.compile("[A-Za-z0-9_-]{1,64}")


@dataclass(frozen=True)
class Issued:
    """A valid certificate. signing_key: the drone's public Ed25519 key in the roster; None for others."""

    name: str
    certificate: x509.Certificate
    signing_key: bytes | None

    @property
    def expires(self) -> datetime:
        return self.certificate.not_valid_after_utc

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the certificate, hex."""
        return self.certificate.fingerprint(hashes.SHA256()).hex()


@dataclass(frozen=True)
class KeyChanges:
    """Result of `issue`, `renew` and `revoke`. folders: created or changed, by name.

    outdated: names of others that must get the new roster, because without it they would reject a new member or accept
    a revoked one.
    """

    folders: dict[str, Path]
    roster: Roster
    outdated: tuple[str, ...]


def create_authority(folder: Path, team: str, now: datetime, force: bool = False) -> Authority:
    """Create a CA. Raises KeysError, also where there is one already: its team would be locked out."""
    if not _TEAM.fullmatch(team):
        raise KeysError(f"--team: found {team!r}, expected 1 to 64 letters, digits, '-' or '_'")
    if (folder / CA_KEY).exists() and not force:
        raise KeysError(
            f"{folder / CA_KEY}: already exists; a new CA would lock the whole team out. "
            f"Take another folder, or --force"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise KeysError(f"{folder}: {error.strerror}, expected a folder that can be made") from None
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _subject(f"swarmtrack CA {team}"[:64], team)
    certificate = (
        _certificate(subject, subject, key.public_key(), now, CA_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    for old in _issued_certificates(folder):  # of the CA that goes
        old.unlink()
    write_file(folder / CA_KEY, pem_of_key(key), PRIVATE_FILE_MODE)
    write_file(folder / CA_CERTIFICATE, pem_of_certificate(certificate), PUBLIC)
    write_signed_roster(folder, Roster(team), key)
    return open_authority(folder)


def open_authority(folder: Path) -> Authority:
    """Open a CA's folder. Raises KeysError."""
    if not (folder / CA_KEY).exists():
        raise KeysError(f"{folder}: holds no {CA_KEY}, expected the folder of `swarmtrack keys init`")
    key = read_private_key(folder / CA_KEY)
    certificate = read_certificate(folder / CA_CERTIFICATE)
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise KeysError(f"{folder / CA_KEY}: does not belong to {CA_CERTIFICATE}, expected both of one init")
    return Authority(folder, key, certificate, read_signed_roster(folder, certificate))


class Authority:
    """The opened folder of a CA. Get one from `create_authority` or `open_authority`."""

    def __init__(
        self, folder: Path, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate, roster: Roster
    ) -> None:
        self._folder = folder
        self._key = key
        self._certificate = certificate
        self.roster = roster

    @property
    def certificate(self) -> x509.Certificate:
        return self._certificate

    def issue(
        self,
        wanted: Iterable[str],
        now: datetime,
        *,
        out: Path | None = None,
        days: int = CERTIFICATE_DAYS,
        force: bool = False,
    ) -> KeyChanges:
        """New keys and a folder for each name, below `out` (default: the CA's own folder). All or none is refused.

        Raises KeysError where keys would be overwritten without `force`.
        """
        folders = {name: (out or self._folder) / name for name in wanted}
        for name, folder in folders.items():
            if not force:
                self._refuse_to_overwrite(name, folder)
        roster = self.roster
        for name, folder in folders.items():
            try:
                folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            except OSError as error:
                raise KeysError(f"{folder}: {error.strerror}, expected a folder that can be made") from None
            key = ec.generate_private_key(ec.SECP256R1())
            write_file(folder / key_file(name), pem_of_key(key), PRIVATE_FILE_MODE)
            write_file(folder / CA_CERTIFICATE, pem_of_certificate(self._certificate), PUBLIC)
            if names.role(name) == Role.DRONE:
                signing_key = Ed25519PrivateKey.generate()
                write_file(folder / signing_key_file(name), pem_of_key(signing_key), PRIVATE_FILE_MODE)
                roster = roster.with_drone(names.drone_id(name), signing_key.public_key().public_bytes_raw())
            else:
                roster = roster.with_others(name)
            self._certify(name, key.public_key(), now, days, folder)
        return KeyChanges(folders, *self._replace_roster(roster, folders))

    def renew(self, wanted: Iterable[str], now: datetime, *, days: int = CERTIFICATE_DAYS) -> KeyChanges:
        """Issue new certificates for existing keys: only `NAME.pem` is to be copied. Raises KeysError."""
        folders = {name: self._folder / name for name in wanted}
        old = {name: self._certificate_in_force(name) for name in folders}
        for name, folder in folders.items():
            try:
                folder.mkdir(exist_ok=True, mode=0o700)
            except OSError as error:
                raise KeysError(f"{folder}: {error.strerror}, expected a folder that can be made") from None
            public_key = old[name].public_key()
            assert isinstance(public_key, ec.EllipticCurvePublicKey)  # we made it
            self._certify(name, public_key, now, days, folder)
        return KeyChanges(folders, self.roster, ())

    def revoke(self, name: str) -> KeyChanges:
        """Remove names from the team: processes with the new roster reject them. Raises KeysError."""
        certificate = self._folder / ISSUED / certificate_file(name)
        if name not in self.roster.names:
            raise KeysError(
                f"{name} is not in the roster, expected one of {', '.join(self.roster.names) or 'none'}"
            )
        certificate.unlink(missing_ok=True)
        return KeyChanges({}, *self._replace_roster(self.roster.without(name), {}))

    def issued(self) -> list[Issued]:
        """All valid certificates, drones first. Raises KeysError."""
        found = []
        for name in self.roster.names:
            public_key = (
                self.roster.drones.get(names.drone_id(name)) if names.role(name) == Role.DRONE else None
            )
            found.append(Issued(name, self._certificate_in_force(name), public_key))
        return found

    def _refuse_to_overwrite(self, name: str, folder: Path) -> None:
        if name in self.roster.names:
            raise KeysError(
                f"{name} has keys already. --renew makes a new certificate for them; --force makes new keys, and the "
                f"whole team needs the new roster"
            )
        for file in (key_file(name), signing_key_file(name)):
            if (folder / file).exists():
                raise KeysError(f"{folder / file}: already exists, expected an empty folder, or --force")

    def _certificate_in_force(self, name: str) -> x509.Certificate:
        if name not in self.roster.names:
            raise KeysError(
                f"{name} has no certificate, expected one of {', '.join(self.roster.names) or 'none'}"
            )
        return read_certificate(self._folder / ISSUED / certificate_file(name))

    def _certify(
        self, name: str, public_key: ec.EllipticCurvePublicKey, now: datetime, days: int, folder: Path
    ) -> None:
        """A certificate that never outlives the CA's."""
        days = min(days, (self._certificate.not_valid_after_utc - now).days)
        certificate = (
            _certificate(_subject(name, self.roster.team), self._certificate.subject, public_key, now, days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=False), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
            .sign(self._key, hashes.SHA256())
        )
        (self._folder / ISSUED).mkdir(exist_ok=True)
        write_file(folder / certificate_file(name), pem_of_certificate(certificate), PUBLIC)
        write_file(self._folder / ISSUED / certificate_file(name), pem_of_certificate(certificate), PUBLIC)

    def _replace_roster(self, roster: Roster, folders: dict[str, Path]) -> tuple[Roster, tuple[str, ...]]:
        """Sign the new one; put it beside the CA and into every folder at hand. The roster, and who else needs it."""
        self.roster = replace(roster, number=self.roster.number + 1)
        write_signed_roster(self._folder, self.roster, self._key)
        at_hand = {name: self._folder / name for name in self.roster.names if (self._folder / name).is_dir()}
        for folder in (at_hand | folders).values():
            for file in (ROSTER, ROSTER_SIGNATURE):
                write_file(folder / file, read_file(self._folder / file, "what was just written"), PUBLIC)
        return self.roster, tuple(name for name in self.roster.names if name not in folders)


def _issued_certificates(folder: Path) -> list[Path]:
    return sorted((folder / ISSUED).glob("*.pem"))


def _subject(name: str, team: str) -> x509.Name:
    return x509.Name(
        [x509.NameAttribute(NameOID.ORGANIZATION_NAME, team), x509.NameAttribute(NameOID.COMMON_NAME, name)]
    )


def _certificate(
    subject: x509.Name, issuer: x509.Name, public_key: ec.EllipticCurvePublicKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now.astimezone(UTC) - BACKDATED)
        .not_valid_after(now.astimezone(UTC) + timedelta(days=days))
    )


def _key_usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
