"""`imp reproduce`: chooses experiments, writes one page, pictures and numbers, and refuses what it must."""

import base64
import json
import re
import signal
import subprocess
import sys

import pytest

from impslam.cli import main
from impslam.cli import reproduce as command
from impslam.studies.report import Picture, ResultTable, Section
from impslam.sweeps.job import Job

PNG = b"\x89PNG\r\n\x1a\n and so on"


def double(x):
    return 2 * x


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    """Two experiments that take no time."""

    def toy(name):
        def experiment(job):
            found = job.map(double, range(job.seeds or 3), "doubling")
            shown = ResultTable(
                "Distances", ("what <b>", "m"), [("wall", f"{sum(found)}")], note="a note"
            )
            return Section(
                name,
                f"The {name}",
                "First.\n\nSecond.",
                [shown],
                [Picture(name, PNG, "A & B")],
                {"sum": sum(found)},
                [{"seed": x, "end": y, "missing": ("a", "b")} for x, y in enumerate(found)],
            )

        return experiment

    monkeypatch.setattr(command, "EXPERIMENTS", {"points": ("", 5), "lines": ("", 6)})
    monkeypatch.setattr(command, "_study", toy)


def test_all_is_written_to_one_page_with_pictures_and_numbers(tmp_path, capsys):
    assert main(["reproduce", "-o", str(tmp_path / "out"), "--seeds", "4", "-j", "1"]) == 0
    out = tmp_path / "out"
    assert (out / "points.png").read_bytes() == PNG
    assert json.loads((out / "figures.json").read_text())["lines"] == {"sum": 12}
    runs = (out / "points.csv").read_text().splitlines()
    assert runs[:2] == ["seed,end,missing", "0,0,a;b"]
    assert len(runs) == 5
    text = (out / "report.html").read_text()
    assert re.findall(r"<h2>The (\w+)</h2>", text) == ["points", "lines"]
    assert base64.b64encode(PNG).decode() in text
    assert "what &lt;b&gt;" in text
    assert "A &amp; B" in text
    assert "imp reproduce --seeds 4" in text
    assert "<p>First.</p><p>Second.</p>" in text
    said = capsys.readouterr().out
    assert "wall" in said
    assert "12" in said
    assert "report.html" in said


def test_the_markdown_says_the_same(tmp_path):
    assert main(["reproduce", "points", "--full", "-o", str(tmp_path), "-j", "1", "--quiet"]) == 0
    text = (tmp_path / "report.md").read_text()
    assert "```sh\nimp reproduce points --full\n```" in text
    assert "| what <b> | m |\n| --- | ---: |\n| wall | 20 |" in text
    assert "## The points\n\nFirst.\n\nSecond.\n\n**Distances**" in text
    assert "![points](points.png)\n\nA & B" in text


def test_only_requested_experiments_run_in_the_order_of_the_report(tmp_path):
    assert main(["reproduce", "lines", "points", "-o", str(tmp_path), "-j", "1", "--quiet"]) == 0
    assert list(json.loads((tmp_path / "figures.json").read_text()))[2:] == ["points", "lines"]
    again = ["reproduce", "lines", "-o", str(tmp_path), "-j", "1", "--quiet"]
    assert main(again) == 2
    assert main([*again, "--force"]) == 0
    assert "points" not in json.loads((tmp_path / "figures.json").read_text())
    assert not (tmp_path / "points.png").exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_keeps_the_experiments_that_are_done(
    tmp_path, monkeypatch, capsys, number, code
):
    toy = command._study

    def interrupted(job):
        signal.raise_signal(number)

    monkeypatch.setattr(
        command, "_study", lambda name: interrupted if name == "lines" else toy(name)
    )
    assert main(["reproduce", "-o", str(tmp_path / "out"), "-j", "1"]) == code
    assert "out contains figures.json, report.html, report.md" in capsys.readouterr().err
    facts = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert "points" in facts
    assert facts["partial"] == "Partial: lines missing."
    for name in ("report.html", "report.md"):
        assert "Partial: lines missing." in (tmp_path / "out" / name).read_text()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["pionts"], "no such experiment; did you mean 'points'"),
        (["nothing"], "no such experiment; known: all, "),
        (["points", "--seeds", "0"], "--seeds 0: must be at least 1"),
        (["points", "--seeds", "3", "--full"], "--full and --seeds: give only one of them"),
        (["points", "-j", "-2"], "--jobs -2: must be at least 1"),
    ],
)
def test_unusable_options_are_one_line_errors(words, complaint, tmp_path, capsys):
    assert main(["reproduce", *words, "-o", str(tmp_path / "new")]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_folder_with_other_files_is_rejected(tmp_path, capsys):
    (tmp_path / "letter.txt").write_text("dear")
    assert main(["reproduce", "points", "-o", str(tmp_path)]) == 2
    assert "it contains 'letter.txt'" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["letter.txt"]


def test_work_is_shared_out_in_order_whatever_the_processes():
    steps = []
    job = Job(processes=2, progress=lambda *step: steps.append(step))
    assert job.map(double, range(5), "work") == [0, 2, 4, 6, 8]
    assert steps == [("work", done, 5) for done in range(6)]


def test_other_commands_need_neither_the_studies_nor_the_platform():
    code = (
        "import sys; sys.modules['impslam.studies'] = sys.modules['impslam.platform'] = None\n"
        "import impslam.cli.reproduce; from impslam.cli import main\n"
        "sys.exit(main(['list', 'filter']) or main(['config', 'imp']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
