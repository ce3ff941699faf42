"""The web side: one page, its files, one WebSocket. Runs on its own thread and knows nothing of aircraft.

Files are read into memory once and served by exact name: no path of a request ever reaches the file system.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import mimetypes
from collections.abc import Callable
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Protocol

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from schemas.envelope import DecodeError
from services.station.config import StationConfig
from services.station.guard import COOKIE, HEADERS, Guard
from services.station.outbox import Outbox
from services.station.requests import Request as PageRequest
from services.station.requests import parse

LOG = logging.getLogger(__name__)

_REQUESTS_PER_S = 20.0
_BURST = 40.0
_TRY_LATER = 1013
_REFUSED = 1008

Download = Callable[[], tuple[bytes, str]]
"""Returns a file's bytes and its content type."""


class Ears(Protocol):
    """Who hears what the pages say; called on the web thread, hands over and returns."""

    def opened(self, page: int, address: str) -> None:
        """Hear of a page that was opened."""
        ...

    def closed(self, page: int) -> None:
        """Hear of a page that was closed."""
        ...

    def said(self, page: int, request: PageRequest) -> None:
        """Hear what a page asks for."""
        ...

    def misspoke(self, page: int, why: str) -> None:
        """Hear of what a page sent and should not have."""
        ...


class Site:
    """The application and its open pages. ``latest``, ``each`` and ``one`` may be called from any thread."""

    def __init__(self, config: StationConfig, guard: Guard, ears: Ears) -> None:
        self._config = config
        self._guard = guard
        self._ears = ears
        self.downloads: dict[str, Download] = {}
        """Exports by file name."""
        self._files = dict(_read(files("services.station") / "static", ""))
        self._pages: dict[int, tuple[Outbox, asyncio.Event]] = {}
        self._numbers = itertools.count(1)
        self.loop: asyncio.AbstractEventLoop | None = None
        self.cut_off = 0
        """Browsers that were too slow."""
        routes = [
            Route("/", self._index),
            Route("/static/{name:path}", self._file),
            Route("/inventory/{name}", self._download),
            WebSocketRoute("/ws", self._socket),
        ]
        self.app: ASGIApp = _Shield(Starlette(routes=routes), guard)

    # -- to the pages, from any thread

    def latest(self, key: str, text: str | bytes) -> None:
        """Give every page a frame; an earlier one of the same key that still waits is replaced."""
        self._call(lambda: self._each(lambda box: box.put_latest(key, text)))

    def each(self, text: str) -> None:
        """Give every page a frame, in order."""
        self._call(lambda: self._each(lambda box: box.put(text)))

    def one(self, page: int, text: str | bytes, key: str = "") -> None:
        """Give one page a frame, in order or, with a key, as the latest of it."""
        self._call(lambda: self._one(page, lambda box: box.put_latest(key, text) if key else box.put(text)))

    def _call(self, action: Callable[[], None]) -> None:
        if self.loop is not None and not self.loop.is_closed():
            with contextlib.suppress(RuntimeError):  # closed in between: nobody is there any more
                self.loop.call_soon_threadsafe(action)

    def _each(self, put: Callable[[Outbox], None]) -> None:
        for page in list(self._pages):
            self._one(page, put)

    def _one(self, page: int, put: Callable[[Outbox], None]) -> None:
        entry = self._pages.get(page)
        if entry is not None:
            put(entry[0])
            entry[1].set()

    # -- plain requests

    async def _index(self, request: Request) -> Response:
        token = request.query_params.get("token")
        if token is not None and self._guard.knows(token):
            response = RedirectResponse("/", status_code=303)  # the token leaves address bar and history
            secure = request.url.scheme == "https"
            response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=secure, max_age=30 * 86400)
            return response
        return self._serve("index.html")

    async def _file(self, request: Request) -> Response:
        return self._serve(request.path_params["name"])

    def _serve(self, name: str) -> Response:
        found = self._files.get(name)
        if found is None:
            return PlainTextResponse("there is no such file", status_code=404)
        return Response(found[0], media_type=found[1])

    async def _download(self, request: Request) -> Response:
        name = request.path_params["name"]
        make = self.downloads.get(name)
        if make is None:
            return PlainTextResponse("there is no such export", status_code=404)
        body, kind = await run_in_threadpool(make)
        return Response(body, media_type=kind, headers={"content-disposition": f'attachment; filename="{name}"'})

    # -- the WebSocket

    async def _socket(self, socket: WebSocket) -> None:
        refusal = self._guard.origin_refusal(socket.headers.get("origin"), socket.headers.get("host", ""))
        if refusal or len(self._pages) >= self._config.max_browsers:
            LOG.warning("refused a connection: %s", refusal or f"{len(self._pages)} pages are open already")
            await socket.close(_TRY_LATER if not refusal else _REFUSED)
            return
        await socket.accept()
        page, box, ready = next(self._numbers), Outbox(), asyncio.Event()
        self._pages[page] = (box, ready)
        self._ears.opened(page, socket.client.host if socket.client else "?")
        tasks = {asyncio.create_task(self._send(socket, box, ready)), asyncio.create_task(self._receive(page, socket))}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                if (error := task.exception()) and not isinstance(error, (WebSocketDisconnect, OSError, RuntimeError)):
                    LOG.error("this is a bug: a page's connection failed", exc_info=error)
        finally:
            del self._pages[page]
            self._ears.closed(page)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            with contextlib.suppress(RuntimeError, OSError, WebSocketDisconnect):  # closed already
                await socket.close(_TRY_LATER)

    async def _send(self, socket: WebSocket, box: Outbox, ready: asyncio.Event) -> None:
        while True:
            await ready.wait()
            ready.clear()
            while (frame := box.take()) is not None:
                if isinstance(frame, str):
                    await socket.send_text(frame)
                else:
                    await socket.send_bytes(frame)
            if box.overflowed:
                self.cut_off += 1
                return

    async def _receive(self, page: int, socket: WebSocket) -> None:
        """Hand on what a page says; a page that says too much too fast is cut off."""
        credit, last_s = _BURST, asyncio.get_running_loop().time()
        while True:
            message = await socket.receive()
            if message["type"] != "websocket.receive":
                return
            now_s = asyncio.get_running_loop().time()
            credit, last_s = min(_BURST, credit + (now_s - last_s) * _REQUESTS_PER_S) - 1.0, now_s
            if credit < 0.0:
                self._ears.misspoke(page, "too many requests")
                return
            try:
                text = message.get("text")
                if not isinstance(text, str):
                    raise DecodeError("not text")
                self._ears.said(page, parse(text))
            except DecodeError as error:
                self._ears.misspoke(page, str(error))


