"""Every failure is one line on stderr that says what, where and what to do, and an exit code."""

from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.maps.drawn import mapped
from tests.recognition.plans import OFFICE
from tests.registry import own_registry

import impslam.cli.config
import impslam.cli.reproduce
import impslam.config
import impslam.studies.report
from impslam.errors import SourceError
from impslam.sources.recording import McapWriter
from impslam.types import LaserScan, Message, WheelAngles

COMMANDS = ["demo", "run", "simulate", "inspect", "list", "config", "evaluate"]


def fails(said, *parts: str, code: int = 2) -> None:
    """Check that a command ended with one line that names these parts, and nothing else."""
    assert said.code == code
    assert said.out == "" or said.out.startswith("reads: ")  # which streams of the log are used
    assert said.err.startswith("imp: error: ")
    assert said.err.count("\n") == 1
    assert said.err.endswith("\n")
    for part in parts:
        assert part in said.err


@pytest.mark.parametrize("command", ["run", "inspect"])
def test_missing_log(imp, tmp_path, command) -> None:
    fails(imp(command, tmp_path / "nope.mcap"), "nope.mcap", "check the path")


@pytest.mark.parametrize("command", ["run", "inspect"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01\xfe" * 500, b"{'not': 'a log'}\n" * 20])
def test_files_that_are_no_logs(imp, tmp_path, command, content) -> None:
    log = tmp_path / "bad.log"
    log.write_bytes(content)
    fails(imp(command, log), "bad.log")


@pytest.mark.parametrize("command", ["run", "inspect"])
def test_a_folder_that_is_no_log(imp, tmp_path, command) -> None:
    fails(imp(command, tmp_path), str(tmp_path), "the folder is empty")
    (tmp_path / "notes.txt").write_text("hello\n")
    fails(imp(command, tmp_path), str(tmp_path), "no known log format")


def test_truncated_log(imp, room, tmp_path) -> None:
    log = tmp_path / "cut.mcap"
    log.write_bytes(room.read_bytes()[:20])
    fails(imp("run", log, "-o", tmp_path / "run"), "cut.mcap")


@pytest.mark.parametrize("command", ["run", "inspect"])
@pytest.mark.parametrize("plain", [False, True])
def test_a_log_does_not_choose_which_code_runs(imp, tmp_path, monkeypatch, command, plain) -> None:
    monkeypatch.chdir(tmp_path)
    Path("evil.py").write_text("import pathlib\npathlib.Path('ran').touch()")
    config = 'plugins = ["evil.py"]\nbase = "imp"\n'
    Path("evil.toml").write_text(config)
    with McapWriter(Path("log.mcap"), config if plain else "evil.toml") as writer:
        writer.write(WheelAngles(1.0, 0.0, 0.0))
    said = "plugins = ['evil.py'], which a log may not choose" if plain else "not a shipped one"
    fails(imp(command, "log.mcap"), "log.mcap", said, "with -c")
    assert not Path("ran").exists()
    imp(command, "log.mcap", "-c", "evil.toml")  # which is the user's own word
    assert Path("ran").exists()


@pytest.mark.parametrize(
    "words", [["run", "b\udcff"], ["inspect", "b\udcff"], ["run", "a", "--set", "robot=\udcff"]]
)
def test_names_that_are_not_utf_8(imp, words) -> None:
    fails(imp(*words), "is not UTF-8; rename it")


def test_too_many_arguments(imp, room) -> None:
    fails(imp("run", room, "b.bag"), "imp run takes no further argument, but got b.bag")
    fails(imp("map", "info", "a", "b", "c"), "got b c; see imp map info --help")


def test_too_few_arguments(imp) -> None:
    fails(imp("map", "straighten", "a"), "imp map straighten: --output is missing; see")
    fails(imp("run"), "imp run: LOG is missing; see imp run --help")
    fails(imp("run", "a", "--set"), "imp run: --set needs a value; see imp run --help")


def test_an_unusable_option_names_its_command(imp) -> None:
    fails(imp("map", "info", "a", "--x"), "imp map info: unknown option: --x; see imp map info")
    fails(imp("run", "a", "--seed", "x"), "imp run: invalid value for --seed", "not a whole number")


def test_an_unknown_command(imp) -> None:
    fails(imp("survey"), 'imp: unknown command "survey"; see imp --help')
    fails(imp("map", "infos"), 'imp map: unknown command "infos". Did you mean "info"? See imp map')


def test_unknown_preset(imp, room) -> None:
    fails(imp("run", room, "-c", "imq"), "imq", "did you mean 'imp'?")
    fails(imp("config", "defalt"), "defalt", "did you mean 'default'?")


def test_config_that_is_not_toml(imp, room, tmp_path) -> None:
    file = tmp_path / "own.toml"
    file.write_text("[odometry\n")
    fails(imp("run", room, "-c", file), "own.toml", "not valid TOML")


def test_typo_names_the_near_miss(imp, room) -> None:
    fails(imp("run", room, "--set", "odometry.wheel_radios=0.1"), "wheel_radios", "'wheel_radius'")
    fails(imp("run", room, "--set", "filtr.kind=ekf"), "filtr", "'filter'")
    fails(imp("run", room, "--set", "filter.kind=efk"), "efk", "'ekf'")


def test_wrong_type_and_bounds(imp, room) -> None:
    fails(imp("run", room, "--set", "sensors.lidar.sigma=much"), "sensors.lidar.sigma", "'much'")
    fails(imp("run", room, "--set", "sensors.lidar.sigma=-1"), "sensors.lidar.sigma", "-1")
    fails(imp("run", room, "--set", "seed=soon"), "seed = 'soon': must be a whole number")
    fails(imp("run", room, "--set", "keyframes.distance=-1"), "distance = -1: must be at least 0")


@pytest.mark.parametrize(
    ("setting", "part"),
    [
        ("sensors.lidar=3", "sensors.lidar = 3: expected a table"),
        ("sensors.lidar.extractors.walls=[1]", "walls = [1]: expected a table"),
        ("filter.kind=none", "leave it as it is"),
        ("odometry.slip.forwad=1", "did you mean 'forward'?"),
        ("source.path=x", "source.path"),
        ("start=[nan, 0, 0]", "start.0 = nan"),
        ("start=[1, 2]", "start.2 is missing"),
    ],
)
def test_odd_settings(imp, room, tmp_path, setting, part) -> None:
    fails(imp("run", room, "-o", tmp_path, "--set", setting), part)


def test_a_base_that_is_its_own(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text('base = "b.toml"')
    (tmp_path / "b.toml").write_text('base = "a.toml"')
    fails(imp("config", "a.toml"), "a.toml -> b.toml")


def test_settings_without_a_value(imp, room) -> None:
    fails(imp("run", room, "--set", "seed"), "--set seed", "key=value")
    fails(imp("run", room, "--topic", "scan"), "--topic scan", "role=name")


def test_topics_of_a_log_without_topics(imp, tmp_path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("stamp,x,y,theta,0,1\n0,0,0,0,1,1\n")
    said = imp("run", log, "--topic", "scan=/scan")
    fails(said, "log.csv: logs of kind csv have no topics; leave out --topic")


def test_a_topic_that_is_not_there(imp, room) -> None:
    fails(imp("run", room, "--topic", "scan=/scam"), "/scam", "'/scan'")
    fails(
        imp("run", room, "--topic", "scam=/scan"), "--topic scam: no such role; the roles are scan,"
    )


def test_a_port_without_a_page(imp, room) -> None:
    fails(imp("run", room, "--port", "99999"), "--port is that of the live page; add --live")


def test_usage(imp, room) -> None:
    fails(imp("rum", room), "rum", 'Did you mean "run"? See imp --help')
    fails(imp("run"), "LOG")
    fails(imp("run", room, "--outptu", "x"), "--outptu", "--output")
    fails(imp("run", room, "more"), "more")
    fails(imp("run", room, "--seed", "x"), "--seed")
    fails(imp("simulate", "room"), "--output")


def test_no_folder_for_results(imp, room, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").touch()
    fails(imp("run", room), "runs: cannot be written", "give a folder with -o")


def test_worlds(imp, tmp_path) -> None:
    fails(imp("simulate", "arean", "-o", tmp_path / "x.mcap"), "arean", "'arena'")
    assert list(tmp_path.iterdir()) == []


def write(log: Path, messages: list[Message]) -> Path:
    with McapWriter(log) as writer:
        for message in messages:
            writer.write(message)
    return log


def scans() -> list[Message]:
    angles, none = np.linspace(-1.0, 1.0, 21), np.zeros(21)
    return [LaserScan(10.0 + i, angles, np.full(21, 2.0), none, 0.1, 9.0) for i in range(3)]


def wheels() -> list[Message]:
    return [WheelAngles(10.0 + i, 0.1 * i, 0.1 * i) for i in range(3)]


@pytest.mark.parametrize(
    ("messages", "lacking"), [(scans(), "no WheelAngles"), (wheels(), "no usable scan")]
)
def test_logs_that_lack_something(imp, tmp_path, messages, lacking) -> None:
    log = write(tmp_path / "half.mcap", messages)
    folder = tmp_path / "run"
    fails(imp("run", log, "-o", folder), "half.mcap", lacking, "imp inspect")
    assert not folder.exists()  # nothing is left of a run that came to nothing
    said = imp("inspect", log)
    assert said.code == 0
    assert "problem: 1 x no " in said.out


@pytest.mark.parametrize("reach", [0.0, np.nan, np.inf, 9.5])
def test_a_log_without_a_valid_range(imp, tmp_path, reach) -> None:
    blind = [replace(scan, ranges=np.full(21, reach)) for scan in scans()]
    log = write(tmp_path / "blind.mcap", [*blind, *wheels()])
    folder = tmp_path / "run"
    said = imp("run", log, "-o", folder)
    fails(
        said, "blind.mcap: none of the 3 scans has a valid range", "sensors.*.range_min, range_max"
    )
    assert not folder.exists()
    seeing = write(tmp_path / "seeing.mcap", [*blind[:2], scans()[2], *wheels()])
    assert imp("run", seeing, "-o", folder).code == 0


def test_output_that_is_not_ours(imp, room, tmp_path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    fails(imp("run", room, "-o", tmp_path), "thesis.tex", "new or empty folder")
    fails(imp("run", room, "-o", tmp_path / "thesis.tex"), "is a file")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_output_that_cannot_be_made(imp, brief, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    fails(imp("run", brief, "-o", tmp_path / "file" / "run"), "file")
    fails(imp("simulate", "room", "-o", tmp_path / "file" / "x.mcap"), "file")


def test_output_within_the_log(imp, tmp_path) -> None:
    (tmp_path / "a_motors.txt").write_text("M 0 0 0 0 0 0 0 0 0 0\nM 100 9 0 0 0 9 0 0 0 0\n")
    (tmp_path / "a_scan.txt").write_text("S 0 3 900 900 900\nS 100 3 900 900 900\n")
    fails(imp("run", tmp_path, "-o", tmp_path / "run"), "is inside the input", "another path")
    assert len(list(tmp_path.iterdir())) == 2


def test_debug_shows_where(imp, tmp_path) -> None:
    said = imp("run", tmp_path / "nope", "--debug")
    assert said.code == 2
    assert "Traceback" in said.err
    assert said.err.splitlines()[-1].startswith("imp: error: ")


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (RuntimeError("odd"), 1)])
def test_other_ends(imp, monkeypatch, error, code) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(impslam.config, "load", fail)
    said = imp("config")
    assert said.code == code
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert ("--debug" in said.err) == (code == 1)


def test_help(imp) -> None:
    said = imp("--help")
    assert said.code == 0
    for command in COMMANDS:
        assert command in said.out
        assert imp(command, "--help").code == 0
    assert imp("--version").out == f"{impslam.__version__}\n"


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_help_does_not_wait_for_numpy() -> None:
    code = (
        "import sys; from impslam.cli import main; main(['--help']); print('numpy' in sys.modules)"
    )
    assert python(code).stdout.splitlines()[-1] == "False"


@pytest.mark.parametrize(
    ("asked", "threads"),
    [
        ({}, ["1", "1", "1"]),
        ({"OPENBLAS_NUM_THREADS": "3"}, ["3", "1", "1"]),
        ({"OMP_NUM_THREADS": "2"}, ["2", "2", "2"]),
        ({"OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "4"}, ["2", "4", "2"]),
    ],
)
def test_small_matrices_get_one_thread_unless_more_are_asked_for(
    asked: dict[str, str], threads: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"{library}_NUM_THREADS" for library in ("OPENBLAS", "MKL", "OMP")]
    for name in names:
        monkeypatch.delenv(name, raising=False)
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    code = f"import os, impslam.cli; print([os.environ[name] for name in {names}])"
    assert python(code).stdout == f"{threads}\n"


def ended_without_reader(*words: object, err: bool = False) -> tuple[int, str]:
    """Return the exit code and the messages of a command whose output nobody reads any more."""
    reader, writer = os.pipe()
    os.close(reader)
    code = "from impslam.cli import main; raise SystemExit(main())"
    command = [sys.executable, "-c", code, *map(str, words)]
    errors = writer if err else subprocess.PIPE
    done = subprocess.run(command, stdout=writer, stderr=errors, text=True, check=False)
    os.close(writer)
    return done.returncode, done.stderr or ""


@pytest.mark.parametrize("words", [["list"], ["--help"], ["run", "--help"], ["--version"]])
def test_closed_pipe_is_quiet(words) -> None:
    assert ended_without_reader(*words) == (0, "")


@pytest.mark.parametrize("err", [False, True])
def test_a_command_whose_reader_has_left_does_all_of_its_work(brief, tmp_path, err) -> None:
    assert ended_without_reader("run", brief, "-v", "-o", tmp_path / "run", err=err) == (0, "")
    assert (tmp_path / "run" / "map.imp").exists()


def test_an_error_keeps_its_exit_code_without_a_reader(tmp_path) -> None:
    assert ended_without_reader("run", tmp_path / "nope.mcap", err=True) == (2, "")


def test_log_lines(imp, monkeypatch) -> None:
    def speak(*_: object) -> None:
        for level in (logging.DEBUG, logging.INFO, logging.WARNING):
            logging.getLogger("impslam.sources").log(level, "a %s", "word")
        raise SourceError("the end")

    monkeypatch.setattr(impslam.config, "load", speak)
    warning, end = "imp: warning: a word\n", "imp: error: the end\n"
    assert imp("config").err == warning + end
    assert imp("config", "--quiet").err == end
    assert imp("config", "-v").err == "imp: info: a word\n" + warning + end
    assert imp("config", "--debug").err.startswith("imp: debug: a word\n")


@pytest.mark.timeout(60)
def test_output_reaches_a_pipe_at_once_where_python_is_unbuffered() -> None:
    """As a systemd unit asks for it, so that the journal shows it while the command goes on."""
    code = "import sys; from impslam.cli.pipes import ignore_broken_pipes as o; o(); print('up')"
    code += "; sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline().strip() == b"up"
        process.stdin.close()


@pytest.mark.parametrize(
    "words",
    [
        "demo --seed 1.5",
        "run room.mcap --seed 1.5",
        "run room.mcap --port 80.5",
        "simulate room -o room.mcap --seed 1.5",
        "sweep arena --seeds 1.5",
        "sweep arena --jobs 1.5",
        "tune arena --trials 1.5",
        "tune arena --seeds 1e1",
        "reproduce points --seeds 1.5",
        "robot --virtual --seed 1.5",
        "robot --virtual --port 80.5",
        "map localise map.imp room.mcap --every 150.7",
    ],
)
def test_a_whole_number_is_not_rounded(imp, words) -> None:
    *_, option, value = words.split()
    fails(imp(*words.split()), option, f'"{value}" is not a whole number')


@pytest.mark.parametrize("command", ["robot --virtual", "simulate room -o room.mcap", "demo"])
@pytest.mark.parametrize("seed", [-1, 1 << 63])
def test_an_impossible_seed_is_refused(imp, tmp_path, monkeypatch, command, seed) -> None:
    monkeypatch.chdir(tmp_path)
    fails(imp(*command.split(), "--seed", seed), f'invalid value "{seed}" for --seed')
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_told_with_the_file(imp, tmp_path, monkeypatch) -> None:
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    log, folder = tmp_path / "room.mcap", tmp_path / "report"
    said = "cannot be written (No space left on device); free disk space or give another -o"
    monkeypatch.setattr(McapWriter, "write", full)
    fails(imp("simulate", "room", "-o", log), f"{log}: {said}")
    monkeypatch.setattr(impslam.cli.reproduce, "_study", lambda _: lambda _: None)
    monkeypatch.setattr(impslam.studies.report, "write", full)
    fails(imp("reproduce", "points", "-o", folder), f"{folder}: {said}")
    monkeypatch.setattr(impslam.config, "load", full)  # a file that nothing names
    fails(imp("config"), "No space left on device; free disk space")


@pytest.mark.parametrize(
    ("returned", "named"),
    [
        ('{}["walls"]', "KeyError: 'walls'"),
        ("self._walls", "AttributeError: 'Broken' object has no attribute '_walls'"),  # by pydantic
    ],
)
def test_an_error_of_a_plug_in_names_it(imp, brief, tmp_path, returned, named) -> None:
    plug_in = tmp_path / "mine.py"
    plug_in.write_text(f"""
from impslam.component import register
from impslam.extractors.circle import Circle
@register("broken")
class Broken(Circle):
    def extract(self, scan, rng):
        return {returned}
""")
    parts = (
        "--set",
        f'plugins=["{plug_in}"]',
        "--set",
        "sensors.lidar.extractors.mine.kind=broken",
    )
    with own_registry():
        said = imp("run", brief, "-c", "imp", "-o", tmp_path / "run", *parts)
    where = f"raised by extractor 'broken' of the plug-in {plug_in}, line 7"
    fails(said, f"{named}; {where}", code=1)


@pytest.mark.parametrize(
    ("returned", "named"),
    [
        ("None", "NoneType in place of a list of observations"),
        ("['cylinder']", "str in place of an Observation"),
        ("[seen('cilinder')]", "an observation of 'cilinder', which is no kind of landmark"),
        (
            "[seen(z=[1.0, 0.0])]",
            "a cylinder whose z and R are no arrays of shapes (2,) and (2, 2)",
        ),
        ("[seen(z=np.zeros(3))]", "a cylinder whose z and R are no arrays of shapes (2,)"),
        ("[seen(R=np.eye(3))]", "a cylinder whose z and R are no arrays of shapes (2,)"),
        ("[seen(beams=np.arange(999, 1003))]", "a cylinder with beams 999 to 1002 in a scan of "),
        ("[seen(beams=np.arange(-1, 2))]", "a cylinder with beams -1 to 1 in a scan of "),
        ("[seen(beams=scan.valid)]", "a cylinder whose beams are no array of integers"),
        ("[seen(beams=[1, 2])]", "a cylinder whose beams are no array of integers"),
    ],
)
def test_an_extractor_that_returns_no_observations_is_named(imp, brief, tmp_path, returned, named):
    plug_in = tmp_path / "mine.py"
    plug_in.write_text(f"""
import numpy as np
from impslam.component import register
from impslam.extractors.base import Extractor
from impslam.types import Observation
def seen(kind="cylinder", z=np.ones(2), R=np.eye(2), beams=np.arange(3)):
    return Observation(kind, z, R, beams)
@register("broken")
class Broken(Extractor):
    landmark = "cylinder"
    def extract(self, scan, rng):
        return {returned}
""")
    parts = ("--set", f'plugins=["{plug_in}"]', "--set", "sensors.lidar.extractors.a.kind=broken")
    with own_registry():
        said = imp("run", brief, "-c", "imp", "-o", tmp_path / "run", *parts)
    fails(said, f"error: extractor 'broken' returned {named}")


INPUTS_AS_OUTPUTS = [
    "run log.mcap -o new --mcap log.mcap",
    "run log.mcap -o new --mcap ./link.mcap",
    "run log.mcap --map map.mp4 -o new --video map.mp4",
    "map info map.imp --json map.imp",
    "map info map.png",
    "map diff map.imp map.png --json map.imp",
    "map straighten map.imp -o map.imp",
    "map merge map.imp map.png -o map.png",
    "map localise map.imp places.csv -o .",
    "evaluate true.tum --truth true.tum --json true.tum",
    "evaluate run --json run/map.imp",
    "calibrate log.mcap -c mine.toml -o mine.toml",
    "calibrate log.mcap --json log.mcap",
    "track film.mp4 --setup film.tum -o film.tum",
    "simulate hall.toml -o new.mcap --camera hall.mp4",
]
OTHERS = [  # an output that exists, and is not what the command writes
    "map straighten map.imp -o true.tum",
    "map merge map.imp map.png -o log.mcap",
    "simulate room -o log.mcap",
]


@pytest.mark.parametrize("words", [*INPUTS_AS_OUTPUTS, *OTHERS])
def test_no_command_overwrites_its_inputs_or_foreign_files(
    imp, brief, tmp_path, monkeypatch, words
) -> None:
    monkeypatch.chdir(tmp_path)
    known = mapped(OFFICE, np.zeros((2, 3)))
    for name in ("map.imp", "map.png", "map.mp4"):
        known.save(Path(name))
    (tmp_path / "run").mkdir()
    known.save(Path("run/map.imp"))
    Path("log.mcap").write_bytes(brief.read_bytes())
    Path("link.mcap").symlink_to("log.mcap")
    for name in ("places.csv", "true.tum", "mine.toml", "hall.toml", "film.mp4", "film.tum"):
        Path(name).write_text("0 1 2 0 0 0 0 1\n")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    fails(imp(*words.split()), "give another")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_command_may_replace_its_own_earlier_output(imp, tmp_path) -> None:
    for _ in range(2):
        assert imp("simulate", "room", "-o", tmp_path / "room.mcap").code == 0
