"""User and password for an HTTP camera: answers the server's challenge by digest, else by basic authentication.

Nothing is sent before the server asks, so a camera that takes digest never sees the password. aiohttp's middleware
makes the digest. It looks at the first challenge only, and many cameras offer basic first: here the digest's challenge
is picked from all of them, in lines of their own or in one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import aiohttp
from aiohttp import hdrs
from multidict import CIMultiDict, CIMultiDictProxy
from yarl import URL

from swarmtrack.camera_sources.challenges import basic, challenges_of, digests_of, schemes_of

if TYPE_CHECKING:
    from aiohttp.client_middlewares import ClientHandlerType

    from swarmtrack.camera_sources.address import Login


class _Challenged:
    """A response of status 401 with one challenge."""

    def __init__(self, response: aiohttp.ClientResponse, challenge: str) -> None:
        self.response = response
        headers = CIMultiDict(response.headers)
        headers[hdrs.WWW_AUTHENTICATE] = challenge
        self.headers = CIMultiDictProxy(headers)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.response, name)


class LoginMiddleware:
    """Middleware of a client session. schemes: those that the server offered, in lower case; empty before."""

    def __init__(self, login: Login) -> None:
        self.schemes: tuple[str, ...] = ()
        self._login = login
        self._digest = aiohttp.DigestAuthMiddleware(login.user, login.password)
        self._origin: URL | None = None

    async def __call__(
        self, request: aiohttp.ClientRequest, handler: ClientHandlerType
    ) -> aiohttp.ClientResponse:
        self._origin = self._origin or request.url.origin()
        # A redirect to another server gets no login.
        if request.url.origin() != self._origin:
            return await handler(request)

        async def asked(request: aiohttp.ClientRequest) -> aiohttp.ClientResponse:
            response = await handler(request)
            if response.status != 401:
                return response
            response.release()
            lines = response.headers.getall(hdrs.WWW_AUTHENTICATE, [])
            challenges = challenges_of(lines)
            self.schemes = schemes_of(challenges)
            digest = next(iter(digests_of(challenges)), "none")
            return cast(aiohttp.ClientResponse, _Challenged(response, digest))

        response = await self._digest(request, asked)
        if not isinstance(response, _Challenged):
            return response
        if "digest" in self.schemes or ("basic" not in self.schemes and self.schemes):
            return response.response
        # Some cameras answer 401 and name no scheme: they mean basic.
        request.headers[hdrs.AUTHORIZATION] = basic(self._login)
        return await handler(request)
