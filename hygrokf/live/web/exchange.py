"""Requests and responses of the page's JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from hygrokf.data.structured import JsonObject

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

LARGEST = 4096
"""Largest body of a request [bytes]."""


async def posted_json(request: Request) -> JsonObject:
    """The posted JSON object; empty if the body is no object or too large."""
    from starlette.requests import ClientDisconnect

    body = b""
    try:
        async for part in request.stream():
            body += part
            if len(body) > LARGEST:
                return {}
        found = json.loads(body)
    except (ClientDisconnect, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def reply(
    content: Mapping[str, Any], headers: Mapping[str, str] | None = None, status: int = 200
) -> Response:
    """A JSON response."""
    from starlette.responses import Response

    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"), default=asdict)
    return Response(text, status, {"Content-Type": "application/json", **(headers or {})})


def refusal(status: int, words: str, headers: Mapping[str, str] | None = None) -> Response:
    """A JSON response that says why a request is refused."""
    return reply({"fault": words}, headers, status)
