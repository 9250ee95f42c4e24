"""Requests that nobody expects: any method, path, headers and body, whether they fit together or not."""

from __future__ import annotations

import numpy as np

PIECES = [
    b"/", b"/api/fleet", b"/api/turbine/", b"/api/alarms", b"/api/alarms/acknowledge", b"/api/login",
    b"/static/", b"/metrics", b"T1", b"..", b"%2e%2e", b"%00", b"%ff", b"%ed%a0%80", b"%", b"?days=", b"&",
    b"\xc3\xa4", b"99999999999999999999", b"-1", b"*", b"http://evil/", b"//", b"#", b";", b"\\", b"'",
    b'"', b"{}", b"a" * 300,
]  # fmt: skip
HEADS = [
    b"Cookie: hygrokf_0=\xff.1", b'Cookie: hygrokf_0="\\777"; $x', b"Cookie: =;;=\x01",
    b"Authorization: Bearer \xff", b"Authorization: \x80", b"Origin: http://[", b"Origin: \xff",
    b"Content-Length: -1", b"Content-Length: 5", b"Content-Length: 99999999999",
    b"Transfer-Encoding: chunked", b"Content-Type: application/json", b"Content-Type: application/json;\xff",
    b"Accept-Encoding: gzip;q=\xff", b"Range: bytes=1-0", b"Range: bytes=-9",
    b"If-Modified-Since: nonsense", b"If-None-Match: \xff", b"Upgrade: websocket\r\nConnection: Upgrade",
    b"Expect: 100-continue", b"X-Forwarded-For: \xff, [", b"Host: evil", b"X: " + b"y" * 2_000, b": x",
    b"\x00: x",
]  # fmt: skip
METHODS = [b"GET", b"POST", b"HEAD", b"PUT", b"OPTIONS", b"CONNECT", b"get", b"\xff"]
VERSIONS = [b"HTTP/1.1", b"HTTP/1.1", b"HTTP/1.0", b"HTTP/9"]
BODIES = [b"", b"{}", b'{"token": "\\ud800"}', b'{"id": "\\udfff", "by": "\\ud800"}', b"\xff\xfe",
          b"5\r\n{}\r\n", b"[" * 3_000, b'{"id": 1e999}', b"zz\r\n"]  # fmt: skip


def malformed_request(random: np.random.Generator) -> tuple[bytes, bytes]:
    """A request drawn by chance: its head, and its body."""
    method = random.choice(METHODS)
    target = b"/" * random.integers(2) + b"".join(random.choice(PIECES, random.integers(1, 4)))
    heads = [b"Host: 127.0.0.1", *random.choice(HEADS, random.integers(0, 4))]
    if random.random() < 0.5:
        heads.append(b"Content-Type: application/json")
    version = random.choice(VERSIONS)
    head = b" ".join([method, target, version]) + b"\r\n" + b"\r\n".join(heads) + b"\r\n\r\n"
    return head, random.choice(BODIES)