class _Shield:
    """Checks host and token of every request and puts the headers on every answer."""

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self._app = app
        self._guard = guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in {"http", "websocket"}:
            return
        headers = {key.decode("latin-1"): value.decode("latin-1") for key, value in scope["headers"]}
        refusal = self._guard.host_refusal(headers.get("host", ""))
        opening = scope["path"] == "/" and b"token=" in scope.get("query_string", b"")
        if not refusal and not self._guard.admits(headers.get("cookie")):
            known = opening and self._opens(scope)
            refusal = "" if known else "open the address with the token that the station told at its start"
        if refusal:
            await self._refuse(scope, receive, send, refusal)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        await self._app(scope, receive, with_headers)

    def _opens(self, scope: Scope) -> bool:
        return self._guard.knows(Request(scope).query_params.get("token"))

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, why: str) -> None:
        client = scope.get("client") or ("?", 0)
        LOG.warning("refused a request from %s: %s", client[0], why)
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": _REFUSED})
            return
        await PlainTextResponse(f"treedock: {why}\n", status_code=403, headers=dict(HEADERS))(scope, receive, send)


def _read(folder: Traversable, prefix: str) -> list[tuple[str, tuple[bytes, str]]]:
    found: list[tuple[str, tuple[bytes, str]]] = []
    for entry in folder.iterdir():
        if entry.is_dir():
            found += _read(entry, f"{prefix}{entry.name}/")
        else:
            kind = mimetypes.guess_type(entry.name)[0] or "application/octet-stream"
            found.append((f"{prefix}{entry.name}", (entry.read_bytes(), kind)))
    return found
