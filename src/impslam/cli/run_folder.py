"""The folder of `-o`: a new one, or one that replaces an earlier run once the new run is complete."""

from __future__ import annotations

import time
from collections.abc import Iterator, Set
from contextlib import contextmanager, suppress
from pathlib import Path

from impslam.errors import ConfigError, ImpError, SourceError
from impslam.paths import exchange, make_folder, written

INITIAL_FILES = frozenset({"summary.json"})
"""Written before the first scan."""
LIVE_FILES = frozenset({"trajectory.live.tum", "truth.tum"})
"""Written during the run."""
RUN_FILES = (
    INITIAL_FILES
    | LIVE_FILES
    | frozenset(
        {"trajectory.tum", "odometry.tum", "trajectory.csv", "landmarks.csv", "map.pgm", "map.yaml"}
        | {"map.imp", "graph.g2o", "report.html", "report.png", "config.toml"}
        | {"truth.landmarks.csv"}
    )
)
"""All files of a run; only these are ever replaced or removed."""
RUN_MARKER = "trajectory.tum"
"""A folder with this file holds a run, whatever else is in it."""


@contextmanager
def run_folder(
    wanted: Path | None,
    name: str,
    *,
    force: bool = False,
    results: Set[str] = RUN_FILES,
    also: Set[str] = frozenset(),
    marker: str = RUN_MARKER,
) -> Iterator[Path]:
    """Yield the folder to write a run to; when the block has succeeded, the run is in `wanted`.

    If `wanted` is None, the folder is a new one in runs/. With `force`, the run may replace an earlier
    one, which is left unchanged if the block fails. The folder of a failed block is kept if it holds
    any of the `results`, and a note on the error names it. `also` are further files of the command.

    Raises
    ------
    ConfigError
        If the path is a file, a folder that holds a run (without `force`), or one that holds anything
        else.
    """
    own = results | also
    replaced = _replaced(wanted, own, marker, force=force)
    new = wanted is None or not wanted.exists()
    folder = _choose(wanted, name, replaced)
    try:
        yield folder
    except BaseException as error:
        if kept := _kept(folder, results, error):
            error.add_note(kept + (f"; {wanted} is unchanged" if replaced else ""))
        elif folder.is_dir():
            _remove(folder, own)
            if (new or replaced) and not any(folder.iterdir()):
                folder.rmdir()
        raise
    if replaced is not None:
        _replace(replaced, folder, own)


def _replaced(wanted: Path | None, own: Set[str], marker: str, *, force: bool) -> Path | None:
    """Return the folder of the run to replace, or None if there is none."""
    if wanted is None or not wanted.exists():
        return None
    if not wanted.is_dir():
        raise ConfigError(f"{wanted}: is a file; give -o a folder")
    names = {path.name for path in wanted.iterdir()}
    if not names:
        return None
    if names - own and marker not in names:
        raise ConfigError(
            f"{wanted}: is not the folder of a run (it contains {min(names - own)!r}); "
            "give -o a new or empty folder"
        )
    if not force:
        raise ConfigError(f"{wanted}: contains a run; replace it with --force, or give another -o")
    folder = wanted.resolve()
    if Path.cwd().is_relative_to(folder):
        raise ConfigError(f"{wanted}: is the current folder; run the command from another one")
    return folder


def _choose(wanted: Path | None, name: str, replaced: Path | None) -> Path:
    """Return the folder to write to."""
    if wanted is None:
        return default_folder(name)
    return wanted if replaced is None else make_folder(replaced.parent, f"{replaced.name}-partial")


def default_folder(name: str) -> Path:
    """Make the folder runs/NAME-DATE-TIME for a command without -o."""
    runs = Path("runs")
    with written(runs, "give a folder with -o", ConfigError):
        return make_folder(runs, f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")


def _kept(folder: Path, results: Set[str], error: BaseException) -> str:
    """Return a note on the results of a failed block, or "" if there are none to keep.

    The live path of an unusable log is not kept.
    """
    files = {path.name: path for path in map(folder.joinpath, results) if path.is_file()}
    unusable = isinstance(error, SourceError)
    useful = files.keys() - INITIAL_FILES - (LIVE_FILES if unusable else set())
    if not any(files[name].stat().st_size for name in useful):
        return ""
    if "map.imp" in files:
        partial = _is_partial(files["map.imp"])
        words = "map up to here, marked as partial" if partial else "complete map"
        return f"{folder} contains the {words}"
    return f"{folder} contains {', '.join(sorted(useful))}"


def log_stem(log: Path) -> str:
    """Return the name of a log without its endings."""
    return log.resolve().name.split(".")[0] or "log"


def _is_partial(file: Path) -> bool:
    """Return whether a map is one of a part of a log; that of a run whose export failed is not."""
    from impslam.maps.archive import about  # only needed here

    with suppress(ImpError):
        return bool(about(file).get("partial"))
    return True


def _replace(old: Path, new: Path, own: Set[str]) -> None:
    """Replace an earlier run by a new one, and keep the other files of the old folder."""
    exchange(old, new)
    _remove(new, own)
    for path in new.iterdir():
        path.rename(old / path.name)
    new.rmdir()


def _remove(folder: Path, own: Set[str]) -> None:
    """Remove the files of a run."""
    for name in own:
        (folder / name).unlink(missing_ok=True)
