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
from jiggle_mj.observation import StereoPair, ToolState

from .disparity import Disparity, SemiGlobalMatching
from .flow import dense_flow, flow_at
from .material_map import MaterialMap
from .mesh_field import MeshField
from .rectified import RectifiedPair, Rectifier
from .registration import (
    COARSE,
    FINE,
    LEAST_CORRELATION,
    MaterialRegistration,
    Registered,
    refine_disparity,
    sample_mask,
)
from .sheet_mesh import LEAST_MATCHED, DisparitySurface, lay_mesh
from .tissue_mask import TissueMask, WarmTissue, largest_blob
from .track import UNSEEN_VARIANCE, Track

FAR = 2.0
"""A tool that moved further than this between two frames may have taken the tissue further than flow follows
[spacings]."""
MOSTLY_FOUND = 0.8
"""Share of the particles that must match for a guess to need no rival."""
STRAY_FLOW = 4.0
"""Flow that differs by more than this from its neighbours' median is not used [px]."""
STRAY_DISPARITY = 2.0
"""The same for dense disparity [px]."""
DISAGREEMENT = 1.5
"""Refined disparities further than this from the dense one are not believed [px]."""
SETTLED = 0.3
"""The last step of a registration that has settled is shorter than this [px]."""
LATERAL_SD = 0.02
"""Error of a perfect match: where a particle lies in the first image's tissue [px]."""
DISPARITY_SD = 0.012
"""As `LATERAL_SD`, in disparity [px]."""
NOISE_FACTOR = 3.1
"""Errors are this many times those of residuals independent from pixel to pixel: smoothing spreads noise over
neighbours, and robust weights make the residuals look small. Measured with image noise of 0 to 6 grey levels."""
TREND_FACTOR = 0.6
"""Lateral error of a particle for each pixel that it is off its neighbours' trend, measured."""
PERSISTENCE = 2.2
"""Variances are stated this many times larger than they are in one frame: part of an error stays from frame to frame,
and the filter takes each frame's as new. Set by the belief's NEES on the shipped scenes."""
LEAST_SHARE = 0.7
"""A particle is hidden when less than this share of its window, of what was seen of it at rest, is tissue now."""
OFF_TREND = 3.0
"""A particle this far from where its neighbours' motion and stretch put it was mistaken for another [px]."""
SMALLEST_SHEET = 2000
"""Fewest tissue pixels that can be a sheet."""


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
        spacing: float = 4.4e-3,
        mask: TissueMask | None = None,
        disparity: Disparity | None = None,
    ):
        """Choose how to see.

        Args:
            camera: the calibrated pair.
            spacing: distance between neighbouring particles [m].
            mask: which pixels are tissue; `WarmTissue()` by default.
            disparity: dense disparity; `SemiGlobalMatching.for_camera` by default.
        """
        if not spacing > 0:
            raise ValueError(f"StereoTracker.spacing must be above 0 m; got {spacing}.")
        self._camera, self._spacing = camera, spacing
        self._mask = WarmTissue() if mask is None else mask
        self._disparity = SemiGlobalMatching.for_camera(camera) if disparity is None else disparity
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
            pair.left_fine,
            pair.right_fine,
            (tissue, self._mask(pair.right)),
            uv,
            mesh.uvd[:, 2],
            self._material,
            self._field,
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
        self._whole = self._registration.refine(pair.left_fine, tissue, uv, windows=(FINE,)).match.share
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
        last = self._last
        if last is None:
            raise ValueError("StereoTracker.track needs a sheet; call start with the first pair.")
        pair = self._rectify(images)
        if pair.black_side is not None:
            return self._measurement(last.uvd, np.zeros(len(last.uvd), bool), np.zeros((len(last.uvd), 3, 3)))
        tissue, tissue_right = self._mask(pair.left), self._mask(pair.right)
        start = self._guess(pair, tissue, last, tool, self._camera.project(predicted))
        plane = self._registration.refine(
            pair.left_fine, tissue, start[:, :2], windows=(COARSE, COARSE, FINE, FINE, FINE)
        )
        dense = self._disparity(pair.left, pair.right)
        coarse, sure = self._coarse_disparity(dense, plane.value, start[:, 2])
        depth = refine_disparity(
            pair.left_fine, pair.right_fine, (tissue, tissue_right), plane.value, coarse, self._material, self._field
        )
        uvd = np.concatenate([plane.value, depth.value], axis=1)
        visible = self._accept(tissue, plane, depth, coarse, sure)
        off_trend = self._field.off_trend(plane.value, visible)
        visible &= off_trend < OFF_TREND
        self._last = _Last(grey=pair.left_grey, uvd=uvd, visible=visible, tool=tool)
        noise = np.zeros((len(uvd), 3, 3))
        lateral = LATERAL_SD**2 + (TREND_FACTOR * np.where(visible, off_trend, 0)) ** 2
        noise[:, :2, :2] = lateral[:, None, None] * np.eye(2) + NOISE_FACTOR**2 * plane.spread
        noise[:, 2, 2] = DISPARITY_SD**2 + NOISE_FACTOR**2 * depth.spread[:, 0, 0]
        return self._measurement(uvd, visible, PERSISTENCE * noise)

    def _guess(
        self,
        pair: RectifiedPair,
        tissue: Bool[np.ndarray, "height width"],
        last: _Last,
        tool: ToolState,
        believed: Float[np.ndarray, "n 3"],
    ) -> Float[np.ndarray, "n 3"]:
        """Pixel and disparity to start from: carried on from the last frame, from rest or from the belief.

        The last two are tried where the sheet may have jumped (the jaws opened or closed, the tool went far) or where
        carrying on lost much of it; what then matches best is taken.
        """
        before = np.where(last.visible[:, None], last.uvd, believed)
        best = self._moved(last.grey, before, pair.left_grey)
        share = self._found(pair, tissue, best)
        jaws = (tool.grasp, tool.closed) != (last.tool.grasp, last.tool.closed)
        far = np.linalg.norm(tool.position - last.tool.position) > FAR * self._spacing
        if jaws or far or share < MOSTLY_FOUND:
            for guess in (self._moved(self._first, self._first_uvd, pair.left_grey), believed):
                found = self._found(pair, tissue, guess)
                if found > share:
                    best, share = guess, found
        return best

    def _found(
        self, pair: RectifiedPair, tissue: Bool[np.ndarray, "height width"], guess: Float[np.ndarray, "n 3"]
    ) -> float:
        """Share of the particles that match after one coarse step from a guess."""
        tried = self._registration.refine(pair.left_fine, tissue, guess[:, :2], windows=(COARSE,))
        return float(np.mean(tried.match.correlation > LEAST_CORRELATION))

    def _moved(
        self, grey: Float[np.ndarray, "height width"], uvd: Float[np.ndarray, "n 3"], now: Float[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "n 3"]:
        """Particles carried along by the flow between two images, smooth where the flow cannot be used."""
        moved, usable = flow_at(uvd[:, :2], *dense_flow(grey, now))
        usable &= self._field.stray(moved, usable) < STRAY_FLOW
        filled = self._field.fill(moved, usable)
        return uvd + np.pad(np.where(usable[:, None], moved, filled), ((0, 0), (0, 1)))

    def _coarse_disparity(
        self,
        dense: Float[np.ndarray, "height width"],
        pixels: Float[np.ndarray, "n 2"],
        before: Float[np.ndarray, " n"],
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Dense disparity at the particles, without strays; carried on from `before` where there is none."""
        x, y = pixels.astype(np.float32).T
        value = cv2.remap(dense, x[None], y[None], cv2.INTER_NEAREST, borderValue=np.nan)[0].astype(float)
        change = np.where(np.isfinite(value), value - before, 0)[:, None]
        sure = np.isfinite(value)
        sure &= self._field.stray(change, sure) < STRAY_DISPARITY
        filled = self._field.fill(change, sure)
        return before + np.where(sure, change[:, 0], filled[:, 0]), sure

    def _accept(
        self,
        tissue: Bool[np.ndarray, "height width"],
        plane: Registered,
        depth: Registered,
        coarse: Float[np.ndarray, " n"],
        sure: Bool[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:
        """In frame, tissue-coloured, not half hidden, alike in all images, and settled."""
        x, y = plane.value.astype(np.float32).T
        coloured = sample_mask(tissue, x[None], y[None])[0]
        whole = np.minimum(plane.match.share, depth.match.share) > LEAST_SHARE * self._whole
        alike = np.minimum(plane.match.correlation, depth.match.correlation) > LEAST_CORRELATION
        settled = (plane.last_step < SETTLED) & (depth.last_step < SETTLED)
        consistent = ~sure | (np.abs(depth.value[:, 0] - coarse) < DISAGREEMENT)
        return coloured & whole & alike & settled & consistent & (depth.value[:, 0] > 0)

    def _measurement(
        self, uvd: Float[np.ndarray, "n 3"], visible: Bool[np.ndarray, " n"], noise: Float[np.ndarray, "n 3 3"]
    ) -> Track:
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
