"""What can be taken home: logs, with resume, also while they are recorded; maps; the picture."""

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
IN_MEMORY = 8 << 20  # bytes of a zip that need no disk
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
    """A file as large as it was when asked for, though it grows while it is sent."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; what was written since is left for the next."""
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
                raise _Sent

        with contextlib.suppress(_Sent):
            await super().__call__(scope, receive, cut)


class _Sent(Exception):  # no error: all that was promised is sent
    """Ends the reading of a file that goes on."""


class _FileEndpoints:
    """Answers requests for files; every name is one that a listing gave, or it is refused."""

    def __init__(self, authenticator: Authenticator, station: Station) -> None:
        self._authenticator, self._station = authenticator, station

    def logs(self, _: Request) -> Response:
        rows = [asdict(log) for log in self._station.store.logs()]
        return JSONResponse([{name: _finite(row[name]) for name in row} for row in rows])

    async def log(self, request: Request) -> Response:
        path = await run_in_threadpool(self._log, request)
        if path is None:
            return self._none(request)
        found = await run_in_threadpool(path.stat)
        return FixedLengthFileResponse(
            path, media_type="application/octet-stream", filename=path.name, stat_result=found
        )

    async def digest(self, request: Request) -> Response:
        """Answer with what `sha256sum -c` reads, of the file as it is now."""
        path = await run_in_threadpool(self._log, request)
        if path is None:
            return self._none(request)
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
            return self._none(request)
        packed = await run_in_threadpool(_packed, folder)
        headers = {"content-disposition": f'attachment; filename="{folder.name}.zip"'}
        return StreamingResponse(_blocks(packed), media_type="application/zip", headers=headers)

    async def picture(self, request: Request) -> Response:
        picture = self._station.picture
        if picture is None:
            return PlainTextResponse("no picture yet\n", 404)
        return Response(picture.data, media_type=_TYPES[picture.format])

    def _log(self, request: Request) -> Path | None:
        """Return the path of the log that is asked for; the store confines it, this looks again."""
        name = request.path_params["name"]
        try:
            path = self._station.store.path(name)
            regular = stat.S_ISREG(path.lstat().st_mode)
        except (ImpError, OSError, ValueError):
            return None
        return path if regular and path.name == name else None

    def _maps(self) -> dict[str, Path]:
        """Return the folders of the maps by name; links and the recycle bin are none."""
        store = self._station.maps
        return {one.name: store.path(one.name) for one in store.maps()}

    def _none(self, request: Request) -> Response:
        self._authenticator.refusals.record(
            address(request), "a file that is not there", request.url.path
        )
        return PlainTextResponse("no such file\n", 404)


def _packed(folder: Path) -> IO[bytes]:
    """Return a zip of the files of one folder, at its beginning."""
    file = tempfile.SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115  # closed once it is sent
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.iterdir()):
            if path.is_file() and not path.is_symlink():
                archive.write(path, f"{folder.name}/{path.name}")
    file.seek(0)
    return file


async def _blocks(file: IO[bytes]) -> AsyncIterator[bytes]:
    with file:
        while block := await run_in_threadpool(file.read, CHUNK):
            yield block


def _finite(value: object) -> object:
    """Return a value that JSON can say; it has no word for what is not known."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
