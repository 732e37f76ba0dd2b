"""The command line in a broken environment: one line, a stated exit code, no traceback."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jiggle_mj.cli.running import VERBS
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.scenes import DISTURBANCES, shipped_scenes
from tests.support.tiny_scene import call

COMMAND = [sys.executable, "-m", "jiggle_mj"]
LIMIT_S = 120
"""Time for a command that imports JAX on a busy machine [s]."""


def shell(line: str, *, folder: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a line in bash, in which $J is the command, with other variables than this process has."""
    variables = {**os.environ, "J": " ".join(COMMAND), **environment}
    run = ["bash", "-o", "pipefail", "-c", line]
    return subprocess.run(run, cwd=folder, env=variables, capture_output=True, text=True, timeout=LIMIT_S)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("JAX_PLATFORMS", "banana"),
        pytest.param("JAX_ENABLE_X64", "maybe", marks=pytest.mark.slow),
        pytest.param("XLA_FLAGS", "--xla_no_such_flag=1", marks=pytest.mark.slow),
    ],
)
def test_a_jax_that_does_not_start_is_one_line_with_the_variable(name: str, value: str):
    done = shell("$J effects", **{name: value})
    assert done.returncode == 1 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert name in line and "JAX does not start" in line


def test_a_deleted_working_folder_is_named(tmp_path: Path):
    (tmp_path / "gone").mkdir()
    root = str(Path(__file__).parents[3])
    done = shell('cd gone; rmdir "$PWD"; $J scenes', folder=tmp_path, PYTHONPATH=root)
    assert done.returncode == 2 and "the working folder does not exist" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("redirection", "code", "words"),
    [
        ("| true", 1, "the program that reads the output has ended"),
        ("> /dev/full", 1, "the output: No space left on device"),
        (">&-", 2, "stdout is closed"),
    ],
)
def test_an_output_that_cannot_be_printed_is_said(redirection: str, code: int, words: str):
    done = shell(f"$J scenes --json {redirection}")
    assert done.returncode == code
    (line,) = done.stderr.splitlines()
    assert words in line


def test_without_stderr_the_result_still_comes():
    """The file that is opened next does not take the number of the closed stream. What needs no JAX runs without it."""
    done = shell("$J scenes --json 2>&-", JAX_PLATFORMS="banana")
    assert done.returncode == 0 and len(json.loads(done.stdout)) == len(shipped_scenes())


def test_ctrl_c_during_imports_is_quiet():
    """Sent once Python runs the command's own code, which takes a second or more to import JAX."""
    code = (
        "import sys; sys.argv = ['jiggle-mj', 'effects']; from jiggle_mj.cli import main; print(1, flush=True); main()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, errors) == (130, b"")


@pytest.mark.parametrize(
    ("arguments", "likely"),
    [
        (("recrod", "arc"), "no verb 'recrod'; did you mean 'record'?"),
        (("--verison",), "did you mean '--version'?"),
        (("record", "arc", "--outt", "x"), "no option '--outt'; did you mean '--out'?"),
        (("table", "active", "--sedes", "3", "--out", "x"), "no option '--sedes'; did you mean '--seeds'?"),
        (("record", "ark", "--out", "x"), "no scene named 'ark'; did you mean 'arc'?"),
        ((), "a verb is missing. There are run, record"),
        (("--mask", "m.png", "estimate", "x.mcap"), "--mask stands before the verb; options come after"),
    ],
)
def test_the_likely_word_is_proposed(arguments: tuple[str, ...], likely: str, monkeypatch, capsys):
    assert call(monkeypatch, *arguments) == 2
    assert likely in capsys.readouterr().err


def test_a_truth_that_is_not_there_says_what_writes_it(monkeypatch, capsys, tmp_path):
    assert call(monkeypatch, "score", tmp_path, "--truth", tmp_path / "run.truth.mcap") == 1
    assert "'import' writes one where recording.toml has a [truth]" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize(
    ("verb", "names"),
    [
        ("scenes", shipped_scenes()),
        ("effects", tuple(effect.name for effect in LIBRARY)),
        ("disturbances", tuple(DISTURBANCES)),
    ],
)
def test_what_there_is_is_listed_one_line_each(verb: str, names: tuple[str, ...], monkeypatch, capsys):
    assert call(monkeypatch, verb) == 0
    assert tuple(line.split()[0] for line in capsys.readouterr().out.splitlines()) == names
    assert call(monkeypatch, verb, "--json") == 0
    assert tuple(entry["name"] for entry in json.loads(capsys.readouterr().out)) == names


def test_help_states_the_exit_codes_and_version_prints_it(monkeypatch, capsys):
    assert call(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.startswith("jiggle-mj 0.")
    assert call(monkeypatch, "--help") == 0
    shown = capsys.readouterr().out
    assert "Exit codes: 0 fine; 1 the run failed" in " ".join(shown.replace("│", " ").split())
    assert all(verb in shown for verb in VERBS)
