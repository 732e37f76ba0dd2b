"""The page: complete without any part of its input, deterministic, without network, and correct in a real browser."""

import dataclasses
import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import Delaunay

from jiggle_mj.camera import StereoCamera
from jiggle_mj.episode import Episode
from jiggle_mj.errors import OutputError
from jiggle_mj.estimate import Belief, Detection, Estimate, Sheet
from jiggle_mj.eval.metrics.flat_map import grid_of, outline, plane_of
from jiggle_mj.eval.metrics.result import Run, result, with_truth
from jiggle_mj.eval.metrics.truth_transfer import TransferredTruth, transfer
from jiggle_mj.eval.report.pictures import pictures
from jiggle_mj.eval.report.run_page import write_report
from jiggle_mj.eval.report.verdict import against_truth, doubts, found, skipped_frames, stiffness_sums
from jiggle_mj.observation import StereoPair
from jiggle_mj.truth import Truth, TruthFrame

SIDE = 0.1
"""Side of the synthetic sheet [m]."""
MAX_PAGE_BYTES = 15_000_000
"""Largest size of the page [bytes]."""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or ""
SPEED_ADVICE = ("willReadFrequently", "GPU stall due to ReadPixels")
"""Chromium's hints on the speed of its own software renderer; no fault of the page."""
MOVE_THE_SLIDER = """<script>
document.getElementById("slider").value = 3;
document.getElementById("slider").dispatchEvent(new Event("input"));
document.querySelector("input[value=sd]").click();
</script>"""
ROUNDING = 1e-9
"""Rounding of coordinates of order one; cells with a centre on the border of a triangle belong to it."""
SUM_ROUNDING = 1e-12
"""Rounding of a weighted sum of three numbers of order one."""
PAGE_ROUNDING_MM = 0.01
"""Rounding of coordinates on the page [mm]."""
SETTINGS = {
    "declaration": {"membrane_stiffness": 44.0, "poisson": 0.45, "areal_density": 1.0},
    "filter": {"tau": 2e-4, "prior_sd": 0.5},
    "versions": {"jiggle-mj": "0.1.0", "jax": "0.10.2", "plotly": "7.1.0"},
}


