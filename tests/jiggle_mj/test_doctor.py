"""The environment check reports what is installed, what is wrong and what to do about it."""

import os
import re
import sys

import numpy
import pytest

from jiggle_mj import doctor


@pytest.fixture(scope="module")
def checks() -> list[doctor.Check]:
    """The checks of this machine."""
    return doctor.doctor()


def test_every_check_that_fails_carries_a_remedy_and_every_subject_is_covered(checks: list[doctor.Check]):
    names = [check.name for check in checks]
    assert {"python", *doctor.PACKAGES, "processor", "jax devices", "rendering", "cores", "memory"} == set(names)
    assert len(names) == len(set(names))
    for check in checks:
        assert check.detail
        assert check.ok or check.remedy
        assert "\n" not in check.detail + check.remedy


def test_versions_are_those_of_this_environment(checks: list[doctor.Check]):
    details = {check.name: check.detail for check in checks}
    assert details["numpy"] == numpy.__version__
    assert details["python"] == ".".join(map(str, sys.version_info[:3]))


def test_an_old_package_and_a_missing_one_are_named_with_the_command_that_installs_them():
    assert doctor.check_package("numpy", "99.1") == doctor.Check(
        name="numpy",
        ok=False,
        detail=doctor.check_package("numpy", "2.0").detail,
        remedy="pip install --upgrade 'numpy>=99.1'",
    )
    missing = doctor.check_package("jiggle-mj-no-such-package", "1.0")
    assert (missing.ok, missing.detail) == (False, "not installed")


@pytest.mark.parametrize(
    ("version", "numbers"), [("3.17.0.dev0", (3, 17, 0)), ("4.0", (4, 0)), ("2.4.6rc1", (2, 4, 6)), ("0.10", (0, 10))]
)
def test_versions_compare_by_number(version: str, numbers: tuple[int, ...]):
    """0.10 is newer than 0.9, which as text it is not."""
    assert doctor.release_numbers(version) == numbers


@pytest.mark.render
def test_a_frame_renders_offscreen():
    """The driver is the one that the other tests render with."""
    backend = os.environ["MUJOCO_GL"]
    assert doctor.render_failure(backend, time_limit=60.0) is None  # pyright: ignore[reportArgumentType]


def test_a_driver_that_does_not_answer_is_given_up():
    assert doctor.render_failure("egl", time_limit=1e-3) == "no answer within 0.001 s"


def test_a_broken_driver_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path):
    """Without a driver EGL has no display; glvnd reads its list of drivers from this empty folder."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(tmp_path))
    failure = doctor.render_failure("egl", time_limit=60.0)
    assert failure and "\n" not in failure


def driver(*working: str):
    """A probe of a machine on which these backends render, where PYOPENGL_PLATFORM does not contradict them."""

    def probe(backend: str, *, platform: str | None = None) -> doctor.Probe:
        return doctor.Probe(ok=backend in working and platform in (None, "", backend), message=f"{backend} tried")

    return probe


@pytest.mark.parametrize(
    ("environment", "working", "remedy"),
    [
        ({}, (), "apt-get install libegl1 libgl1 libgl1-mesa-dri"),
        ({}, ("osmesa",), "export MUJOCO_GL=osmesa"),
        ({"MUJOCO_GL": "glfw"}, ("egl",), "unset MUJOCO_GL"),
        ({"MUJOCO_GL": "banana"}, ("osmesa",), "export MUJOCO_GL=osmesa"),
        ({"MUJOCO_GL": "osmesa"}, (), "apt-get install libegl1 libgl1 libgl1-mesa-dri, then unset MUJOCO_GL"),
        ({"PYOPENGL_PLATFORM": "glx"}, ("egl",), "unset PYOPENGL_PLATFORM"),
        ({"MUJOCO_GL": "glfw", "PYOPENGL_PLATFORM": "glx"}, ("egl",), "unset MUJOCO_GL PYOPENGL_PLATFORM"),
    ],
)
def test_where_the_users_own_environment_does_not_render_the_command_that_mends_it_is_named(
    environment: dict[str, str], working: tuple[str, ...], remedy: str
):
    check = doctor.check_rendering(environment, driver(*working))
    assert (check.ok, check.remedy, check.prevents) == (False, remedy, "images")


@pytest.mark.parametrize("environment", [{}, {"MUJOCO_GL": "egl"}, {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl"}])
def test_a_driver_that_works_in_the_users_own_environment_needs_nothing(environment: dict[str, str]):
    check = doctor.check_rendering(environment, driver("egl"))
    assert (check.ok, check.remedy) == (True, "")


@pytest.mark.parametrize(
    ("prevented", "can_run", "words"),
    [
        ((), True, "ready"),
        (("speed",), True, "slower"),
        (("images",), False, "images cannot be rendered; everything else runs"),
        (("estimates",), False, "nothing can be estimated; 'record' and 'import' run"),
        (("estimates", "images"), False, "images cannot be rendered"),
        (("everything", "speed"), False, "nothing is sure to run"),
    ],
)
def test_the_verdict_says_what_cannot_be_done_and_what_can(prevented: tuple[str, ...], can_run: bool, words: str):
    checks = [doctor.Check(name="python", ok=True, detail="3.13.0")]
    checks += [doctor.Check(name=each, ok=False, detail="no", remedy="do", prevents=each) for each in prevented]  # pyright: ignore[reportArgumentType]
    assert doctor.can_run(checks) == can_run and words in doctor.verdict(checks)


@pytest.mark.parametrize(
    ("flags", "machine", "ok"),
    [("fpu sse2 avx avx2", "x86_64", True), ("fpu sse2", "x86_64", False), ("fp asimd", "aarch64", True)],
)
def test_an_x86_processor_without_avx_is_named(tmp_path, flags: str, machine: str, ok: bool):
    """jaxlib ends the process on such a processor; others have no AVX and need none."""
    (tmp_path / "cpuinfo").write_text(f"processor : 0\nflags\t\t: {flags}\nbugs :\n")
    check = doctor.check_processor(tmp_path / "cpuinfo", machine)
    assert check.ok == ok and ("AVX" in check.remedy) == (not ok)
    assert doctor.check_processor(tmp_path / "missing", machine).ok


@pytest.mark.parametrize(
    ("reason", "environment", "remedy"),
    [
        ("", {"JAX_PLATFORMS": "cuda"}, r"JAX_PLATFORMS=cuda is set: .*jiggle-mj\[cuda\]"),
        ("invalid truth value 'maybe' for environment 'JAX_ENABLE_X64'", {"JAX_ENABLE_X64": "maybe", "JAX_A": "1"},
         r"^Unset or correct JAX_ENABLE_X64\.$"),
        ("Unknown flag in XLA_FLAGS: --x", {"XLA_FLAGS": "--x"}, "Unset or correct XLA_FLAGS"),
        ("no such symbol", {}, "Reinstall jax"),
    ],
)  # fmt: skip
def test_what_keeps_jax_from_starting_is_named(reason: str, environment: dict[str, str], remedy: str):
    assert re.search(remedy, doctor.jax_remedy(reason, environment))


def test_jax_without_a_usable_platform_is_reported(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("JAX_PLATFORMS", "no_such_platform")
    check = doctor.check_jax()
    assert not check.ok
    assert "no_such_platform" in check.detail and "JAX_PLATFORMS=cpu" in check.remedy
