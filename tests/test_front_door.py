"""`import impslam`: what it costs, what it offers, and that its examples run."""

import doctest
import importlib
import os
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import pytest

import impslam
from impslam.config import load
from impslam.errors import ConfigError, ImpError, SourceError
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "room.mcap"
    with McapWriter(path) as writer:
        for message in simulate(load_world("room"), SimulatedRobot(imu=None)):
            writer.write(message)
    return path


def python(code, **variables):
    """Return what a fresh Python prints that has none of the variables for threads but these."""
    free = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    run = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(
        run, env=free | variables, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_alone_imports_no_numpy():
    code = (
        "import sys, impslam; impslam.__all__, impslam.__version__; print('numpy' in sys.modules)"
    )
    assert python(code) == "False"


def test_it_offers_what_it_lists():
    for name in impslam.__all__:
        assert getattr(impslam, name)
    with pytest.raises(AttributeError, match="'impslam' has no attribute 'slma'"):
        _ = impslam.slma


@pytest.mark.parametrize(
    "lines",
    [
        "import impslam; from impslam.run import Run",
        "import impslam, impslam.run; from impslam.run import Run",
        "from impslam.run import Run; import impslam",
        "from impslam import run; from impslam.run import Run; import impslam",
    ],
)
def test_run_is_a_function_and_a_module(lines):
    tell = "print(callable(impslam.run), impslam.run.Run is Run, callable(impslam.run.run))"
    assert python(f"{lines}; {tell}") == "True True True"


def test_a_log_in_a_map_out(log, tmp_path):
    known = impslam.run(str(log), "imp")
    assert known.path().shape == (len(known.stamps), 4)
    assert {mark.kind for mark in known.landmarks} >= {"wall", "cylinder"}
    assert known.grid(0.1).resolution == 0.1
    again = impslam.Map.load(known.save(tmp_path / "office.imp"))
    assert repr(again) == repr(known)
    assert again.about["log"] == "room.mcap"


def test_without_a_config_the_log_names_its_preset(log):
    with_name = impslam.run(log, load("imp"))
    assert impslam.run(log, "imp").path().tobytes() == with_name.path().tobytes()


def test_settings_are_laid_over_the_config(log):
    known = impslam.run(log, "imp", ["start=[1.0, 2.0, 0.0]"])
    assert known.path()[0, 1] == pytest.approx(1.0, abs=0.05)
    assert known.about["config"]["start"] == [1.0, 2.0, 0.0]


def test_progress_is_told_and_never_falls(log):
    told = []
    impslam.run(log, "imp", progress=lambda *where: told.append(where))
    assert len(told) > 1
    assert all(a[0] <= b[0] for a, b in pairwise(told))
    assert told[-1][0] == told[-1][1]


@pytest.mark.parametrize(
    ("given", "config", "settings", "kind", "said"),
    [
        ("gone.mcap", None, (), SourceError, "gone.mcap: no such file"),
        (3, None, (), SourceError, "log = 3: expected the path of a file or folder"),
        (None, "imp", (), SourceError, "log = None"),
        ("log", "ipm", (), ConfigError, "did you mean 'imp'?"),
        ("log", 7, (), ConfigError, "config = 7: expected a preset's name or a file"),
        ("log", "imp", "seed=1", ConfigError, "settings = 'seed=1': expected a list"),
        ("log", "imp", ["sede=1"], ConfigError, "did you mean 'seed'?"),
        ("log", load("imp"), ["seed=1"], ConfigError, "settings apply to a preset or a file"),
        ("log", "default", (), SourceError, "no OdometryPose for odometry 'odometry_pose'"),
    ],
)
def test_what_cannot_be_run_is_told_in_one_line(log, given, config, settings, kind, said):
    with pytest.raises(kind) as error:
        impslam.run(log if given == "log" else given, config, settings)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_text_is_no_log(tmp_path):
    (tmp_path / "notes.mcap").write_text("hello\n")
    with pytest.raises(ImpError, match="no known log format"):
        impslam.run(tmp_path / "notes.mcap")


def modules_with_examples():
    """Return the names of all modules whose docstrings have examples."""
    root = Path(impslam.__file__).parent
    files = [file.relative_to(root) for file in root.rglob("*.py") if ">>> " in file.read_text()]
    names = [("impslam", *file.with_suffix("").parts) for file in files]
    return sorted(".".join(name).removesuffix(".__init__") for name in names)


def test_the_front_door_has_examples():
    assert {"impslam", "impslam.run", "impslam.slam", "impslam.map"} <= {*modules_with_examples()}


@pytest.mark.parametrize("name", modules_with_examples())
def test_the_examples_in_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 2
    assert found.failed == 0


THREADS = """
import threading
import numpy as np
import threadpoolctl
import impslam
from impslam.observers.base import Observer
from impslam.threads import OneBlasThread

def threads():
    return {lib["num_threads"] for lib in threadpoolctl.threadpool_info() if lib["user_api"] == "blas"}

class Watch(Observer):
    seen = set()
    def revise(self, keyframe, revision, path):
        self.seen |= threads()

slam = impslam.Slam("default", observers=[Watch()])
threadpoolctl.threadpool_limits(3, "blas")
slam.add_odometry(0, [0, 0, 0])
slam.add_scans(0, np.full(9, 2.0), np.linspace(-1, 1, 9))
one, two = OneBlasThread(), OneBlasThread()
after = threads()
one.__enter__(); two.__enter__(); one.__exit__()
within = threads()
two.__exit__()
print(Watch.seen, after, within, threads())
"""


def test_blas_has_one_thread_while_a_run_computes_and_its_own_again_after():
    assert python(THREADS) == "{1} {3} {1} {3}"


def test_who_sets_the_number_of_threads_has_chosen():
    assert python(THREADS, OMP_NUM_THREADS="2") == "{3} {3} {3} {3}"
