"""Install commands for the optional extras of the package."""

from __future__ import annotations

import re
import shlex
from importlib.metadata import PackageNotFoundError, requires


def install(*extras: str) -> str:
    """Return the command that installs the requirements of these extras.

    It names the packages, so it works even if impslam itself is on no index.
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
