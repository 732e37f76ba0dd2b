"""Effects of the tool, the camera and the tracker: what the tool reports, and how the sheet is observed."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.membrane import TriangleMembrane
from .effect import Effect
from .sheet_model import FrameContext, SheetModel, extent, material_coordinates
from .surface_points import SurfacePoints

SMALL_ANGLE = 1e-3
"""Angle below which a rotation is computed by its series [rad]: the terms that are left out are below rounding."""
BEGAN_SD = 2.0
"""Prior standard deviation of the time at which a drift begins, from the time of the rest shape [s]."""
DRIFT_RATES = (1e-3, 1e-4, 1e-5)
"""Prior standard deviations of the speed of a drift, of which one holds, in equal steps of the logarithm [m/s]."""
DRIFT_ARM = 0.1
"""Distance at which a drift's rotation moves a point as fast as its shift does [m]: a camera's from the sheet."""
EDGE = 1e-6
"""Distance by which a sliding point may go beyond the edge, so that at rest it has derivatives both ways [m]."""


def _tool_bias(model: SheetModel, theta: Float[Array, " 3"], context: FrameContext) -> SheetModel:
    """Shift what is held by theta [m] since the jaws closed: it slid, or the tool's report jumped."""
    return _with_tool(model, model.tool + jnp.where(context.closed > 0, theta, 0.0))


