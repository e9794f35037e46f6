"""Flamenco, Blender's render farm: finds its Manager, and sends it jobs of the type farm/snerg.js over its HTTP API, version 3.

Requests run in threads, so that a Manager that is slow or absent never holds the window.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import platform
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import bpy

from ..core.errors import SnergError
from ..core.progress import Progress
from .preferences import flamenco_url
from .questions import Answer, Questions

SECONDS = 3.0  # to wait for each part of an answer of the Manager
SENDING_SECONDS = 60.0  # the same for a job, which the Manager compiles and stores before it answers
MAX_BYTES = 2**20  # of an answer that are read
JOB_TYPE = "snerg"
SCRIPT = Path(__file__).resolve().parents[1] / "farm" / f"{JOB_TYPE}.js"
LOOPBACK = {"localhost", "127.0.0.1", "::1"}


def manager() -> Answer | None:
    """What is known of the Manager that the preferences name; None where they name none. It is asked once a session, in a thread."""
    url = flamenco_url()
    return _managers.answer(url) if url else None


def ask_again() -> None:
    """Forget what is known of the preferences' Manager, because it may have been started or changed."""
    _managers.forget(flamenco_url())


def check_url(url: str) -> None:
    """Raise SnergError where no Manager can be at a URL, and where Blender may not go there."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise SnergError(f"{url} is no address of a Flamenco Manager; give one such as http://localhost:8080 in the preferences.")
    if parts.hostname not in LOOPBACK and not bpy.app.online_access:
        raise SnergError(f"Blender may not connect to {parts.hostname}; turn on Allow Online Access in Preferences > System.")


def described(url: str, progress: Progress) -> Answer:
    """What the Manager at `url` is. Raises SnergError where none answers."""
    version = request(url, "version")
    name = f"Flamenco Manager {version.get('shortversion') or version.get('version')} at {url}"
    try:
        job_type(url)
    except SnergError as error:
        return Answer(f"{name}: {error}", "unready")
    return Answer(name, "ready")


def job_type(url: str) -> dict[str, Any]:
    """The job type as the Manager has it. Raises SnergError where it has none."""
    try:
        return request(url, f"jobs/type/{JOB_TYPE}")
    except Refused as error:
        if error.code != 404:
            raise
        text = f"It does not know jobs of SNeRG; copy {SCRIPT} into the folder 'scripts' beside the Manager, then ask again."
        raise SnergError(text) from error


def submit(url: str, name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Send a job. Returns {"id", "name", "url", "outside": paths of the settings that lie outside of the shared storage, "storage"}.

    Raises SnergError where the Manager does not answer, does not know the job type, or refuses the job.
    """
    check_url(url)
    system = platform.system().lower()
    job = {"name": name, "type": JOB_TYPE, "type_etag": job_type(url).get("etag", ""), "priority": 50, "settings": dict(settings)}
    sent = request(url, "jobs", {**job, "metadata": {"project": "SNeRG"}, "submitter_platform": system})
    storage = ""
    with contextlib.suppress(SnergError):  # the job is sent; this only adds a warning
        storage = str(request(url, f"configuration/shared-storage/users/{system}").get("location") or "")
    outside = [value for key in ("blendfile", "field", "out") if (value := settings.get(key)) and not inside(value, storage)]
    return {"id": str(sent.get("id", "")), "name": name, "url": url, "storage": storage, "outside": outside if storage else []}


def inside(path: str, folder: str) -> bool:
    """Whether a path lies in a folder."""
    return Path(path).absolute().is_relative_to(Path(folder).absolute()) if folder else False


class Refused(SnergError):
    """The Manager answered with an error. code: of HTTP."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


def request(url: str, path: str, body: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The JSON object that the Manager answers: to a GET, or to a POST of `body`. Raises SnergError where it answers none."""
    data = None if body is None else json.dumps(body).encode()
    asked = urllib.request.Request(f"{url.rstrip('/')}/api/v3/{path}", data, {"Content-Type": "application/json"})
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # a farm is in the house: no proxy leads there
    try:
        with opener.open(asked, timeout=SECONDS if data is None else SENDING_SECONDS) as answer:
            value = json.loads(answer.read(MAX_BYTES))
    except urllib.error.HTTPError as error:
        with error:
            raise Refused(error.code, f"The Flamenco Manager at {url} says: {message(error)}.") from error
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise unanswered(url, error) from error
    if not isinstance(value, dict):
        raise SnergError(f"What answers at {url} is no Flamenco Manager; change the URL in the preferences.")
    return value


def unanswered(url: str, error: Exception) -> SnergError:
    """The error for a Manager that gives no answer."""
    reason = getattr(error, "reason", error)
    return SnergError(f"No Flamenco Manager answers at {url} ({reason}); start it, or change the URL in the preferences.")


def message(error: urllib.error.HTTPError) -> str:
    """What a refusal says: the Manager's own words, or HTTP's."""
    with contextlib.suppress(ValueError, OSError, KeyError, TypeError):
        return str(json.loads(error.read(MAX_BYTES))["message"]).strip().rstrip(".")[:500]
    return f"{error.code} {error.reason}"


_managers = Questions("Asking {} ...", described, "absent", check_url)
poll, stop = _managers.poll, _managers.stop
