"""Effects of the tool, the camera and the tracker: what is reported, and how the sheet is seen."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.membrane import TriangleMembrane
from .effect import Effect
from .sheet_model import FrameContext, SheetModel, across, extent
from .surface_points import SurfacePoints

SMALL_ANGLE = 1e-3
"""[rad]."""
BEGAN_SD = 2.0
"""Of when a drift began, from when the sheet lay as its rest shape has it [s]."""
EDGE = 1e-6
"""How far what slides may go beyond the edge, so that at rest it may go either way [m]."""


def _tool_bias(model: SheetModel, theta: Float[Array, " 3"], moment: FrameContext) -> SheetModel:
    """What is held lies elsewhere than the tool's way since the jaws closed says: they slid, or the report jumped."""
    return _taken(model, model.tool + jnp.where(moment.closed > 0, theta, 0.0))


def _tool_scale(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """The true way is exp(theta) times the reported one."""
    return _taken(model, jnp.exp(theta[0]) * model.tool)


def _tool_latency(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """What is reported now is where the tool was theta ago."""
    return _at_another_time(model, moment, theta[0])


def _image_latency(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """What is seen now is the sheet as the tool held it theta ago."""
    return _at_another_time(model, moment, -theta[0])


def _tool_turn(model: SheetModel, theta: Float[Array, " 3"], moment: FrameContext) -> SheetModel:
    """The true way is the reported one turned by theta [rad], late as either may be."""
    return _taken(model, _rotation(theta) @ model.tool)


def _camera_bias(model: SheetModel, theta: Float[Array, " 6"], moment: FrameContext) -> SheetModel:
    """Shift [m] and turn [rad] of all that is seen, about the middle of the sheet, since it was seen at rest."""
    return _moved(model, theta[:3], theta[3:])


def _camera_drift(model: SheetModel, theta: Float[Array, " 7"], moment: FrameContext) -> SheetModel:
    """The same, growing with time from when it began."""
    lasted = _since(theta[6], moment)
    return _moved(model, lasted * theta[:3], lasted * theta[3:6])


def _depth_scale(model: SheetModel, theta: Float[Array, " 4"], moment: FrameContext) -> SheetModel:
    """All is seen larger by a factor about the camera, and that is somewhere beside the middle of the sheet."""
    factor = jnp.exp(theta[0])
    larger = eqx.tree_at(lambda one: one.view.turn, model, factor * model.view.turn)
    return eqx.tree_at(lambda one: one.view.shift, larger, larger.view.shift + (1 - factor) * theta[1:])


def _point_slip(model: SheetModel, theta: Float[Array, " 3"], moment: FrameContext) -> SheetModel:
    """What is followed slides over the sheet since it began to, at most to the edge of the rectangle around it."""
    membrane = model.term(TriangleMembrane)
    place = across(membrane, moment.rest, moment.rest)
    low, high = extent(place)
    to = jnp.clip(place + _since(theta[2], moment) * theta[None, :2], low - EDGE, high + EDGE)
    return eqx.tree_at(
        lambda one: one.view.followed, model, SurfacePoints.at(jnp.asarray(membrane.vertices), place, to)
    )


def _surface_height(model: SheetModel, theta: Float[Array, " 1"], moment: FrameContext) -> SheetModel:
    """The surface that is seen lies theta above the middle of the sheet."""
    return eqx.tree_at(lambda one: one.view.height, model, model.view.height + theta[0])


def _since(began: Float[Array, ""], moment: FrameContext) -> Float[Array, ""]:
    """How long it has lasted [s]."""
    return jnp.maximum(moment.time - began, 0.0)


def _at_another_time(model: SheetModel, moment: FrameContext, later: Float[Array, ""]) -> SheetModel:
    """With the tool where its reports have it so much later; where the jaws close, what they hold has gone nowhere."""

    def at(time: Array) -> Array:
        return jnp.stack([jnp.interp(time, moment.report_times, moment.reports[:, k]) for k in range(3)])

    further = at(moment.time + later) - at(moment.time)
    then = eqx.tree_at(lambda one: one.time, model, model.time + later)
    return _taken(then, then.tool + jnp.where(moment.closed > 0, further, 0.0))


def _taken(model: SheetModel, way: Float[Array, " 3"]) -> SheetModel:
    return eqx.tree_at(lambda one: one.tool, model, way)


def _moved(model: SheetModel, shift: Float[Array, " 3"], turn: Float[Array, " 3"]) -> SheetModel:
    view = model.view
    changed = view.shift + shift, _rotation(turn) @ view.turn
    return eqx.tree_at(lambda one: (one.view.shift, one.view.turn), model, changed)


def _rotation(turn: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """About an axis by its length: Rodrigues' formula, by its series where the angle is small."""
    x, y, z = turn
    none = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([none, -z, y]), jnp.stack([z, none, -x]), jnp.stack([-y, x, none])])
    square = jnp.sum(turn**2)
    small = square < SMALL_ANGLE**2
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    sine = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / safe)
    return jnp.eye(3) + sine * cross + versine * cross @ cross


SENSING = (
    Effect(
        name="tool_bias",
        acts=_tool_bias,
        units=("m", "m", "m"),
        prior_sd=(2e-3, 2e-3, 2e-3),
        source="a surgical robot's tip is reported within 0.7 to 3 mm",
        confounded_with=("camera_bias", "tool_latency"),
        sensing=True,
    ),
    Effect(
        name="tool_scale",
        acts=_tool_scale,
        units=("log factor",),
        prior_sd=(0.1,),
        source="a lever that is a tenth longer than was measured",
        confounded_with=("depth_scale", "tool_latency"),
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
        prior_sd=(3e-4, 3e-4, 3e-4, 3e-3, 3e-3, 3e-3, BEGAN_SD),
        source="an arm that sinks by millimetres in ten seconds",
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
