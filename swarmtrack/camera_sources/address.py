"""Camera addresses, `scheme://target?option=value&…`, parsed once and checked completely.

A misspelt option that is silently ignored costs its user an afternoon, so every unknown word is refused together with
the known ones. The exceptions are network schemes, whose query belongs to the server: there our own options are taken
out and the rest is sent on.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import re
import typing
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import parse_qsl, quote, unquote, unquote_to_bytes, urlencode, urlsplit

from swarmtrack.errors import SourceError
from swarmtrack.plain_text import hide_logins

DETECTS_BY_ITSELF = "detections"
NETWORK_SCHEMES = ("http", "https", "rtsp", DETECTS_BY_ITSELF)

Options = TypeVar("Options")


class Login(NamedTuple):
    """User and password, as they are and not as a URL writes them."""

    user: str
    password: str


@dataclass(frozen=True, slots=True)
class CameraAddress:
    """A parsed address. target: a path, or for network schemes the URL without its query and login."""

    scheme: str
    target: str
    query: tuple[tuple[str, str], ...]
    login: Login | None = field(default=None, repr=False)

    def __str__(self) -> str:
        """The address for people and logs: passwords hidden."""
        if self.scheme not in NETWORK_SCHEMES:
            query = "&".join(f"{key}={value}" for key, value in self.query)
            return f"{self.scheme}://{self.target}" + (f"?{query}" if query else "")
        shown = hide_logins(self.target + (f"?{urlencode(self.query)}" if self.query else ""))
        if self.login is None:
            return shown
        # A user without a password is a token.
        user = quote(self.login.user) if self.login.password else "…"
        return shown.replace("://", f"://{user}@", 1)

    def path(self, base: Path | None) -> Path:
        """The target as a file; relative paths start at `base`, the folder of the config."""
        # A file's name is bytes, which need not be UTF-8.
        name = os.fsdecode(unquote_to_bytes(self.target))
        path = os.path.expanduser(name)  # pathlib's raises where there is no such user
        return Path(path) if base is None else base / path


def parse_address(source: str) -> CameraAddress:
    """Parse an address. `/dev/…` and a bare number are shorthand for `v4l2:`."""
    source = source.strip()
    if source.isascii() and source.isdigit():
        source = f"/dev/video{source}"
    if source.startswith("/dev/"):
        source = f"v4l2://{source}"
    scheme, colon, rest = source.partition(":")
    if not colon or not scheme.isalnum():
        raise SourceError(
            f'camera source "{source}": expected SCHEME://…, for example v4l2:///dev/video0; '
            f"a video file is written {_as_file(source)}"
        )
    scheme = scheme.lower()
    if scheme in NETWORK_SCHEMES:
        return _network_address(scheme, rest)
    target, _, query = rest.removeprefix("//").partition("?")
    if not target:
        raise SourceError(f'camera source "{source}": nothing after {scheme}://')
    return CameraAddress(scheme, target, tuple(parse_qsl(query, keep_blank_values=True)))


def _network_address(scheme: str, rest: str) -> CameraAddress:
    """scheme://[USER:PASSWORD@]HOST[:PORT][/PATH][?QUERY]. No error repeats what may be a part of a password."""
    if not rest.startswith("//"):
        raise SourceError(f"camera source {scheme}: expected {scheme}://HOST[:PORT]/PATH")
    if re.search(r"\s", rest):
        raise SourceError(f"camera source {scheme}: found a space, expected %20 in its place")
    found = re.match(r"//([^/?#]*)(.*)", rest)
    assert found is not None
    login, at, host = found[1].rpartition("@")
    path, _, query = found[2].partition("?")
    # Of a password that holds one of these signs, a part would be taken for the host's port, the path or the query.
    if "@" in path or (not path and "@" in query) or "#" in found[2]:
        raise SourceError(
            f'camera source {scheme}: found "#" or "@" behind the host, where neither belongs: write # in a password '
            "as %23, / as %2F, ? as %3F and @ as %40 (the same in a path)"
        )
    user, _, password = login.partition(":")
    try:
        parts = urlsplit(f"{scheme}://{host}{path}")
    except ValueError as error:
        raise SourceError(f"camera source {scheme}: {error}, expected {scheme}://HOST[:PORT]/PATH") from None
    try:
        _ = parts.port  # raises on a port that is no number
    except ValueError:
        raise SourceError(
            f"camera source {scheme}: found a port that is no number from 0 to 65535, expected "
            f"{scheme}://[USER:PASSWORD@]HOST[:PORT]/PATH"
        ) from None
    if not parts.hostname:
        raise SourceError(f"camera source {scheme}: no host, expected {scheme}://HOST[:PORT]/PATH")
    try:
        parts.hostname.encode("idna")
    except UnicodeError:
        raise SourceError(
            f'camera source {scheme}: found host "{parts.hostname}", expected a name or an IP address'
        ) from None
    if ":" in unquote(user):
        raise SourceError(
            f'camera source {scheme}: found ":" in the user, expected it only before the password'
        )
    return CameraAddress(
        scheme,
        f"{scheme}://{host}{path}",
        tuple(parse_qsl(query, keep_blank_values=True)),
        Login(unquote(user), unquote(password)) if at else None,
    )


