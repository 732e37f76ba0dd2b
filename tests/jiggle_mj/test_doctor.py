"""The environment check reports what is installed, what is wrong and what to do about it."""

import os
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
    assert {"python", *doctor.PACKAGES, "jax devices", "cores", "memory"} <= set(names)
    assert [name for name in names if "OpenGL" in name] == ["offscreen OpenGL, egl", "offscreen OpenGL, osmesa"]
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


def test_no_driver_at_all_names_the_packages():
    egl, osmesa = doctor.check_opengl(lambda backend: doctor.Probe(ok=False, message="no"))
    assert not egl.ok and not osmesa.ok
    assert "libegl1" in egl.remedy and "libosmesa6" in osmesa.remedy


def test_one_working_driver_is_enough():
    """The other one is reported as not needed, without a remedy."""
    egl, osmesa = doctor.check_opengl(lambda backend: doctor.Probe(ok=backend == "egl", message=f"{backend} driver"))
    assert egl.ok and osmesa.ok and egl.detail == "egl driver" and osmesa.remedy == ""
    assert osmesa.detail == "not available (osmesa driver); not needed"


def test_jax_without_a_usable_platform_is_reported(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("JAX_PLATFORMS", "no_such_platform")
    check = doctor.check_jax()
    assert not check.ok
    assert "no_such_platform" in check.detail and "JAX_PLATFORMS=cpu" in check.remedy
