"""The environment check says what is there, what is wrong and what to do about it."""

import os
import sys

import numpy
import pytest

from jiggle_mj import doctor


@pytest.fixture(scope="module")
def checks() -> list[doctor.Check]:
    """What the doctor says of this machine."""
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


def test_an_old_package_and_a_missing_one_are_named_with_the_command_that_mends_them():
    assert doctor._version("numpy", "99.1") == doctor.Check(
        name="numpy",
        ok=False,
        detail=doctor._version("numpy", "2.0").detail,
        remedy="pip install --upgrade 'numpy>=99.1'",
    )
    missing = doctor._version("jiggle-mj-no-such-package", "1.0")
    assert (missing.ok, missing.detail) == (False, "not installed")


@pytest.mark.parametrize(
    ("found", "numbers"), [("3.17.0.dev0", (3, 17, 0)), ("4.0", (4, 0)), ("2.4.6rc1", (2, 4, 6)), ("0.10", (0, 10))]
)
def test_versions_compare_by_number(found: str, numbers: tuple[int, ...]):
    """0.10 is newer than 0.9, which as text it is not."""
    assert doctor._release(found) == numbers


@pytest.mark.render
def test_a_frame_renders_offscreen():
    """With the driver that the other tests render with."""
    backend = os.environ["MUJOCO_GL"]
    assert doctor.render_failure(backend, time_limit=60.0) is None  # pyright: ignore[reportArgumentType]


def test_a_driver_that_does_not_answer_is_given_up():
    assert doctor.render_failure("egl", time_limit=1e-3) == "no answer within 0.001 s"


def test_a_broken_driver_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path):
    """Without a driver EGL has no display; glvnd reads its list of drivers from this folder."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(tmp_path))
    failure = doctor.render_failure("egl", time_limit=60.0)
    assert failure and "\n" not in failure


def test_no_driver_at_all_names_the_packages(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "_render", lambda backend, time_limit: doctor._Probe(ok=False, said="no"))
    egl, osmesa = doctor._offscreen_opengl()
    assert not egl.ok and not osmesa.ok
    assert "libegl1" in egl.remedy and "libosmesa6" in osmesa.remedy


def test_jax_without_a_usable_platform_is_reported(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("JAX_PLATFORMS", "no_such_platform")
    check = doctor._jax()
    assert not check.ok
    assert "no_such_platform" in check.detail and "JAX_PLATFORMS=cpu" in check.remedy
