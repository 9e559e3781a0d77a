"""Kernels: where their machine code is kept, and that they run where it cannot be kept."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core import caching

import impslam
from impslam.geometry import kernels
from impslam.geometry.kernels import kernel

COMPOSE = (
    "import numpy as np; from impslam.geometry.se2 import _compose as f; "
    "print(f(np.zeros((1, 3)), np.ones((1, 3))).sum(), f.stats.cache_hits.total())"
)


def compose(package: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Call a kernel in a process of its own."""
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG", "COV"))}
    return subprocess.run(
        [sys.executable, "-c", COMPOSE],
        capture_output=True,
        text=True,
        check=True,
        env=plain | {"PYTHONPATH": str(package)} | environment,
    )


@pytest.fixture
def read_only(tmp_path: Path) -> Path:
    """The package where nobody, not even root, can write beside its modules."""
    copy = tmp_path / "impslam"
    shutil.copytree(
        Path(impslam.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__")
    )
    for folder in [copy, *(path for path in copy.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").touch()
    return tmp_path


def test_a_read_only_package_keeps_its_code_with_the_user(read_only: Path, tmp_path: Path) -> None:
    for place in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        home = tmp_path / place
        first, second = (compose(read_only, **{place: str(home)}) for _ in range(2))
        assert (first.stdout, second.stdout) == ("3.0 0\n", "3.0 1\n")
        assert any(home.rglob("*.nbc"))


def test_without_a_folder_kernels_run_and_say_so_once(read_only: Path) -> None:
    said = compose(read_only, XDG_CACHE_HOME="/dev/null/none", HOME="/dev/null/none")
    assert said.stdout == "3.0 0\n"
    assert said.stderr.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in said.stderr


def test_a_full_disk_ends_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    kernels._warn_once.cache_clear()
    monkeypatch.setattr(caching.IndexDataCacheFile, "save", full)

    @kernel
    def double(x: np.ndarray) -> np.ndarray:
        return 2.0 * x

    np.testing.assert_array_equal(double(np.ones(2)), [2.0, 2.0])
    np.testing.assert_array_equal(double(np.ones((2, 2))), np.full((2, 2), 2.0))
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "No space left on device" in caplog.text
