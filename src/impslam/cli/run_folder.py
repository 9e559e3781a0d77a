"""The folder of `-o`: new, or put in the place of an earlier run once the new one is complete."""

from __future__ import annotations

import time
from collections.abc import Iterator, Set
from contextlib import contextmanager
from pathlib import Path

from impslam.errors import ConfigError, SourceError
from impslam.paths import exchange, make_folder

BEGUN = frozenset({"summary.json"})
"""Written before the first scan."""
LIVE = frozenset({"trajectory.live.tum", "truth.tum"})
"""Written while the robot drives."""
FILES = (
    BEGUN
    | LIVE
    | frozenset(
        {"trajectory.tum", "odometry.tum", "trajectory.csv", "landmarks.csv", "map.pgm", "map.yaml"}
        | {"map.imp", "graph.g2o", "report.html", "report.png", "config.toml"}
        | {"truth.landmarks.csv"}
    )
)
"""What a run writes; only such files are ever replaced or removed."""
MARK = "trajectory.tum"
"""Where this is, a run is, whatever else the folder holds."""


@contextmanager
def run_folder(
    wanted: Path | None,
    name: str,
    *,
    force: bool = False,
    results: Set[str] = FILES,
    also: Set[str] = frozenset(),
    mark: str = MARK,
) -> Iterator[Path]:
    """Give the folder to write a run to; when the block has ended well, the run is in `wanted`.

    Without a wish it is a new one under runs/. With `force` the run may replace an earlier one, which
    stays as it is if the block fails. A block that fails keeps its folder if it holds any of the
    `results`, and a note of the error says where. `also` are further files that the command writes.

    Raises
    ------
    ConfigError
        If the path is a file, a folder that holds a run (without `force`), or one that holds anything
        else.
    """
    own = results | also
    replaced = _replaced(wanted, own, mark, force=force)
    new = wanted is None or not wanted.exists()
    folder = _choose(wanted, name, replaced)
    try:
        yield folder
    except BaseException as error:
        if kept := _kept(folder, results, error):
            error.add_note(kept + (f"; {wanted} is as it was" if replaced else ""))
        elif folder.is_dir():
            _remove(folder, own)
            if (new or replaced) and not any(folder.iterdir()):
                folder.rmdir()
        raise
    if replaced is not None:
        _replace(replaced, folder, own)


def _replaced(wanted: Path | None, own: Set[str], mark: str, *, force: bool) -> Path | None:
    """Return the folder of the run that is to be replaced, None where there is none."""
    if wanted is None or not wanted.exists():
        return None
    if not wanted.is_dir():
        raise ConfigError(f"{wanted}: is a file; give -o a folder")
    names = {path.name for path in wanted.iterdir()}
    if not names:
        return None
    if names - own and mark not in names:
        raise ConfigError(
            f"{wanted}: is not the folder of a run (it contains {min(names - own)!r}); "
            "give -o a new or an empty one"
        )
    if not force:
        raise ConfigError(f"{wanted}: holds a run; --force replaces it, or give another -o")
    folder = wanted.resolve()
    if Path.cwd().is_relative_to(folder):
        raise ConfigError(f"{wanted}: is the current folder; replace it from another one")
    return folder


def _choose(wanted: Path | None, name: str, replaced: Path | None) -> Path:
    """Return the folder to write to."""
    if wanted is None:
        return make_folder(Path("runs"), f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
    return wanted if replaced is None else make_folder(replaced.parent, f"{replaced.name}-partial")


def _kept(folder: Path, results: Set[str], error: BaseException) -> str:
    """Return what a block that has failed leaves, "" for nothing.

    Of a log that cannot be used the live path is nothing.
    """
    files = {path.name: path for path in map(folder.joinpath, results) if path.is_file()}
    worth = files.keys() - BEGUN - (LIVE if isinstance(error, SourceError) else set())
    if not any(files[name].stat().st_size for name in worth):
        return ""
    if "map.imp" in files:
        return f"{folder} holds what was mapped by then, marked as partial"
    return f"{folder} holds {', '.join(sorted(worth))}"


def _replace(old: Path, new: Path, own: Set[str]) -> None:
    """Put a run in the place of an earlier one; what the old folder held besides moves over."""
    exchange(old, new)
    _remove(new, own)
    for path in new.iterdir():
        path.rename(old / path.name)
    new.rmdir()


def _remove(folder: Path, own: Set[str]) -> None:
    """Remove what a run has written."""
    for name in own:
        (folder / name).unlink(missing_ok=True)
