"""Shell completion: a script that the shell loads, and that knows the commands."""

import shutil
import subprocess

import pytest
from cyclopts.completion import detect


def test_bash_completes_commands_and_options(imp, tmp_path, monkeypatch) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs bash")
    monkeypatch.setenv("HOME", str(tmp_path))
    said = imp("--install-completion", "--shell", "bash")
    script = tmp_path / ".local/share/bash-completion/completions/imp"
    assert said.code == 0
    assert str(script) in said.out
    assert str(script) in (tmp_path / ".bashrc").read_text()

    def completed(*words: str) -> set[str]:
        asked = f"COMP_WORDS=({' '.join(words)} ''); COMP_CWORD={len(words)}"
        code = f'. {script}; {asked}; _imp; printf "%s\\n" "${{COMPREPLY[@]}}"'
        done = subprocess.run([bash, "-c", code], capture_output=True, text=True, check=True)
        return set(done.stdout.split())

    assert {"run", "inspect", "map"} <= completed("imp")
    assert {"info", "merge"} <= completed("imp", "map")


def test_a_shell_that_is_not_known_is_an_error(imp, monkeypatch) -> None:
    def fail() -> None:
        raise detect.ShellDetectionError

    monkeypatch.setattr(detect, "detect_shell", fail)
    said = imp("--install-completion")
    assert said.code == 2
    assert said.err.startswith("imp: error: ")
    assert "--shell bash" in said.err
