"""From stereo pairs to the 3-D position, covariance and visibility of each particle, frame after frame.

`start` lays the estimator's own mesh over the first pair; `track` follows its particles by appearance: a guess from
dense flow, registration against the first image through the mesh, disparity between the current images. Knows
neither the tissue's mechanics nor the truth; a caller may hand in what it believes as the guess.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator.perception.disparity import Disparity, SemiGlobalMatching
from jiggle_mj.estimator.perception.flow import dense_flow, flow_at
from jiggle_mj.estimator.perception.material_map import MaterialMap
from jiggle_mj.estimator.perception.mesh_field import MeshField
from jiggle_mj.estimator.perception.rectified import RectifiedPair, Rectifier
from jiggle_mj.estimator.perception.registration import (
    COARSE,
    FINE,
    LEAST_CORRELATION,
    MaterialRegistration,
    Registered,
    refine_disparity,
)
from jiggle_mj.estimator.perception.sheet_mesh import LEAST_MATCHED, DisparitySurface, lay_mesh
from jiggle_mj.estimator.perception.tissue_mask import TissueMask, WarmTissue, largest_blob
from jiggle_mj.observation import StereoPair, ToolState

UNSEEN_VARIANCE = 1.0
"""Variance of a coordinate of a particle that was not seen: as good as unknown [m^2]."""
LATERAL_SD = 0.35
"""Error of a good match that its residual does not show [px]."""
DISPARITY_SD = 0.08
"""The same in disparity [px]."""
SMALLEST_SHEET = 2000
"""Fewest tissue pixels that can be a sheet."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """One frame's measurement of the particles."""

    positions: Float[np.ndarray, "n 3"]
    """World [m]; NaN where unseen."""
    covariance: Float[np.ndarray, "n 3 3"]
    """[m^2]; `UNSEEN_VARIANCE` on the diagonal where unseen."""
    visible: Bool[np.ndarray, " n"]
    uvd: Float[np.ndarray, "n 3"]
    """Left rectified pixel and disparity [px]; the best guess where unseen."""


@dataclass(kw_only=True)
class _Last:
    """What the next frame starts from."""

    grey: Float[np.ndarray, "height width"]
    uvd: Float[np.ndarray, "n 3"]
    visible: Bool[np.ndarray, " n"]
    tool: ToolState


