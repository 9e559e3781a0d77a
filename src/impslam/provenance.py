"""The origin of a result: the hash of the log and the versions of the packages."""

from __future__ import annotations

import functools
import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("impslam", "numpy", "numba", "scipy", "opencv-python-headless")


def versions() -> dict[str, str]:
    """Return the versions that a result may depend on: Python, platform and packages."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    return found | {package: _version(package) for package in PACKAGES}


@functools.cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed as a package"


def fingerprint(path: Path) -> str:
    """Return the SHA-256 of a file, or of a folder's files in order of their names."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
