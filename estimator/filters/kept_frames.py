"""The frames of the filter 'implicit' as plain arrays, and its state from them, so that they are not tracked again."""

from dataclasses import fields, replace
from itertools import groupby

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jiggle_mj.estimate import KeptFrames

from .evidence import Evidence, MeasuredPull
from .filter import FilterState
from .grasp import GraspFrame, GraspFrames
from .implicit import ImplicitFilter, ImplicitState

STORED = ("y", "precision", "held", "force_unknown", "fields", "force")
"""Parts of a frame's evidence that are kept."""
NOT_NEEDED = ("pull",)
"""Parts that this filter does not use."""


def kept_frames(state: FilterState) -> KeptFrames | None:
    """Return the frames of a state; None where plain arrays do not hold all of them.

    That is of another filter, without frames, after a cut or suture, and where a frame holds more than `STORED`, such
    as a cloud.
    """
    if not isinstance(state, ImplicitState) or not state.grasps or state.changes:
        return None
    frames = [(k, frame) for k, grasp in enumerate(state.grasps) for frame in grasp.frames]
    others = [field.name for field in fields(Evidence) if field.name not in STORED + NOT_NEEDED]
    if any(getattr(frame.evidence, name) is not None for _, frame in frames for name in others):
        return None

    def stacked(name: str) -> np.ndarray:
        return np.array([np.asarray(getattr(frame.evidence, name)) for _, frame in frames])

    shared = frames[0][1].evidence.fields
    forces = [(k, force) for k, (_, frame) in enumerate(frames) if (force := frame.evidence.force) is not None]
    return KeptFrames(
        grasp=np.array([k for k, _ in frames]),
        x=np.array([np.asarray(frame.x) for _, frame in frames]),
        y=stacked("y"),
        precision=stacked("precision"),
        held=stacked("held"),
        force_unknown=stacked("force_unknown"),
        fields=None if shared is None else np.asarray(shared),
        force_index=np.array([k for k, _ in forces], int),
        pull=np.array([force.pull for _, force in forces]).reshape(-1, 3),
        pull_covariance=np.array([force.covariance for _, force in forces]).reshape(-1, 3, 3),
        offset_sd=np.array([float(force.offset_sd) for _, force in forces], float),
        offset_number=np.array([int(force.offset_number) for _, force in forces], int),
    )


def resumed(filter: ImplicitFilter, key: PRNGKeyArray, frames: KeptFrames, b: Float[np.ndarray, " n"]) -> ImplicitState:
    """Return the state after frames that were kept, released but not yet refined thoroughly.

    Args:
        filter: the filter.
        key: source of all draws.
        frames: as they were kept.
        b: stiffnesses at which they are linearised [N/m].
    """
    shared = None if frames.fields is None else jnp.asarray(frames.fields)
    state = filter.init(key)
    s = state.belief.bounded(jnp.asarray(b))
    forces = {
        int(k): MeasuredPull(
            index=jnp.asarray(k),
            pull=jnp.asarray(frames.pull[i]),
            covariance=jnp.asarray(frames.pull_covariance[i]),
            offset_sd=jnp.asarray(frames.offset_sd[i]),
            offset_number=jnp.asarray(frames.offset_number[i]),
        )
        for i, k in enumerate(frames.force_index)
    }

    def frame(k: int) -> GraspFrame:
        evidence = Evidence(
            y=jnp.asarray(frames.y[k]),
            precision=jnp.asarray(frames.precision[k]),
            held=jnp.asarray(frames.held[k]),
            force_unknown=jnp.asarray(frames.force_unknown[k]),
            fields=shared,
            force=forces.get(k),
        )
        return GraspFrame(evidence=evidence, x=jnp.asarray(frames.x[k]), s=s)

    empty = GraspFrames.empty(len(b))
    grasps = tuple(
        replace(empty, frames=tuple(map(frame, members)))
        for _, members in groupby(range(len(frames.grasp)), key=lambda k: frames.grasp[k])
    )
    return filter.linearised(replace(state, grasps=grasps, thorough_due=True), jnp.asarray(b))
