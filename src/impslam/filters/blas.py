"""BLAS and LAPACK of scipy without the rest of `scipy.linalg`, whose import costs a run 0.1 s."""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any


def load(extension: str, public: str) -> Any:
    """Return an extension module of `scipy.linalg` alone, or else the public module around it."""
    name = f"scipy.linalg.{extension}"
    scipy = importlib.util.find_spec("scipy")
    places = (scipy and scipy.submodule_search_locations) or ()
    spec = PathFinder.find_spec(name, [str(Path(place, "linalg")) for place in places])
    # On Windows it needs the libraries that scipy makes known to the system when it is imported.
    if sys.platform == "win32" or spec is None or spec.loader is None:
        return importlib.import_module(f"scipy.linalg.{public}")
    if name not in sys.modules:  # where scipy itself looks for it when it is imported later
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


_blas, _lapack = load("_fblas", "blas"), load("_flapack", "lapack")
dsyrk, dsyr2, dtrsm, dtrsv = _blas.dsyrk, _blas.dsyr2, _blas.dtrsm, _blas.dtrsv
dpotrf = _lapack.dpotrf
