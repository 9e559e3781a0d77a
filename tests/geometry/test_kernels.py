"""Kernels: where their machine code is kept, and that they run where it cannot be kept."""

import inspect
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numba.core import caching
from numba.core.errors import TypingError

import impslam
from impslam.geometry import machine_code
from impslam.geometry.kernels import kernel

FIT = (
    "import numpy as np; from impslam.geometry.circle_start import taubin as f;"
    "p = np.array([[0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]);"
    "print(round(f(p)[2], 9), f.dispatcher.stats.cache_hits.total())"
)
PRODUCT = """
from impslam.geometry.kernels import kernel

@kernel
def product(A):
    return A @ A
"""


def fit(package: Path, code: str = FIT, **environment: str) -> subprocess.CompletedProcess[str]:
    """Call a kernel in a process of its own."""
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG", "COV"))}
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=plain | {"PYTHONPATH": str(package)} | environment,
    )


def output(code: str, folder: Path) -> str:
    """Return what code prints in a process of its own that imports modules from a folder."""
    return subprocess.run(
        [sys.executable, "-B", "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])},
    ).stdout


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
        first, second = (fit(read_only, **{place: str(home)}) for _ in range(2))
        assert (first.stdout, second.stdout) == ("1.0 0\n", "1.0 1\n")
        assert any(home.rglob("*.nbc"))


def test_without_a_folder_kernels_run_and_warn_once(read_only: Path) -> None:
    said = fit(read_only, XDG_CACHE_HOME="/dev/null/none", HOME="/dev/null/none")
    assert said.stdout == "1.0 0\n"
    assert said.stderr.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in said.stderr


def test_a_full_disk_ends_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    machine_code.warn_once.cache_clear()
    monkeypatch.setattr(caching.IndexDataCacheFile, "save", full)

    @kernel
    def double(x: np.ndarray) -> np.ndarray:
        return 2.0 * x

    np.testing.assert_array_equal(double(np.ones(2)), [2.0, 2.0])
    np.testing.assert_array_equal(double(np.ones((2, 2))), np.full((2, 2), 2.0))
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "No space left on device" in caplog.text


CALLER = """
from {package}.callee import {name}
from impslam.geometry.kernels import kernel

@kernel
def caller(x):
    return {name}(x)
"""
CALLEE = """
from impslam.geometry.kernels import kernel

@kernel
def {name}(x):
    return x + {by}
"""


def test_code_is_recompiled_if_a_called_kernel_has_changed(tmp_path: Path) -> None:
    package = tmp_path / "parts"
    package.mkdir()
    (package / "caller.py").write_text(CALLER.format(package="parts", name="add"))
    for by, hits in ((1.0, 0), (1.0, 1), (2.0, 0)):
        (package / "callee.py").write_text(CALLEE.format(name="add", by=by))
        code = (
            "from parts.caller import caller as f;"
            "print(f(0.0), f.dispatcher.stats.cache_hits.total())"
        )
        assert output(code, tmp_path) == f"{by} {hits}\n"


TYPED = """
from typing import NamedTuple
from impslam.geometry.kernels import kernel

class {name}(NamedTuple):
    x: float

@kernel
def double(pair):
    return 2.0 * pair.x

def call():
    return double({name}(1.0)), double.dispatcher.stats.cache_hits.total()
"""


def test_code_for_types_that_were_renamed_is_compiled_again(tmp_path: Path) -> None:
    """As after an update of this program."""
    (tmp_path / "typed.py").write_text(TYPED.format(name="Old"))
    code = "import typed; print(*typed.call())"
    for name, hits in (("Old", 0), ("Old", 1), ("New", 0), ("New", 1)):
        (tmp_path / "typed.py").write_text(TYPED.format(name=name))
        assert output(code, tmp_path) == f"2.0 {hits}\n"


PAIR = """
from typing import NamedTuple

class Inner(NamedTuple):
    {}: float
    {}: float

class Outer(NamedTuple):
    inner: Inner
"""
READER = """
from __future__ import annotations
from impslam.geometry.kernels import kernel
from pair import Inner, Outer

@kernel
def first(outer: Outer) -> float:
    return outer.inner.first

def call():
    return first(Outer(Inner(first=1.0, last=2.0))), first.dispatcher.stats.cache_hits.total()
"""


def test_code_is_compiled_again_if_fields_of_another_file_are_exchanged(tmp_path: Path) -> None:
    """It would read the other field, because machine code reads fields by index."""
    (tmp_path / "reader.py").write_text(READER)
    code = "import reader; print(*reader.call())"
    for fields, hits in ((("first", "last"), 0), (("first", "last"), 1), (("last", "first"), 0)):
        (tmp_path / "pair.py").write_text(PAIR.format(*fields))
        assert output(code, tmp_path) == f"1.0 {hits}\n"


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_damaged_code_is_compiled_again(tmp_path: Path, suffix: str) -> None:
    """As a power loss leaves it: empty, overwritten, cut."""
    (tmp_path / "typed.py").write_text(TYPED.format(name="Old"))
    code = "import typed; print(*typed.call())"
    assert output(code, tmp_path) == "2.0 0\n"
    for content in (b"", b"damaged", None):
        (file,) = (tmp_path / "__pycache__").glob(f"*.{suffix}")
        file.write_bytes(file.read_bytes()[:-20] if content is None else content)
        assert output(code, tmp_path) == "2.0 0\n"
        assert output(code, tmp_path) == "2.0 1\n"


def test_loaded_code_is_compiled_into_a_new_caller(tmp_path: Path) -> None:
    package = tmp_path / "joined"
    package.mkdir()
    (package / "callee.py").write_text(CALLEE.format(name="add", by=1.0))
    (package / "caller.py").write_text(CALLER.format(package="joined", name="add"))
    hits = "print(add.dispatcher.stats.cache_hits.total())"
    code = "from joined.callee import add; print(add(0.0));" + hits
    more = "from joined.caller import caller, add; print(add(0.0), caller(1.0));" + hits
    for words, expected in ((code, "1.0\n0\n"), (more, "1.0 2.0\n1\n"), (more, "1.0 2.0\n1\n")):
        assert output(words, tmp_path) == expected


PARTS = """
from impslam.geometry.kernels import kernel

@kernel
def root(x):
    if x < 0.0:
        raise ValueError("a negative number", x)
    return x ** 0.5

@kernel
def length(x, y):
    return root(x * x + y * y) if x > 0.0 else root(x)
"""


def test_only_entry_points_have_machine_code(tmp_path: Path) -> None:
    """And an error of a part reaches Python, compiled or loaded."""
    (tmp_path / "lengths.py").write_text(PARTS)
    code = """
from lengths import length, root
print(length(3.0, 4.0), len(root.dispatcher.overloads), length.dispatcher.stats.cache_hits.total())
try:
    length(-1.0, 0.0)
except ValueError as error:
    print(*error.args)
"""
    for hits in (0, 1):
        said = run(code, tmp_path)
        assert said == f"5.0 0 {hits}\na negative number -1.0\n"
    assert [p.name.split("-")[0] for p in tmp_path.rglob("*.nbc")] == ["lengths.length"]
    assert run("from lengths import root; print(root(4.0))", tmp_path) == "2.0\n"
    assert len(list(tmp_path.rglob("*.nbc"))) == 2


def test_only_kernels_that_are_called_have_a_dispatcher(tmp_path: Path) -> None:
    """A part has one while its caller is compiled, and none if the caller's code is loaded."""
    (tmp_path / "lengths.py").write_text(PARTS)
    made = "import lengths as m; print([f._dispatcher is not None for f in (m.root, m.length)])"
    code = f"{made}; m.length(3.0, 4.0); {made.partition('; ')[2]}"
    for root in (True, False):
        assert run(code, tmp_path) == f"[False, False]\n[{root}, True]\n"


def test_threads_that_call_a_kernel_first_share_its_dispatcher() -> None:
    @kernel
    def half(x: float) -> float:
        return 0.5 * x

    with ThreadPoolExecutor(8) as threads:
        dispatchers = {id(made) for made in threads.map(lambda _: half.dispatcher, range(64))}
        assert set(threads.map(half, [3.0] * 64)) == {1.5}
    assert len(dispatchers) == 1


def test_wrong_arguments_are_reported_by_numba() -> None:
    @kernel
    def total(x: float, y: float) -> float:
        return x + y

    with pytest.raises(TypeError, match=r"not enough arguments: expected 2, got 1"):
        total(1.0)
    with pytest.raises(TypingError, match="Failed in nopython mode pipeline"):
        total(1.0, "text")


def test_a_kernel_presents_itself_as_its_function() -> None:
    @kernel
    def named(x: float, y: float) -> float:
        """Say what it does."""
        return x + y

    assert (named.__name__, named.__doc__) == ("named", "Say what it does.")
    assert list(inspect.signature(named).parameters) == ["x", "y"]
    assert named.py_func(1.0, 2.0) == 3.0


def test_without_compiling_a_kernel_is_its_function() -> None:
    code = f"{PARTS}\nprint(type(length).__name__, length(3.0, 4.0))"
    here = Path(impslam.__file__).parents[1]
    assert fit(here, code, NUMBA_DISABLE_JIT="1").stdout == "function 5.0\n"


def test_a_kernel_goes_to_another_process(tmp_path: Path) -> None:
    (tmp_path / "lengths.py").write_text(PARTS)
    code = "import pickle; from lengths import root; print(pickle.dumps(root).hex())"
    there = f"import pickle; print(pickle.loads(bytes.fromhex({run(code, tmp_path)!r}))(4.0))"
    assert run(there, tmp_path) == "2.0\n"


def run(code: str, folder: Path) -> str:
    """Return what a process prints that finds modules and keeps machine code in a folder."""
    paths = os.pathsep.join([str(folder), *sys.path])
    said = subprocess.run(
        [sys.executable, "-B", "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(folder)},
    )
    return said.stdout


def test_loaded_code_imports_no_compiler(tmp_path: Path) -> None:
    """And what is compiled after it can be kept all the same."""
    code = (
        f"{FIT}; import sys;"
        "print('numba.np.arraymath' in sys.modules, 'scipy.linalg' in sys.modules);"
        "from impslam.geometry.circle_start import circle_start as g;"
        "g(p, p, np.nan); print(g.dispatcher.stats.cache_hits.total())"
    )
    for first in (True, False):
        said = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        )
        assert said.stdout == f"1.0 {int(not first)}\n{first} False\n{int(not first)}\n"
        assert said.stderr == ""


def test_a_product_of_matrices_does_not_import_scipys_linear_algebra(tmp_path: Path) -> None:
    """numba's runtime finds BLAS in an extension module that is loaded without its package."""
    (tmp_path / "products.py").write_text(PRODUCT)
    code = (
        "import sys, numpy as np; from products import product;"
        "print(product(2.0 * np.eye(3))[2, 2], 'scipy.linalg' in sys.modules)"
    )
    assert output(code, tmp_path) == "4.0 False\n"
