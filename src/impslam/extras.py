"""What optional parts of the package need, as a command that installs it."""

from __future__ import annotations

import re
import shlex
from importlib.metadata import PackageNotFoundError, requires


def install(*extras: str) -> str:
    """Return the command that installs what these extras of the package need.

    It names the packages, and so works where impslam itself is on no index.
    """
    try:
        needed = requires("impslam") or []
    except PackageNotFoundError:  # run from its sources, without being installed
        needed = []
    wanted = [
        need.split(";")[0].strip()
        for need in needed
        if (extra := re.search(r"extra == ['\"]([\w-]+)['\"]", need)) and extra.group(1) in extras
    ]
    return "pip install " + " ".join(map(shlex.quote, wanted or [f"impslam[{','.join(extras)}]"]))