def hexagonal(spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a sheet of about equilateral triangles centred on the origin."""
    rows = np.arange(-SIDE / 2, SIDE / 2 + 1e-9, spacing * np.sqrt(3) / 2)
    flat = np.concatenate(
        [
            np.stack([np.arange(-SIDE / 2, SIDE / 2 + 1e-9, spacing) + (k % 2) * spacing / 2, np.full(n, y)], 1)
            for k, y in enumerate(rows)
            for n in [len(np.arange(-SIDE / 2, SIDE / 2 + 1e-9, spacing))]
        ]
    )
    return np.column_stack([flat, np.full(len(flat), 1e-3)]), Delaunay(flat).simplices


def lifted(rest: np.ndarray, corner: np.ndarray, height: float) -> np.ndarray:
    """Return the sheet with a bump over one corner."""
    away = np.linalg.norm(rest[:, :2] - corner, axis=1)
    return rest + height * np.exp(-((away / 0.04) ** 2))[:, None] * np.array([0, 0, 1.0])


@cache
def synthetic() -> dict:
    """Return a run of 36 frames: four corners lifted nine times each, two lines attached, one of them half missed."""
    rng = np.random.default_rng(0)
    rest, faces = hexagonal(0.0042)
    vertices, triangles = hexagonal(0.005)
    n = len(rest)

    def line_of(points):
        return ((abs(points[:, 0]) < 0.03) & (abs(points[:, 1] - 0.012) < 0.003)) | (
            (abs(points[:, 0] - 0.02) < 0.003) & (abs(points[:, 1] + 0.02) < 0.015)
        )

    attached, mean = line_of(vertices), np.where(line_of(rest), 1.0, 0.0) * rng.normal(1, 0.15, n)
    detected = line_of(rest + np.array([0.004, 0.001, 0])) & (rest[:, 1] > -0.028)
    estimates, frames = [], []
    for k in range(36):
        corner = 0.04 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)][k // 9])
        height = 0.005 * (k % 9)
        true = lifted(rest, corner, height)
        seen = rng.random(n) < 0.93
        held = (np.linalg.norm(rest[:, :2] - corner, axis=1) < 0.006) & (k % 9 > 0)
        share = (k + 1) / 36
        estimates.append(
            Estimate(
                index=k if k < 20 else k + 1,
                time=k * 200_000_000,
                positions=true + rng.normal(0, 2e-4, (n, 3)),
                observed=np.where(seen[:, None], true + rng.normal(0, 3e-4, (n, 3)), np.nan),
                mean=np.maximum(0, mean * share + rng.normal(0, 0.03, n)),
                sd=np.full(n, 0.5) * (1 - 0.8 * share * rng.random(n)),
                probability=np.full(n, np.nan),
                held=held,
                entropy=float(400 - 900 * share),
                nis=float(rng.normal(1.1, 0.1)),
                boundary_energy=2e-7 * height / 0.04,
                update_s=float(rng.normal(0.18, 0.02)),
                perception_s=float(rng.normal(0.4, 0.03)),
            )
        )
        frames.append(
            TruthFrame(
                index=estimates[-1].index,
                time=estimates[-1].time,
                positions=lifted(vertices, corner, height),
                stiffness=np.where(attached, 1.0, 0.0),
                tip=np.append(corner, height),
            )
        )
    sheet = Sheet(rest=rest, faces=faces)
    last = estimates[-1].mean
    detection = Detection(
        attached=detected,
        score=last,
        stiffness=last,
        stiffness_sd=estimates[-1].sd,
        rule="constrained mean above 0.5 N/m",
    )
    truth = Truth(
        rest=vertices, faces=triangles, attached=attached, frames=tuple(frames), scene="two lines", details={}
    )
    run = {
        "sheet": sheet,
        "estimates": estimates,
        "belief": Belief(mean=estimates[-1].mean, covariance=np.diag(estimates[-1].sd ** 2)),
        "detection": detection,
    }
    episode = Episode(
        sheet=sheet,
        estimates=tuple(estimates),
        belief=run["belief"],
        detection=detection,
        prior_entropy=420.0,
        n_frames=41,
        skipped=((20, "the right image is missing"),),
    )
    unscored = result(
        Run(
            scene="two lines <synthetic>",
            seed=0,
            sensing="stereo",
            estimator="implicit",
            policy="corners",
            episode=episode,
        )
    )
    camera = StereoCamera.rectified(
        width=640, height=480, focal=700.0, baseline=0.005, T_world_camera=looking_down(0.16, 35)
    )
    texture = cv2.GaussianBlur(rng.normal(0, 60, (480, 640, 3)), (0, 0), 3) * 4 + np.array([205, 120, 110])
    image = np.clip(texture, 0, 255).astype(np.uint8)
    pair = StereoPair(left=image, right=np.roll(image, -20, axis=1))
    return run | {"unscored": unscored, "truth": truth, "camera": camera, "images": lambda index: pair}


def looking_down(distance: float, tilt_degrees: float) -> np.ndarray:
    """Return the pose of a camera that views the origin, tilted from the vertical towards -y."""
    tilt = np.radians(tilt_degrees)
    forward = np.array([0, np.sin(tilt), -np.cos(tilt)])
    right = np.array([1.0, 0, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = -distance * forward
    return pose


def write(path: Path, *, truth: bool, images: bool, **changes) -> str:
    """Write the synthetic run's page and return its text."""
    run = synthetic()
    parts = {name: run[name] for name in ("sheet", "estimates", "belief", "detection")} | changes
    scored = with_truth(run["unscored"], **parts, truth=run["truth"]) if truth else run["unscored"]
    write_report(
        path,
        **parts,
        result=scored,
        settings=SETTINGS,
        truth=run["truth"] if truth else None,
        images=run["images"] if images else None,
        camera=run["camera"] if images else None,
    )
    return path.read_text("utf-8")


def own_markup(page: str) -> str:
    """Return the page without the text of its scripts."""
    return re.sub(r"(<script[^>]*>).*?(</script>)", r"\1\2", page, flags=re.DOTALL)


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("images", [True, False])
def test_each_combination_shows_what_it_has_and_nothing_else(tmp_path, truth, images):
    page = own_markup(write(tmp_path / "report.html", truth=truth, images=images))
    assert ("map-truth" in page) == truth
    assert ("PCD" in page) == truth
    assert ("No truth was given" in page) == (not truth)
    assert ("left-points" in page) == images
    assert "the right image is missing" in page
    assert "known relative to the declared membrane stiffness" in page
    assert "declaration.membrane_stiffness" in page


@pytest.mark.parametrize("truth", [True, False])
def test_the_page_says_how_a_policy_ended_with_its_acts_and_draws_the_path_of_the_grip(tmp_path, truth):
    acts = [{"frame": 30, "kind": "cut", "log_bayes_factor": 12.3}]
    run = synthetic()
    figures = run["unscored"] | {"ended": "nothing is attached", "policy": "detach"}
    figures["procedure"] = {"name": "detach", "cycles": 1, "success": None, "acts": acts}
    parts = {name: run[name] for name in ("sheet", "estimates", "belief", "detection")}
    if truth:
        known = dataclasses.replace(run["truth"], details={"events": [{"succeeded": False}]})
        parts["truth"], figures = known, with_truth(figures, **parts, truth=known)
    write_report(tmp_path / "report.html", **parts, result=figures, settings=SETTINGS)
    whole = (tmp_path / "report.html").read_text("utf-8")
    page = own_markup(whole)
    assert "ended because: nothing is attached" in page and ">12.3<" in page
    assert ("it worked</th>" in page) == truth and ("<td>no</td>" in page) == truth
    first = next(estimate for estimate in run["estimates"] if estimate.held.any())
    held = first.positions[first.held].mean(axis=0) * 1e3
    payload = json.loads(re.search(r'id="payload"[^>]*>(.*?)</script>', whole, flags=re.DOTALL).group(1))
    assert np.allclose([axis[0] for axis in payload["paths"][0]["xyz"]], held, atol=PAGE_ROUNDING_MM)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, None),
        ({"stiffness_factor": 1.1}, None),
        ({"stiffness_factor": 2.1}, "2.10 times as stiff as declared, to 3%"),
        ({"stiffness_factor": 2.1, "stiffness_factor_log_sd": 0.5}, None),
        ({"stiffness_factor": None, "stiffness_factor_log_sd": None}, None),
        ({"scaled_nis": 16.0}, "by 4.0 times its standard deviation"),
        ({"used": False, "why_not": "its sign."}, "The force on the tool is not used: its sign."),
    ],
)
def test_what_the_force_says_against_the_declaration_or_itself_is_shown(changes, words):
    good = {"used": True, "why_not": None, "nis": 1.0, "scaled_nis": 1.0, "stiffness_factor": 1.0}
    force = good | {"stiffness_factor_log_sd": 0.03} | changes
    found = doubts({"detection": {}, "force": force})
    assert found == [] if words is None else words in found[0] and len(found) == 1


