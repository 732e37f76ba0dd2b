"""Tracker of stereo pairs: 3-D position, covariance and visibility of each particle in every frame.

`start` lays the estimator's own mesh over the first pair. `track` finds its particles by appearance: an initial guess
from dense flow, registration to the first image through the mesh, disparity between the current images. It uses neither
the tissue's mechanics nor the truth; the caller's predicted positions are one more initial guess.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.observation import StereoPair, ToolState

from .config import StereoTrackerConfig
from .disparity import Disparity, SemiGlobalMatching
from .flow import dense_flow, flow_at
from .mask_doubts import refuse_doubtful, refuse_grey
from .material_map import MaterialMap
from .mesh_field import MeshField
from .rectified import RectifiedPair, Rectifier
from .registration import FINE_STEPS, MaterialRegistration, Registered, refine_disparity
from .resampling import sample_mask
from .sheet_mesh import DisparitySurface, lay_mesh
from .tissue_mask import FrameMask, TissueMask, WarmTissue, largest_blob
from .track import UNSEEN_VARIANCE, Track

COARSE_STEPS = 2
"""Steps of a registration with the coarse window, before those with the fine one."""
MIN_DISPARITY = 0.1
"""Disparity below which a particle is not back-projected, but has its first position [px]."""


@dataclass(kw_only=True)
class _PreviousFrame:
    """State of the tracker after a frame, from which the next one starts."""

    grey: Float[np.ndarray, "height width"]
    uvd: Float[np.ndarray, "n 3"]
    visible: Bool[np.ndarray, " n"]
    tool: ToolState


class StereoTracker:
    """Tracker of one sheet in a recording of one camera."""

    def __init__(
        self,
        camera: StereoCamera,
        *,
        spacing: float = 4.4e-3,
        mask: TissueMask | FrameMask | None = None,
        disparity: Disparity | None = None,
        config: StereoTrackerConfig | None = None,
    ):
        """Choose the parts of the tracker.

        Args:
            camera: the calibrated pair.
            spacing: distance between neighbouring particles [m].
            mask: segmentation of tissue; if None `WarmTissue()`, which is refused where it is in doubt.
            disparity: dense disparity; `SemiGlobalMatching.for_camera` if None.
            config: thresholds and noise; the defaults if None.

        Raises:
            ValueError: the spacing is not above 0.
        """
        if not spacing > 0:
            raise ValueError(f"StereoTracker.spacing must be above 0 m; got {spacing}.")
        self._camera, self._spacing = camera, spacing
        self._config = config = config or StereoTrackerConfig()
        self._mask = WarmTissue() if mask is None else mask
        self._by_colour = mask is None
        self._disparity = (
            SemiGlobalMatching.for_camera(camera, min_depth=config.min_depth) if disparity is None else disparity
        )
        self._rectify = Rectifier(camera, config)
        self._previous: _PreviousFrame | None = None

    def start(self, images: StereoPair, tool: ToolState, *, index: int = 0) -> Sheet:
        """Return the mesh laid over the first pair; the tissue should be at rest.

        Args:
            images: raw pair.
            tool: state of the tweezer.
            index: of the frame, for a `FrameMask`.

        Raises:
            MaskError: the built-in segmentation is in doubt.
            PerceptionError: black image, no tissue, two sheets, no disparity, or too few particles.
        """
        config = self._config
        pair = self._rectify(images)
        if pair.black_side is not None:
            raise PerceptionError(f"the {pair.black_side} image is black; check the light, the exposure and the cable.")
        if self._by_colour:
            refuse_grey(pair.left)
        tissue = largest_blob(self._tissue(pair, "left", index, rest=True), smallest=config.mesh.min_sheet)
        if self._by_colour:
            refuse_doubtful(pair.left, tissue)
        dense = self._disparity(pair.left, pair.right)
        mesh = lay_mesh(tissue, dense, self._camera, spacing=self._spacing, config=config.mesh)
        uv = mesh.uvd[:, :2]
        self._material = MaterialMap(uv, mesh.faces, tissue, config.registration)
        self._field = MeshField(uv, mesh.faces)
        refined = refine_disparity(
            pair.left_fine,
            pair.right_fine,
            (tissue, self._tissue(pair, "right", index, rest=True)),
            uv,
            mesh.uvd[:, 2],
            self._material,
            self._field,
            config=config.registration,
        )
        good = refined.match.correlation > config.registration.min_correlation
        if good.mean() < config.mesh.min_matched:
            raise PerceptionError(
                f"left and right images agree on {good.mean():.0%} of the particles, at least "
                f"{config.mesh.min_matched:.0%} is needed: are the cameras swapped, the pair not rectified, or the "
                "tissue without texture?"
            )
        uvd = DisparitySurface(uv[good], refined.value[good, 0], config.mesh)(uv)
        self._first, self._first_uvd = pair.left_grey, uvd
        self._registration = MaterialRegistration(pair.left_grey, self._material, self._field, config.registration)
        everywhere = np.ones(len(uv), bool)
        fine = config.registration.fine_window
        self._rest_share = self._registration.refine(pair.left_fine, tissue, uv, windows=(fine,)).match.share
        self._previous = _PreviousFrame(grey=pair.left_grey, uvd=uvd, visible=everywhere, tool=tool)
        return Sheet(rest=self._camera.back_project(uvd), faces=mesh.faces)

    def track(
        self, images: StereoPair, tool: ToolState, *, predicted: Float[np.ndarray, "n 3"], index: int = 0
    ) -> Track:
        """Return the measurement of the particles in one more pair.

        Args:
            images: raw pair.
            tool: present state of the tweezer; after a new grasp or opened jaws the rest shape is one initial guess.
            predicted: predicted particle positions [m], the initial guess of unseen particles.
            index: of the frame, for a `FrameMask`.

        Raises:
            ValueError: called before `start`.
        """
        config, last = self._config, self._previous
        if last is None:
            raise ValueError("StereoTracker.track needs a sheet; call start with the first pair.")
        pair = self._rectify(images)
        if pair.black_side is not None:
            return self._measurement(last.uvd, np.zeros(len(last.uvd), bool), np.zeros((len(last.uvd), 3, 3)))
        tissue, tissue_right = (self._tissue(pair, side, index, rest=False) for side in ("left", "right"))
        start = self._guess(pair, tissue, last, tool, self._camera.project(predicted))
        match = config.registration
        windows = (*COARSE_STEPS * (match.coarse_window,), *FINE_STEPS * (match.fine_window,))
        plane = self._registration.refine(pair.left_fine, tissue, start[:, :2], windows=windows)
        dense = self._disparity(pair.left, pair.right)
        coarse, dense_known = self._coarse_disparity(dense, plane.value, start[:, 2])
        depth = refine_disparity(
            pair.left_fine,
            pair.right_fine,
            (tissue, tissue_right),
            plane.value,
            coarse,
            self._material,
            self._field,
            config=config.registration,
        )
        uvd = np.concatenate([plane.value, depth.value], axis=1)
        visible = self._accept(tissue, plane, depth, coarse, dense_known)
        off_trend = self._field.off_trend(plane.value, visible)
        visible &= off_trend < config.max_off_trend
        self._previous = _PreviousFrame(grey=pair.left_grey, uvd=uvd, visible=visible, tool=tool)
        noise = np.zeros((len(uvd), 3, 3))
        lateral = config.lateral_sd**2 + (config.trend_factor * np.where(visible, off_trend, 0)) ** 2
        noise[:, :2, :2] = lateral[:, None, None] * np.eye(2) + config.noise_factor**2 * plane.spread
        noise[:, 2, 2] = config.disparity_sd**2 + config.noise_factor**2 * depth.spread[:, 0, 0]
        return self._measurement(uvd, visible, config.variance_inflation * noise)

    def _tissue(
        self, pair: RectifiedPair, side: Literal["left", "right"], index: int, *, rest: bool
    ) -> Bool[np.ndarray, "height width"]:
        """Return the tissue pixels of one rectified image."""
        if isinstance(self._mask, FrameMask):
            return self._rectify.mask(self._mask.at(index, side, rest=rest), side)
        return self._mask(pair.left if side == "left" else pair.right)

    def _guess(
        self,
        pair: RectifiedPair,
        tissue: Bool[np.ndarray, "height width"],
        last: _PreviousFrame,
        tool: ToolState,
        predicted: Float[np.ndarray, "n 3"],
    ) -> Float[np.ndarray, "n 3"]:
        """Return the initial guess of pixel and disparity [px]: from the last frame, from rest, or as predicted.

        The last two are tried if the sheet may have jumped (the jaws opened or closed, the tool moved far), or if the
        first loses many particles. The guess that matches most particles is used.
        """
        before = np.where(last.visible[:, None], last.uvd, predicted)
        best = self._advected(last.grey, before, pair.left_grey)
        share = self._matched_share(pair, tissue, best)
        jaws = (tool.grasp, tool.closed) != (last.tool.grasp, last.tool.closed)
        far = np.linalg.norm(tool.position - last.tool.position) > self._config.max_tool_step * self._spacing
        if jaws or far or share < self._config.min_found:
            for guess in (self._advected(self._first, self._first_uvd, pair.left_grey), predicted):
                guess_share = self._matched_share(pair, tissue, guess)
                if guess_share > share:
                    best, share = guess, guess_share
        return best

    def _matched_share(
        self, pair: RectifiedPair, tissue: Bool[np.ndarray, "height width"], guess: Float[np.ndarray, "n 3"]
    ) -> float:
        """Return the share of the particles that match after one coarse step from a guess."""
        config = self._config.registration
        tried = self._registration.refine(pair.left_fine, tissue, guess[:, :2], windows=(config.coarse_window,))
        return float(np.mean(tried.match.correlation > config.min_correlation))

    def _advected(
        self, grey: Float[np.ndarray, "height width"], uvd: Float[np.ndarray, "n 3"], now: Float[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return particles moved by the flow between two images, smooth where the flow cannot be used [px]."""
        flow, usable = flow_at(uvd[:, :2], *dense_flow(grey, now, max_gap=self._config.max_flow_gap))
        motion, _ = self._field.repaired(flow, usable, max_stray=self._config.max_flow_stray)
        return uvd + np.pad(motion, ((0, 0), (0, 1)))

    def _coarse_disparity(
        self,
        dense: Float[np.ndarray, "height width"],
        pixels: Float[np.ndarray, "n 2"],
        before: Float[np.ndarray, " n"],
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Return the dense disparity at the particles [px], and where it is usable.

        Elsewhere the result is `before` with a smooth change.
        """
        x, y = pixels.astype(np.float32).T
        value = cv2.remap(dense, x[None], y[None], cv2.INTER_NEAREST, borderValue=np.nan)[0].astype(float)
        change = np.where(np.isfinite(value), value - before, 0)[:, None]
        max_stray = self._config.max_disparity_stray
        change, usable = self._field.repaired(change, np.isfinite(value), max_stray=max_stray)
        return before + change[:, 0], usable

    def _accept(
        self,
        tissue: Bool[np.ndarray, "height width"],
        plane: Registered,
        depth: Registered,
        coarse: Float[np.ndarray, " n"],
        dense_known: Bool[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:
        """Return which particles are in frame, on tissue, mostly visible, matched in all images, and converged."""
        config = self._config
        x, y = plane.value.astype(np.float32).T
        coloured = sample_mask(tissue, x[None], y[None])[0]
        unhidden = np.minimum(plane.match.share, depth.match.share) > config.min_visible_share * self._rest_share
        correlation = np.minimum(plane.match.correlation, depth.match.correlation)
        matched = correlation > config.registration.min_correlation
        converged = np.maximum(plane.last_step, depth.last_step) < config.max_last_step
        consistent = ~dense_known | (np.abs(depth.value[:, 0] - coarse) < config.max_disparity_gap)
        return coloured & unhidden & matched & converged & consistent & (depth.value[:, 0] > 0)

    def _measurement(
        self, uvd: Float[np.ndarray, "n 3"], visible: Bool[np.ndarray, " n"], noise: Float[np.ndarray, "n 3 3"]
    ) -> Track:
        """Return the track of pixels and disparities with their covariance [px, px^2], in world coordinates."""
        uvd = np.where(uvd[:, 2:] > MIN_DISPARITY, uvd, self._first_uvd)
        jacobian = self._camera.back_projection_jacobian(uvd)
        covariance = jacobian @ noise @ jacobian.transpose(0, 2, 1)
        return Track(
            positions=np.where(visible[:, None], self._camera.back_project(uvd), np.nan),
            covariance=np.where(visible[:, None, None], covariance, UNSEEN_VARIANCE * np.eye(3)),
            visible=visible,
            uvd=uvd,
        )