def _tool_scale(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Multiply the tool's reported displacement by exp(theta)."""
    return _with_tool(model, jnp.exp(theta[0]) * model.tool)


def _tool_latency(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Let the tool's reports arrive late by theta [s]."""
    return _at_another_time(model, context, theta[0])


def _image_latency(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Let the images arrive late by theta [s]."""
    return _at_another_time(model, context, -theta[0])


def _tool_turn(model: SheetModel, theta: Float[Array, " 3"], context: FrameContext) -> SheetModel:
    """Rotate the tool's reported displacement by theta [rad], after the latencies have changed it."""
    return _with_tool(model, _rotation(theta) @ model.tool)


def _camera_bias(model: SheetModel, theta: Float[Array, " 6"], context: FrameContext) -> SheetModel:
    """Shift [m] and rotate [rad] all that is observed since the sheet was observed at rest, about its middle."""
    return _with_pose(model, theta[:3], theta[3:])


def _camera_drift(model: SheetModel, theta: Float[Array, " p"], context: FrameContext) -> SheetModel:
    """Shift and rotate like `camera_bias`, in proportion to the time since theta[6] [s]; 7 parameters for each rate."""
    drift = jnp.sum(theta.reshape(len(DRIFT_RATES), 7), axis=0)
    duration = _duration(drift[6], context)
    return _with_pose(model, duration * drift[:3], duration * drift[3:6])


def _depth_scale(model: SheetModel, theta: Float[Array, " 4"], context: FrameContext) -> SheetModel:
    """Scale all that is observed by exp(theta[0]) about the camera, at theta[1:] [m] from the sheet's middle."""
    factor = jnp.exp(theta[0])
    scaled = eqx.tree_at(lambda m: m.view.rotation, model, factor * model.view.rotation)
    return eqx.tree_at(lambda m: m.view.shift, scaled, scaled.view.shift + (1 - factor) * theta[1:])


def _point_slip(model: SheetModel, theta: Float[Array, " 3"], context: FrameContext) -> SheetModel:
    """Let tracked points slide over the sheet at theta[:2] [m/s] since theta[2] [s], at most to its bounding box."""
    membrane = model.term(TriangleMembrane)
    place = material_coordinates(membrane, context.rest, context.rest)
    low, high = extent(place)
    to = jnp.clip(place + _duration(theta[2], context) * theta[None, :2], low - EDGE, high + EDGE)
    points = SurfacePoints.at(jnp.asarray(membrane.vertices), place, to)
    return eqx.tree_at(lambda m: m.view.points, model, points)


def _surface_height(model: SheetModel, theta: Float[Array, " 1"], context: FrameContext) -> SheetModel:
    """Put the observed surface theta [m] above the middle surface of the sheet."""
    return eqx.tree_at(lambda m: m.view.height, model, model.view.height + theta[0])


def _duration(began: Float[Array, ""], context: FrameContext) -> Float[Array, ""]:
    """Return the time since an effect began [s], 0 before."""
    return jnp.maximum(context.time - began, 0.0)


def _at_another_time(model: SheetModel, context: FrameContext, later: Float[Array, ""]) -> SheetModel:
    """Return the model with the tool as reported `later` [s] than the frame; unmoved where the jaws close."""

    def at(time: Array) -> Array:
        return jnp.stack([jnp.interp(time, context.report_times, context.reports[:, k]) for k in range(3)])

    change = at(context.time + later) - at(context.time)
    shifted = eqx.tree_at(lambda m: m.time, model, model.time + later)
    return _with_tool(shifted, shifted.tool + jnp.where(context.closed > 0, change, 0.0))


def _with_tool(model: SheetModel, displacement: Float[Array, " 3"]) -> SheetModel:
    """Return the model with another displacement of the tool [m]."""
    return eqx.tree_at(lambda m: m.tool, model, displacement)


def _with_pose(model: SheetModel, shift: Float[Array, " 3"], rotation_vector: Float[Array, " 3"]) -> SheetModel:
    """Return the model whose view is shifted [m] and rotated [rad] in addition."""
    view = model.view
    changed = view.shift + shift, _rotation(rotation_vector) @ view.rotation
    return eqx.tree_at(lambda m: (m.view.shift, m.view.rotation), model, changed)


def _rotation(rotation_vector: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Return the rotation about a vector by its length [rad]: Rodrigues' formula, by its series at small angles."""
    x, y, z = rotation_vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    square = jnp.sum(rotation_vector**2)
    small = square < SMALL_ANGLE**2
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    sine = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / safe)
    return jnp.eye(3) + sine * cross + versine * cross @ cross


def _drift_sd(rate: float) -> tuple[float, ...]:
    """Return the prior standard deviations of a drift's parameters at one rate [m/s]."""
    return (*(rate,) * 3, *(rate / DRIFT_ARM,) * 3, BEGAN_SD)


SENSING = (
    Effect(
        name="tool_bias",
        acts=_tool_bias,
        units=("m", "m", "m"),
        prior_sd=(2e-3, 2e-3, 2e-3),
        source="a surgical robot's tip is reported within 0.7 to 3 mm",
        confounded_with=("camera_bias", "tool_latency", "grasp_slip"),
        sensing=True,
    ),
    Effect(
        name="tool_scale",
        acts=_tool_scale,
        units=("log factor",),
        prior_sd=(0.1,),
        source="a lever that is a tenth longer than was measured",
        confounded_with=("depth_scale", "tool_latency", "grasp_slip"),
        sensing=True,
    ),
    Effect(
        name="tool_latency",
        acts=_tool_latency,
        units=("s",),
        prior_sd=(0.2,),
        source="video of a surgical robot comes 0.06 to 0.26 s late",
        confounded_with=("image_latency", "tool_scale"),
        non_negative=True,
        sensing=True,
        needs_later_reports=True,
    ),
    Effect(
        name="image_latency",
        acts=_image_latency,
        units=("s",),
        prior_sd=(0.2,),
        source="video of a surgical robot comes 0.06 to 0.26 s late",
        confounded_with=("tool_latency", "material_damping", "viscous_drag"),
        non_negative=True,
        sensing=True,
    ),
    Effect(
        name="tool_turn",
        acts=_tool_turn,
        units=("rad", "rad", "rad"),
        prior_sd=(0.03, 0.03, 0.03),
        source="a hand-eye calibration is right within 1 to 2 degrees",
        confounded_with=("camera_bias", "tool_bias"),
        sensing=True,
    ),
    Effect(
        name="camera_bias",
        acts=_camera_bias,
        units=("m", "m", "m", "rad", "rad", "rad"),
        prior_sd=(3e-3, 3e-3, 3e-3, 0.03, 0.03, 0.03),
        source="a hand-eye calibration is right within 1 to 3 mm and 1 to 2 degrees",
        confounded_with=("depth_scale", "anchor_shift", "tool_bias", "tool_turn"),
        sensing=True,
    ),
    Effect(
        name="camera_drift",
        acts=_camera_drift,
        units=("m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s", "s"),
        prior_sd=_drift_sd(DRIFT_RATES[0]),
        sites=len(DRIFT_RATES),
        site_prior_sd=tuple(_drift_sd(rate) for rate in DRIFT_RATES),
        source="an arm that sinks by a centimetre in ten seconds, or by a millimetre in a quarter of an hour",
        confounded_with=("point_slip", "camera_bias"),
        sensing=True,
    ),
    Effect(
        name="depth_scale",
        acts=_depth_scale,
        units=("log factor", "m", "m", "m"),
        prior_sd=(0.03, 0.15, 0.15, 0.15),
        initial_guesses=((0.03, 0.0, 0.0, 0.15), (-0.03, 0.0, 0.0, 0.15)),
        source="a baseline that is wrong by 1 to 3 %, at a distance of 0.1 to 0.2 m",
        confounded_with=("camera_bias", "tool_scale", "pre_strain"),
        sensing=True,
    ),
    Effect(
        name="point_slip",
        acts=_point_slip,
        units=("m/s", "m/s", "s"),
        prior_sd=(2e-4, 2e-4, BEGAN_SD),
        source="a tracker that loses millimetres in ten seconds",
        confounded_with=("camera_drift",),
        sensing=True,
    ),
    Effect(
        name="surface_height",
        acts=_surface_height,
        units=("m",),
        prior_sd=(5e-4,),
        source="half of a sheet's thickness",
        confounded_with=("gravity", "bending"),
    ),
)