def test_frames_that_are_skipped_for_one_reason_are_one_line():
    """Reasons that differ in their numbers alone are one; another reason is another line."""
    reasons = ["0% of the cloud lies on the sheet", "3.5% of the cloud lies on the sheet", "no particle was seen"]
    skipped = [{"index": 7 + k, "why": reason} for k, reason in enumerate([*reasons, reasons[0]])]
    many, one = skipped_frames({"n_frames": 30, "frames": {"skipped": skipped}})
    assert many == f"3 of 30 frames skipped, from frame 7 to 10: {reasons[0]}"
    assert one == f"frame 9 skipped: {reasons[2]}"


def test_doubts_are_listed_where_there_are_any(tmp_path):
    good = {"detection": {"converged": True}, "noise": {"force_sd_ratio": 1.4, "position_sd_ratio": None}}
    bad = {"detection": {"converged": False}, "noise": {"force_sd_ratio": 12.04, "position_sd_ratio": 1.2}}
    assert doubts(good) == doubts({"detection": {}}) == []
    rest, forces = doubts(bad)
    assert "halves of the samples disagree" in rest and "forces are off by 12.0 times" in forces
    noisy = {"from": "measured", "point_sd_m": 3e-4, "smooth_sd_m": 4e-4, "stated_sd_m": 2e-4}
    (shown,) = doubts({"detection": {}, "noise": {"points": noisy}})
    assert "a noise of 0.5 mm where the recording states 0.2 mm" in shown
    assert not doubts({"detection": {}, "noise": {"points": noisy | {"stated_sd_m": 3e-4}}})
    (off,) = doubts({"detection": {}, "noise": {"cloud_share": 0.51}})
    assert "49% of the clouds' points lie off the sheet" in off
    assert not doubts({"detection": {}, "noise": {"cloud_share": 0.94}})
    run = synthetic()
    parts = {name: run[name] for name in ("sheet", "estimates", "belief")}
    poor = dataclasses.replace(run["detection"], converged=False)
    figures = run["unscored"] | {"detection": run["unscored"]["detection"] | {"converged": False}}
    write_report(tmp_path / "report.html", **parts, detection=poor, result=figures, settings=SETTINGS)
    assert rest in own_markup((tmp_path / "report.html").read_text("utf-8"))


