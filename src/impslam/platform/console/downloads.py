"""Downloads: logs, with resume, even while they are recorded; maps; the camera picture."""

from __future__ import annotations

import contextlib
import hashlib
import math
import stat
import tempfile
import zipfile
from collections.abc import AsyncIterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, Final

import anyio
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Route
from starlette.types import Message, Receive, Scope, Send

from impslam.errors import ImpError
from impslam.platform.console.authenticator import Authenticator
from impslam.platform.console.login import address
from impslam.platform.station.station import Station

CHUNK = 1 << 20  # bytes read at a time
MAX_MEMORY = 8 << 20  # bytes of a zip that are kept in memory, not on the disk
_TYPES: Final = {"jpeg": "image/jpeg", "png": "image/png"}


def routes(authenticator: Authenticator, station: Station | None) -> Sequence[Route]:
    """Return `/logs`, `/logs/NAME`, `/logs/NAME.sha256`, `/maps`, `/maps/NAME.zip`, `/camera.jpg`."""
    if station is None:
        return []
    endpoints = _FileEndpoints(authenticator, station)
    return [
        Route("/logs", endpoints.logs),
        Route("/logs/{name}.sha256", endpoints.digest),
        Route("/logs/{name}", endpoints.log),
        Route("/maps", endpoints.maps),
        Route("/maps/{name}.zip", endpoints.map),
        Route("/camera.jpg", endpoints.picture),
    ]


class FixedLengthFileResponse(FileResponse):
    """A file with its size at the time of the request, even if it grows while it is sent."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, without what is written after it."""
        left = 0

        async def cut(message: Message) -> None:
            nonlocal left
            if message["type"] == "http.response.start":
                left = int(dict(message["headers"])[b"content-length"])
                await send(message)
                return
            body = message["body"][:left]
            left -= len(body)
            more = message.get("more_body", False) and left > 0
            await send({**message, "body": body, "more_body": more})
            if message.get("more_body", False) and not more:
                raise _AllSent

        with contextlib.suppress(_AllSent):
            await super().__call__(scope, receive, cut)


class _AllSent(Exception):  # not an error: the promised length is sent
    """Ends the reading of a growing file."""


class _FileEndpoints:
    """Answers requests for files, only with names of the listings."""

    def __init__(self, authenticator: Authenticator, station: Station) -> None:
        self._authenticator, self._station = authenticator, station

    def logs(self, _: Request) -> Response:
        rows = [asdict(log) for log in self._station.store.logs()]
        return JSONResponse([{name: _finite(row[name]) for name in row} for row in rows])

    async def log(self, request: Request) -> Response:
        path = await run_in_threadpool(self._log, request)
        if path is None:
            return self._not_found(request)
        found = await run_in_threadpool(path.stat)
        return FixedLengthFileResponse(
            path, media_type="application/octet-stream", filename=path.name, stat_result=found
        )

    async def digest(self, request: Request) -> Response:
        """Answer with a line for `sha256sum -c`, of the present file."""
        path = await run_in_threadpool(self._log, request)
        if path is None:
            return self._not_found(request)
        if request.method == "HEAD":
            return PlainTextResponse("")
        digest = hashlib.sha256()
        async with await anyio.open_file(path, "rb") as file:
            while block := await file.read(CHUNK):
                digest.update(block)
        return PlainTextResponse(f"{digest.hexdigest()}  {path.name}\n")

    def maps(self, _: Request) -> Response:
        names = sorted(self._maps(), reverse=True)
        return JSONResponse([{"name": name, "zip": f"/maps/{name}.zip"} for name in names])

    async def map(self, request: Request) -> Response:
        maps = await run_in_threadpool(self._maps)
        folder = maps.get(request.path_params["name"])
        if folder is None:
            return self._not_found(request)
        try:
            zipped = await run_in_threadpool(_zipped, folder)
        except FileNotFoundError:  # it was deleted meanwhile
            return self._not_found(request)
        headers = {"content-disposition": f'attachment; filename="{folder.name}.zip"'}
        return StreamingResponse(_blocks(zipped), media_type="application/zip", headers=headers)

    async def picture(self, request: Request) -> Response:
        picture = self._station.picture
        if picture is None:
            return PlainTextResponse("no picture yet\n", 404)
        return Response(picture.data, media_type=_TYPES[picture.format])

    def _log(self, request: Request) -> Path | None:
        """Return the path of the requested log, checked here in addition to the store."""
        name = request.path_params["name"]
        try:
            path = self._station.store.path(name)
            regular = stat.S_ISREG(path.lstat().st_mode)
        except (ImpError, OSError, ValueError):
            return None
        return path if regular and path.name == name else None

    def _maps(self) -> dict[str, Path]:
        """Return the folders of the maps by name, without links and the recycle bin."""
        store, found = self._station.maps, dict[str, Path]()
        for one in store.maps():
            with contextlib.suppress(ImpError):  # it was deleted meanwhile
                found[one.name] = store.path(one.name)
        return found

    def _not_found(self, request: Request) -> Response:
        self._authenticator.refusals.record(
            address(request), "a file that is not there", request.url.path
        )
        return PlainTextResponse("no such file\n", 404)


def _zipped(folder: Path) -> IO[bytes]:
    """Return a zip of the files of a folder, positioned at its beginning.

    Hidden files are left out: a save that is under way writes them, and removes them at its end.
    """
    file = tempfile.SpooledTemporaryFile(MAX_MEMORY)  # noqa: SIM115  # closed once it is sent
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.iterdir()):
            if path.is_file() and not path.is_symlink() and not path.name.startswith("."):
                archive.write(path, f"{folder.name}/{path.name}")
    file.seek(0)
    return file


async def _blocks(file: IO[bytes]) -> AsyncIterator[bytes]:
    with file:
        while block := await run_in_threadpool(file.read, CHUNK):
            yield block


def _finite(value: object) -> object:
    """Return a value as JSON can represent it: NaN and infinity become None."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
