"""A server's challenges, by which it asks for a login: RFC 9110, section 11.6.1, and RFC 7616."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from urllib.error import URLError
from urllib.request import (
    AbstractDigestAuthHandler,
    HTTPPasswordMgrWithDefaultRealm,
    Request,
    parse_http_list,
    parse_keqv_list,
)

from swarmtrack.camera_sources.address import Login

UNKNOWN_DIGEST = "SHA-512-256"  # of RFC 7616, the only one that no library here computes
_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*+"?')
# A parameter has an equals sign, a scheme has none.
_SCHEME_START = re.compile(r"(?:^|,)\s*+([^\s,=]++)(?!\s*=)")


def challenges_of(lines: Iterable[str]) -> list[str]:
    """Challenges in WWW-Authenticate's lines, each from its scheme on; a line may hold several."""
    found = []
    for line in lines:
        unquoted = _QUOTED.sub(lambda quoted: "-" * len(quoted[0]), line)
        starts = [start.start(1) for start in _SCHEME_START.finditer(unquoted)]
        found += [
            line[start:end].rstrip(", ") for start, end in zip(starts, [*starts[1:], None], strict=True)
        ]
    return found


def digests_of(challenges: Iterable[str]) -> list[str]:
    """Challenges of the digest scheme that can be answered, in the server's order of preference."""
    digests = (each for each in challenges if schemes_of([each]) == ("digest",))
    return [each for each in digests if UNKNOWN_DIGEST not in each.upper()]


def schemes_of(challenges: Iterable[str]) -> tuple[str, ...]:
    """Schemes of challenges, in lower case."""
    return tuple(each.split(maxsplit=1)[0].lower() for each in challenges)


def basic(login: Login) -> str:
    """Authorization with the password in plain text."""
    return f"Basic {b64encode(':'.join(login).encode()).decode()}"


def authorization(challenges: Sequence[str], method: str, url: str, login: Login) -> str:
    """Authorization for an RTSP request, by digest where it is offered; empty where no offered scheme is known."""
    schemes = schemes_of(challenges)
    if "digest" not in schemes:
        # Some cameras answer 401 and name no scheme: they mean basic.
        return basic(login) if "basic" in schemes or not schemes else ""
    answers = (_digest(each, method, url, login) for each in digests_of(challenges))
    return next(filter(None, answers), "")


def _digest(challenge: str, method: str, url: str, login: Login) -> str:
    """Answer to a challenge, empty to one that is not understood."""
    passwords = HTTPPasswordMgrWithDefaultRealm()
    passwords.add_password(None, url, *login)
    request = Request(url, method=method)
    # RTSP's digest is that of the whole URL.
    request.selector = url
    try:
        fields = parse_keqv_list(parse_http_list(challenge.partition(" ")[2]))
        answer = AbstractDigestAuthHandler(passwords).get_authorization(request, fields)
    except (ValueError, IndexError, URLError):
        return ""
    return f"Digest {answer}" if answer else ""
