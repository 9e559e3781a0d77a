"""Load extension modules of scipy without their packages, whose import costs 0.1 s and 30 MB."""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any


def load(extension: str, public: str) -> Any:
    """Return an extension module such as `scipy.linalg._fblas`, or a public module as a fallback."""
    package, folder, _ = extension.split(".")
    found = importlib.util.find_spec(package)
    places = (found and found.submodule_search_locations) or ()
    spec = PathFinder.find_spec(extension, [str(Path(place, folder)) for place in places])
    # On Windows it needs the libraries that importing scipy registers.
    if sys.platform == "win32" or spec is None or spec.loader is None:
        return importlib.import_module(public)
    if extension not in sys.modules:  # so that a later import of scipy finds it
        sys.modules[extension] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[extension]
