"""Serve the status page of a run, with health, metrics and pictures."""

import json
import threading
import time
from contextlib import suppress
from datetime import UTC, datetime
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from stream_dmr.errors import ConfigError, UserError
from stream_dmr.files import read_secret
from stream_dmr.lengths.fate import FATE_OF_ZONE
from stream_dmr.pipeline.config import WatchSettings
from stream_dmr.sources.positions import COUNTED
from stream_dmr.tables import utc_text
from stream_dmr.web.run_state import MeasuredFrame, RunState, make_registry
from stream_dmr.web.token_server import (
    Request,
    Response,
    Route,
    TokenServer,
    is_loopback,
    json_response,
)

_MAX_SIDE_PX = 960
_ACCEPTED_BGR, _REFUSED_BGR = (90, 230, 90), (60, 140, 255)
_JPEG_QUALITY = 75


def draw_fish(measured: MeasuredFrame) -> UInt8[np.ndarray, "H W 3"]:
    """The frame, at most 960 px long, with head, center, tail and length of each fish."""
    image = measured.frame.image
    scale = min(1.0, _MAX_SIDE_PX / max(image.shape[:2]))
    drawn = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for fish in measured.fish:
        if fish.keypoints_px is None:
            continue
        points = np.round(fish.keypoints_px * scale).astype(np.int32)
        colour = _ACCEPTED_BGR if fish.accepted else _REFUSED_BGR
        cv2.polylines(drawn, [points], isClosed=False, color=colour, thickness=3)
        for point in points:
            cv2.circle(drawn, point.tolist(), 4, colour, thickness=-1)
        length_mm = measured.lengths_mm.get(fish.track_id)
        text = f"{fish.track_id}" if length_mm is None else f"{fish.track_id}: {length_mm:.0f} mm"
        at = int(points[0, 0]) + 8, int(points[0, 1])
        for colour, width in (((0, 0, 0), 6), ((255, 255, 255), 2)):
            cv2.putText(drawn, text, at, cv2.FONT_HERSHEY_SIMPLEX, 1.0, colour, width, cv2.LINE_AA)
    return drawn


