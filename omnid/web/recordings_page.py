"""The addresses of the recordings on this machine and of the reports about them."""

from __future__ import annotations

import asyncio

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route

from omnid.errors import OmnidError
from omnid.web.guard import REPORT_POLICY
from omnid.web.recordings import Recordings


def recordings_routes(recordings: Recordings) -> list[BaseRoute]:
    """Return the addresses."""

    async def list_all(_: Request) -> Response:
        return JSONResponse(await asyncio.to_thread(recordings.described))

    async def report(request: Request) -> Response:
        """POST: make the report, answered when it is ready; GET: show it."""
        try:
            page = await recordings.report(request.path_params["key"])
        except OmnidError as error:
            return JSONResponse({"done": False, "text": str(error)}, 409)
        if request.method == "POST":
            return JSONResponse({"done": True, "text": ""})
        return FileResponse(page, media_type="text/html", headers={"Content-Security-Policy": REPORT_POLICY})

    return [Route("/recordings", list_all), Route("/recordings/{key}/report", report, methods=["GET", "POST"])]
