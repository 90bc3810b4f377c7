"""Access control of the page: a token where other machines can reach it, and no requests from other sites."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
from base64 import b64encode
from dataclasses import dataclass
from hashlib import sha256
from urllib.parse import urlsplit

from aiohttp import web

from swarmtrack.errors import SwarmtrackError

_HOST = re.compile(r"[A-Za-z0-9.\-]+(:\d+)?|\[[0-9a-fA-F:.]+\](:\d+)?")


class AccessError(SwarmtrackError):
    """An address or token that would let anybody in."""


def is_loopback(address: str) -> bool:
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address.strip("[]")).is_loopback
    except ValueError:
        return False


def token_for(address: str, given: str | None) -> str | None:
    """Required token; None: none, on loopback. Raises AccessError."""
    if given is not None:
        if not re.fullmatch(r"[A-Za-z0-9_\-]{8,128}", given):
            raise AccessError("--token: expected 8 to 128 letters, digits, - and _")
        return given
    return None if is_loopback(address) else secrets.token_urlsafe(16)


@dataclass(frozen=True, slots=True)
class AccessGuard:
    """Checks every request."""

    token: str | None
    page: str

    def refuse(self, request: web.Request) -> str | None:
        """Reason for refusal; None: accepted."""
        if _HOST.fullmatch(request.host) is None:
            return "this Host is not an address"
        # A name that another site lets point here would make its page one of ours.
        host = urlsplit(f"//{request.host}").hostname or ""
        if self.token is None and not is_loopback(host):
            return "this monitor answers on this machine only"
        if self.token is not None:
            shown = request.query.get("token", "")
            if not hmac.compare_digest(shown.encode(errors="surrogatepass"), self.token.encode()):
                return "the token is missing or wrong: open the whole address that the monitor printed"
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.host:
            return "a page of another site asks"
        return None

    def headers(self, request: web.Request) -> dict[str, str]:
        """For the page: it runs its own script and style, and speaks to us alone."""
        script, style = (_hash_of(tag, self.page) for tag in ("script", "style"))
        policy = (
            f"default-src 'none'; script-src {script}; style-src {style}; img-src data: blob:; "
            f"connect-src 'self' ws://{request.host} wss://{request.host}; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return {
            "Content-Security-Policy": policy,
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
        }


def _hash_of(tag: str, page: str) -> str:
    match = re.search(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
    assert match is not None, f"the page has a <{tag}>"
    return f"'sha256-{b64encode(sha256(match[1].encode()).digest()).decode()}'"