def test_the_page_asks_nothing_of_the_network_and_stays_small(tmp_path):
    """Own markup names no address, and the page's policy forbids every connection."""
    path = tmp_path / "report.html"
    page = write(path, truth=True, images=True)
    assert not re.search(r"(src|href)=[\"'](?!data:)", own_markup(page))
    assert "default-src 'none'" in page and "connect-src" not in page
    assert path.stat().st_size < MAX_PAGE_BYTES


def test_an_estimator_without_uncertainty_has_a_page(tmp_path):
    """NaN means unknown, in estimates and belief; the page's data are JSON, which has no NaN."""
    run = synthetic()
    none = np.full(len(run["sheet"].rest), np.nan)
    bare = [replace(estimate, sd=none, entropy=float("nan"), nis=float("nan")) for estimate in run["estimates"]]
    belief = Belief(mean=none, covariance=np.diag(none))
    page = write(tmp_path / "report.html", truth=True, images=False, estimates=bare, belief=belief)
    assert "no standard deviation" in page


def test_the_same_run_gives_the_same_bytes(tmp_path):
    assert write(tmp_path / "a.html", truth=True, images=True) == write(tmp_path / "b.html", truth=True, images=True)


def test_names_from_outside_cannot_write_markup(tmp_path):
    page = write(tmp_path / "report.html", truth=False, images=False)
    assert "two lines &lt;synthetic&gt;" in page and "<synthetic>" not in own_markup(page)


def test_a_report_of_nothing_and_images_without_a_camera_are_refused(tmp_path):
    run = synthetic()
    with pytest.raises(ValueError, match="at least one Estimate"):
        write(tmp_path / "report.html", truth=False, images=False, estimates=[])
    with pytest.raises(ValueError, match="without their camera"):
        write_report(
            tmp_path / "report.html",
            **{name: run[name] for name in ("sheet", "estimates", "belief", "detection")},
            result=run["unscored"],
            settings={},
            images=run["images"],
        )
    with pytest.raises(OutputError, match="give a folder that exists"):
        write(tmp_path / "missing" / "report.html", truth=False, images=False)


def estimate_of(positions: np.ndarray, observed: np.ndarray, mean: float) -> Estimate:
    """Return the first synthetic estimate, with other particles."""
    n = len(positions)
    return replace(
        synthetic()["estimates"][0],
        positions=positions,
        observed=observed,
        mean=np.full(n, mean),
        sd=np.ones(n),
        probability=np.full(n, np.nan),
        held=np.zeros(n, bool),
    )


def test_the_sentence_counts_patches_and_hits_by_hand():
    """On a strip of ten: reported {0, 1} and {9}, attached {0, 4, 5}: 0 is exact; 4, 5 are more than a ring away."""
    faces = np.array([[k, k + 1, k + 2] for k in range(8)])
    rest = np.column_stack([np.arange(10) * 0.01, np.arange(10) % 2 * 0.01, np.zeros(10)])
    sheet = Sheet(rest=rest, faces=faces)
    mask = np.isin(np.arange(10), [0, 1, 9])
    detection = Detection(
        attached=mask, score=mask.astype(float), stiffness=np.full(10, 0.8), stiffness_sd=np.full(10, 0.1), rule=""
    )
    sentence = found(sheet, detection, plane_of(rest))
    assert sentence.startswith(
        "3 particles are reported attached, in 2 patches (2 around x = 5 mm, y = 5 mm; 1 around x ="
    )
    assert sentence.endswith("at 0.8 N/m each on average.")
    attached = np.isin(np.arange(10), [0, 4, 5])
    compared = against_truth(sheet, detection, TransferredTruth(attached=attached, stiffness=attached * 1.0))
    assert "In truth 3 are attached: 1 of them reported exactly, 1 within one mesh ring;" in compared
    assert compared.endswith("1 of the 3 reports lies more than one ring off.")
    transferred = TransferredTruth(attached=mask, stiffness=mask * 1.5)
    belief = Belief(mean=np.full(10, 0.8), covariance=0.01 * np.eye(10) + 0.01)
    # A ring around 0, 1 and 9 is 0-3, 7-9: seven times 0.8; variance 7 * 0.01 + 49 * 0.01; truth 3 * 1.5.
    summed = stiffness_sums(sheet, belief, detection, transferred)
    assert "sums to 5.6 N/m, with a standard deviation of 0.7; the truth is 4.5." in summed
    welded = replace(transferred, stiffness=np.where(mask, np.inf, 0.0))
    assert stiffness_sums(sheet, belief, detection, welded) == ""
    nothing = TransferredTruth(attached=np.zeros(10, bool), stiffness=np.zeros(10))
    assert against_truth(sheet, detection, nothing) == "In truth nothing is attached. All 3 reports are false."


