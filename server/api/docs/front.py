"""The page: the files of `server/static`, unchanged."""

from __future__ import annotations

from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles
from starlette.responses import Response

STATIC = Path(__file__).resolve().parents[2] / "static"


class _Files(StaticFiles):
    """Static files that a browser asks for again after each update of the program (by ETag, so mostly 304)."""

    def file_response(self, *args: object, **kwargs: object) -> Response:
        response = super().file_response(*args, **kwargs)  # type: ignore[arg-type]
        response.headers["Cache-Control"] = "no-cache"
        return response


def install(app: FastAPI) -> None:
    """Serve the page at ``/`` and its files below ``/static``."""

    def index() -> FileResponse:
        return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})

    app.add_api_route("/", index, include_in_schema=False, response_class=FileResponse)
    app.mount("/static", _Files(directory=STATIC), name="static")
