"""Requests to a virtual IMP and their answers, one JSON object per line.

    {"ask": "ports"}                    {"autopilot": "/tmp/.../autopilot", "lidar": "socket://..."}
    {"ask": "truth", "since": 12.5}     pose, twist, motors, commands (`VirtualImp.truth`)
    {"ask": "status"}                   lateness, CPU time, and counters of the lines
    {"fault": "unplug", "device": "lidar", "seconds": 2}      {} (see `faults`)

The answer to an invalid request is {"error": one line}.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from impslam.component import near_miss
from impslam.errors import ConfigError, ImpError
from impslam.platform.virtual.faults import parse_fault
from impslam.platform.virtual.imp import VirtualImp

Answer = dict[str, Any]


def answer(imp: VirtualImp, line: str) -> str:
    """Process the request in a line, and return the answer as one line."""
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise ConfigError("a request is a JSON object")
        reply = _answer(imp, request)
    except ImpError as error:
        reply = {"error": str(error)}
    except ValueError as error:
        reply = {"error": f"not JSON ({error}); send one object a line"}
    return json.dumps(reply)


def _answer(imp: VirtualImp, request: Mapping[str, Any]) -> Answer:
    if "fault" in request:
        imp.fault(parse_fault(request))
        return {}
    since = request.get("since", 0.0)
    if not isinstance(since, int | float):
        raise ConfigError(f"since = {since!r} is not a time in s")
    queries: dict[str, Callable[[], Answer]] = {
        "ports": lambda: dict(imp.ports()),
        "truth": lambda: imp.truth(since),
        "status": imp.status,
    }
    query = str(request.get("ask"))
    if query not in queries:
        raise ConfigError(f"unknown query {query!r}; {near_miss(query, queries)}")
    return queries[query]()