def test_the_map_interpolates_linearly_over_triangles():
    """A linear field is reproduced exactly wherever the sheet is, and cells outside the sheet are empty."""
    flat = np.array([[0.0, 0], [4, 0], [0, 4]])
    x, y, corners, weights = grid_of(flat, np.array([[0, 1, 2]]))
    values = np.sum((flat @ [2.0, -1.0])[corners] * weights, axis=-1)
    inside = x[None] + y[:, None] < 4 + ROUNDING
    np.testing.assert_allclose(values[inside], (2 * x[None] - y[:, None])[inside], atol=SUM_ROUNDING)
    assert np.isnan(values[~inside]).all()


def test_the_outline_of_one_corner_is_half_an_edge_away():
    """Vertex 0 of a right triangle: one cut from (2, 0) to (0, 2), and two half edges of the border."""
    segments = outline(np.array([[0.0, 0], [4, 0], [0, 4]]), np.array([[0, 1, 2]]), np.array([True, False, False]))
    ends = sorted(sorted(map(tuple, segment)) for segment in segments)
    assert ends == [[(0, 0), (0, 2)], [(0, 0), (2, 0)], [(0, 2), (2, 0)]]


def test_points_fall_on_the_projection_in_both_images():
    """A point on the axis of the left camera at depth Z is at the centre there and f B / Z to the left in the right."""
    run = synthetic()
    camera = StereoCamera.rectified(width=640, height=480, focal=700.0, baseline=0.005, T_world_camera=np.eye(4))
    at = np.array([[0.0, 0, 0.1], [np.nan] * 3])
    estimate = estimate_of(np.array([[1.0, 1, 1], [0, 0, 0.2]]), at, 0.0)
    [picture] = pictures([estimate], run["images"], camera, [0])
    np.testing.assert_allclose(picture.uv_left, [[319.5, 239.5]] * 2)
    np.testing.assert_allclose(picture.uv_right, [[319.5 - 35, 239.5], [319.5 - 17.5, 239.5]])


def chromium(page: Path, profile: Path, *more: str) -> subprocess.CompletedProcess:
    """Open a page without network and let it run for a while of its own time."""
    return subprocess.run(
        [
            CHROMIUM,
            *"--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking".split(),
            *"--disable-component-update --disable-sync --use-angle=swiftshader --enable-unsafe-swiftshader".split(),
            *"--enable-logging=stderr --v=0 --virtual-time-budget=2000".split(),
            f"--user-data-dir={profile}",
            *more,
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.skipif(not CHROMIUM, reason="no chromium on PATH to open the page in")
@pytest.mark.parametrize(("truth", "images"), [(True, True), (False, False)])
def test_the_page_runs_in_chromium_without_a_console_error(tmp_path, truth, images):
    """Each figure is drawn, the slider moves, the script reaches its last line, and the console is silent."""
    path = tmp_path / "report.html"
    path.write_text(write(path, truth=truth, images=images) + MOVE_THE_SLIDER, "utf-8")
    shown = chromium(path, tmp_path / "profile", "--dump-dom")
    dom = own_markup(shown.stdout)
    console = [line for line in shown.stderr.splitlines() if "CONSOLE" in line]
    assert [line for line in console if not any(advice in line for advice in SPEED_ADVICE)] == []
    assert "frame 3 · 0.60 s · grasp 1" in dom
    drawn = {"map-mean", "map-sd", "map-detected", "solid", "curves"}
    drawn |= {"map-truth", "solid-truth"} if truth else set()
    assert set(re.findall(r'<div id="([\w-]+)"[^>]*class="js-plotly-plot"', dom)) == drawn
    assert "WebGL is not supported" not in dom


def test_the_synthetic_truth_has_both_lines_on_both_meshes():
    """Guard the fixture: without the two lines every picture above would show nothing."""
    run = synthetic()
    transferred = transfer(run["sheet"], run["truth"], 36)
    assert 20 < transferred.attached.sum() < 80
    assert 550 < len(run["sheet"].rest) < 750