def encode_jpeg(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


_PICTURE_INTERVAL_S = 0.5  # requests within it get the same picture: measuring must stay fast
_MIN_TOKEN_CHARACTERS = 16


class WatchServer(TokenServer):
    """Serves a run."""

    max_body_bytes = 1000
    setting = "host or port of [watch]"

    def __init__(self, state: RunState, settings: WatchSettings) -> None:
        """Raises ConfigError if other machines need no token, and OutputError for the port."""
        self._state = state
        registry = make_registry(state)
        self._picture_lock = threading.Lock()
        self._picture, self._picture_until_s = b"", 0.0
        routes: dict[tuple[str, str], Route] = {
            ("GET", "/"): lambda _: _page("page.html"),
            ("GET", "/zones"): lambda _: _page("zones.html"),
            ("GET", "/zones.json"): lambda _: json_response(zones_json(state)),
            ("GET", "/status.json"): lambda _: json_response(status_json(state)),
            ("GET", "/picture.jpg"): lambda _: Response(self._latest_picture(), "image/jpeg"),
            ("GET", "/metrics"): lambda _: Response(generate_latest(registry), CONTENT_TYPE_LATEST),
            ("GET", "/health"): self._health,
            ("POST", "/haul"): self._haul,
        }
        super().__init__((settings.host, settings.port), routes, token=_read_token(settings))

    def _health(self, _: Request) -> Response:
        health = health_json(self._state)
        code = HTTPStatus.OK if health["healthy"] else HTTPStatus.SERVICE_UNAVAILABLE
        return json_response(health, code)

    def _haul(self, request: Request) -> Response:
        if self._state.hauls is None:
            raise UserError("expected a run that takes hauls")
        submitted = None
        with suppress(ValueError, RecursionError):
            submitted = json.loads(request.body)
        if not isinstance(submitted, dict):
            got = request.body.decode(errors="replace")
            raise UserError(
                f"expected a haul as a JSON object with what, name, said_by, got {got!r}"
            )
        keys = ("what", "name", "said_by")
        what, name, said_by = (str(submitted.get(key) or "") for key in keys)
        return json_response({"name": self._state.hauls.mark(what, name, said_by=said_by)})

    def _latest_picture(self) -> bytes:
        """The latest measured frame as JPEG; empty before the first."""
        with self._picture_lock:
            if time.monotonic() >= self._picture_until_s:
                measured = self._state.latest_frame()
                self._picture = b"" if measured is None else encode_jpeg(draw_fish(measured))
                self._picture_until_s = time.monotonic() + _PICTURE_INTERVAL_S
            return self._picture


def _page(name: str) -> Response:
    return Response(files("stream_dmr.web").joinpath("watch", name).read_bytes())


def _read_token(settings: WatchSettings) -> str:
    """The token that readers need; "" if the server is for this machine alone."""
    if not settings.token_file:
        if is_loopback(settings.host):
            return ""
        raise ConfigError(
            f"[watch] host = {settings.host!r}: expected a token_file beside it, since others can "
            "reach this address; make one with: openssl rand -hex 16 > token"
        )
    token = read_secret(Path(settings.token_file), where="[watch] token_file")
    if len(token) < _MIN_TOKEN_CHARACTERS:
        raise ConfigError(
            f"[watch] token_file: expected a token of {_MIN_TOKEN_CHARACTERS} characters or more, "
            f"got {len(token)}; make one with: openssl rand -hex 16"
        )
    return token


def zones_json(state: RunState) -> dict[str, Any]:
    """The zones of the run by their names in config.toml, and the size of its frames, px."""
    zones = {name: getattr(state.zones, name) for name in FATE_OF_ZONE}
    return {"size": [state.source.width, state.source.height], "zones": zones}


def health_json(state: RunState) -> dict[str, Any]:
    """The health of a run, its problems and warnings, and the state of each of its outputs."""
    problems = state.problems()
    sinks = [
        {
            "name": sink.name,
            "state": "fails" if sink.is_failing else "works",
            "since": datetime.fromtimestamp(sink.since_ns / 1e9, UTC).isoformat(),
            "last_error": sink.last_error,
        }
        for sink in state.sinks.all()
    ]
    return {
        "healthy": not problems,
        "problems": problems,
        "warnings": _warnings_json(state),
        "sinks": sinks,
        "positions": positions_json(state),
    }


def positions_json(state: RunState) -> dict[str, Any] | None:
    """The last position, and counts of the receiver; None for a run without positions."""
    if state.positions is None:
        return None
    last, counts = state.position, state.positions.counts
    return {
        "latitude": None if last is None else last.latitude,
        "longitude": None if last is None else last.longitude,
        "speed_knots": None if last is None else last.speed_knots,
        "utc": None if last is None else utc_text(last.utc_ns),
        "left_out": counts.left_out(),
        "counts": {name: getattr(counts, name) for name in COUNTED},
    }


def _warnings_json(state: RunState) -> list[dict[str, Any]]:
    """The warnings, the latest first; `age_s`: seconds since a warning last came."""
    now_s = time.monotonic()
    return [
        {"line": warning.line, "count": warning.count, "age_s": now_s - warning.last_s}
        for warning in state.warnings()
    ]


def status_json(state: RunState) -> dict[str, Any]:
    haul = None if state.hauls is None else state.hauls.current()
    return {
        "problems": state.problems(),
        "num_fish": sum(state.num_fish.values()),
        "species": dict(state.species.most_common()),
        "fates": dict(state.fates.most_common()),
        "fish_per_hour": state.fish_per_hour(),
        "positions": positions_json(state),
        # None if the run takes no hauls; the name is "" between hauls
        "haul": None if state.hauls is None else {"name": "" if haul is None else haul.name},
        "frames_per_s": state.frames_per_s(),
        "last_frame_age_s": state.last_frame_age_s(),
        "fish": [
            {
                "track_id": fish.track_id,
                "length": "-" if fish.length_mm is None else f"{fish.length_mm / 10:.1f} cm",
                "note": fish.status
                if fish.ci95_mm is None
                else "{:.1f} to {:.1f} cm".format(*fish.ci95_mm / 10),
                "kind": ", ".join(text for text in (fish.species_code, fish.fate) if text),
            }
            for fish in reversed(list(state.finished))
        ],
        "warnings": _warnings_json(state),
    }