def read_options(address: CameraAddress, kind: type[Options]) -> Options:
    """The options of an address as the frozen dataclass `kind`; all wrong ones are named in one `SourceError`."""
    types = typing.get_type_hints(kind)
    found: dict[str, Any] = {}
    problems: list[str] = []
    for name, text in address.query:
        if name not in types:
            if address.scheme not in NETWORK_SCHEMES:
                problems.append(f'unknown option "{name}"{nearest(name, types)}')
            continue
        if name in found:
            problems.append(f"{name}: given twice")
            continue
        try:
            found[name] = _read_value(text, types[name])
        except ValueError as error:
            problems.append(f'{name}: found "{text}", expected {error}')
    if not problems:
        try:
            return kind(**found)
        except ValueError as error:
            problems.append(str(error))
    raise SourceError(f"camera source {address}: {'; '.join(problems)}")


def server_url(address: CameraAddress, kind: type[Any]) -> str:
    """URL of the request to the server: the address without our own options, and without the login."""
    ours = {field.name for field in dataclasses.fields(kind)}
    query = urlencode([(key, value) for key, value in address.query if key not in ours])
    return address.target + (f"?{query}" if query else "")


def with_login(url: str, login: Login | None) -> str:
    """The URL with the login in it, for a client that takes it from there."""
    if login is None:
        return url
    return url.replace("://", f"://{quote(login.user, safe='')}:{quote(login.password, safe='')}@", 1)


def nearest(word: str, known: Iterable[str]) -> str:
    """End of an error message: ', did you mean …?' and the known words."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    question = f', did you mean "{close[0]}"?' if close else ","
    return f"{question} known: {', '.join(names)}"


def _read_value(text: str, kind: Any) -> Any:
    if kind is bool:
        if text.lower() in ("1", "true", "yes", "on", ""):
            return True
        if text.lower() in ("0", "false", "no", "off"):
            return False
        raise ValueError("0 or 1")
    if kind in (int, int | None):
        try:
            return int(text)
        except ValueError:
            raise ValueError("a whole number") from None
    if kind in (float, float | None):
        try:
            return float(text)
        except ValueError:
            raise ValueError("a number") from None
    if kind == tuple[str, ...]:
        return tuple(word.strip() for word in text.split(",") if word.strip())
    return text


def in_range(name: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Raise ValueError unless low <= value <= high; NaN is out of every range."""
    if value is not None and not low <= value <= high:
        raise ValueError(f"{name}: found {value}, expected {low} … {high}{unit}")


def _as_file(source: str) -> str:
    return f"file://{quote(source)}" if source and "@" not in source else "file://clip.mp4"