class StereoTracker:
    """Follows one sheet through a recording of one camera."""

    def __init__(
        self,
        camera: StereoCamera,
        *,
        spacing: float = 4.25e-3,
        mask: TissueMask | None = None,
        disparity: Disparity | None = None,
    ):
        """Choose how to see.

        Args:
            camera: the calibrated pair.
            spacing: distance between neighbouring particles [m].
            mask: which pixels are tissue; `WarmTissue()` by default.
            disparity: dense disparity; `SemiGlobalMatching()` by default.
        """
        if not spacing > 0:
            raise ValueError(f"StereoTracker.spacing must be above 0 m; got {spacing}.")
        self._camera, self._spacing = camera, spacing
        self._mask = WarmTissue() if mask is None else mask
        self._disparity = SemiGlobalMatching() if disparity is None else disparity
        self._rectify = Rectifier(camera)
        self._last: _Last | None = None

    def start(self, images: StereoPair, tool: ToolState) -> Sheet:
        """Lay the mesh over the first pair; the tissue should be at rest.

        Raises:
            PerceptionError: black image, no tissue, two sheets, no disparity, or too few particles.
        """
        pair = self._rectify(images)
        if pair.black_side is not None:
            raise PerceptionError(f"the {pair.black_side} image is black; check the light, the exposure and the cable.")
        tissue = largest_blob(self._mask(pair.left), smallest=SMALLEST_SHEET)
        mesh = lay_mesh(tissue, self._disparity(pair.left, pair.right), self._camera, spacing=self._spacing)
        uv = mesh.uvd[:, :2]
        self._material = MaterialMap(uv, mesh.faces, tissue)
        self._field = MeshField(uv, mesh.faces)
        refined = refine_disparity(
            pair.left_grey, pair.right_grey, uv, mesh.uvd[:, 2], self._material, self._field
        )
        good = refined.match.correlation > LEAST_CORRELATION
        if good.mean() < LEAST_MATCHED:
            raise PerceptionError(
                f"left and right images agree on {good.mean():.0%} of the particles, at least {LEAST_MATCHED:.0%} is "
                "needed: are the cameras swapped, the pair not rectified, or the tissue without texture?"
            )
        uvd = DisparitySurface(uv[good], refined.value[good, 0])(uv)
        self._first, self._first_uvd = pair.left_grey, uvd
        self._registration = MaterialRegistration(pair.left_grey, self._material, self._field)
        everywhere = np.ones(len(uv), bool)
        self._last = _Last(grey=pair.left_grey, uvd=uvd, visible=everywhere, tool=tool)
        return Sheet(rest=self._camera.back_project(uvd), faces=mesh.faces)

    def track(self, images: StereoPair, tool: ToolState, *, predicted: Float[np.ndarray, "n 3"]) -> Track:
        """Measure the particles in one more pair.

        Args:
            images: raw pair.
            tool: the tweezer now; a new grasp or opened jaws restart the guess at rest.
            predicted: believed particle positions at the previous frame [m], used where they were not seen.

        Raises:
            ValueError: called before `start`.
        """
        if self._last is None:
            raise ValueError("StereoTracker.track needs a sheet; call start with the first pair.")
        pair = self._rectify(images)
        if pair.black_side is not None:
            return self._measurement(self._last.uvd, np.zeros(len(predicted), bool), np.zeros((len(predicted), 3, 3)))
        start = self._guess(pair, tool, predicted)
        plane = self._registration.refine(pair.left_grey, start[:, :2], windows=(COARSE, COARSE, FINE, FINE, FINE))
        dense = self._disparity(pair.left, pair.right)
        coarse, sure = self._coarse_disparity(dense, plane.value, start[:, 2])
        depth = refine_disparity(
            pair.left_grey, pair.right_grey, plane.value, coarse, self._material, self._field
        )
        uvd = np.concatenate([plane.value, depth.value], axis=1)
        visible = self._accept(pair, plane, depth, coarse, sure)
        self._last = _Last(grey=pair.left_grey, uvd=uvd, visible=visible, tool=tool)
        noise = np.zeros((len(uvd), 3, 3))
        noise[:, :2, :2] = LATERAL_SD**2 * np.eye(2) + plane.spread
        noise[:, 2, 2] = DISPARITY_SD**2 + depth.spread[:, 0, 0]
        return self._measurement(uvd, visible, noise)

    def _guess(
        self, pair: RectifiedPair, tool: ToolState, predicted: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Pixel and disparity to start from: continued from the last frame, or from rest, whichever matches better."""
        last = self._last
        known = last.visible
        before = np.where(known[:, None], last.uvd, self._camera.project(predicted))
        guesses = [self._moved(last.grey, before, pair.left_grey)]
        if tool.grasp != last.tool.grasp or tool.closed != last.tool.closed or self._far(tool):
            guesses.append(self._moved(self._first, self._first_uvd, pair.left_grey))
        if len(guesses) == 1:
            return guesses[0]
        share = [
            np.mean(
                self._registration.refine(pair.left_grey, guess[:, :2], windows=(COARSE,)).match.correlation
                > LEAST_CORRELATION
            )
            for guess in guesses
        ]
        return guesses[int(np.argmax(share))]

    def _far(self, tool: ToolState) -> bool:
        """Whether the tool moved further than flow follows: two spacings."""
        return bool(np.linalg.norm(tool.position - self._last.tool.position) > 2 * self._spacing)

    def _moved(
        self, grey: Float[np.ndarray, "height width"], uvd: Float[np.ndarray, "n 3"], now: Float[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "n 3"]:
        """Particles carried along by the flow between two images, smooth where the flow cannot be used."""
        moved, usable = flow_at(uvd[:, :2], *dense_flow(grey, now))
        usable &= self._field.stray(moved, usable) < 4.0
        filled = self._field.fill(moved, usable)
        return uvd + np.pad(np.where(usable[:, None], moved, filled), ((0, 0), (0, 1)))

    def _coarse_disparity(self, dense, pixels, before):
        """Dense disparity at the particles, without strays; carried on from `before` where there is none."""
        x, y = pixels.astype(np.float32).T
        value = cv2.remap(dense, x[None], y[None], cv2.INTER_NEAREST, borderValue=np.nan)[0].astype(float)
        change = np.where(np.isfinite(value), value - before, 0)[:, None]
        sure = np.isfinite(value)
        sure &= self._field.stray(change, sure) < 2.0
        filled = self._field.fill(change, sure)
        return before + np.where(sure, change[:, 0], filled[:, 0]), sure

    def _accept(self, pair, plane: Registered, depth: Registered, coarse, sure) -> Bool[np.ndarray, " n"]:
        """In frame, tissue-coloured, alike in all images, and settled."""
        x, y = plane.value.astype(np.float32).T
        tissue = cv2.GaussianBlur(self._mask(pair.left).astype(np.float32), (0, 0), 2.0)
        coloured = cv2.remap(tissue, x[None], y[None], cv2.INTER_LINEAR, borderValue=0)[0] > 0.5
        alike = (plane.match.correlation > LEAST_CORRELATION) & (depth.match.correlation > LEAST_CORRELATION)
        settled = (plane.last_step < 0.5) & (depth.last_step < 0.2)
        consistent = ~sure | (np.abs(depth.value[:, 0] - coarse) < 1.5)
        return coloured & alike & settled & consistent & (depth.value[:, 0] > 0)

    def _measurement(self, uvd, visible, noise) -> Track:
        """Carry pixels and their covariance into the world."""
        uvd = np.where(uvd[:, 2:] > 0.1, uvd, self._first_uvd)
        jacobian = self._camera.back_projection_jacobian(uvd)
        covariance = jacobian @ noise @ jacobian.transpose(0, 2, 1)
        return Track(
            positions=np.where(visible[:, None], self._camera.back_project(uvd), np.nan),
            covariance=np.where(visible[:, None, None], covariance, UNSEEN_VARIANCE * np.eye(3)),
            visible=visible,
            uvd=uvd,
        )
