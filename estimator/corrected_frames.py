"""Frames as the filter takes them under a corrected model: the declared effects act on energy, tool and view of each.

An effect may depend on the state of its frame. So a frame is taken again, from the filter's state before it, until the
model that its state leads to is the one that it was taken with. Later refinements keep the energy, the tool and the
positions without the view that were found then.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jiggle_mj.errors import OptionError
from jiggle_mj.observation import Declaration, Observation, ToolReport, ToolState

from .config import EstimatorConfig
from .effects import LIBRARY
from .effects.corrected_model import CorrectedModel, declared_effects, resting
from .effects.frame_history import CONVERGED, MAX_PREDICTIONS, FrameHistory, FrameRecord, padded
from .effects.sheet_model import FrameContext, SheetModel, look, without_view
from .filters.evidence import Evidence
from .filters.filter import Filter, FilterState
from .filters.posterior_summary import Update
from .fusion import FusedFrame
from .grip import GripHold
from .perception.track import Track

OPEN_PASSES = 3
"""Passes that remove the view's errors from positions with open jaws: each multiplies their error by the view's."""
MIN_REPORTS = 8
"""Number of reports of the tool, and of states, that room is made for at least; it doubles when it is full."""

Fuse = Callable[[Track, GripHold, ToolState], FusedFrame]
"""Function that combines what is seen and what the tool reports in one frame."""


def refuse_unusable_effects(declaration: Declaration, config: EstimatorConfig) -> None:
    """Refuse declared effects that an estimate with these settings cannot have in its model.

    Raises:
        OptionError: there is one; or one that is no effect of the library, see `declared_effects`.
    """
    declared = declared_effects(declaration)
    names = ", ".join(declared)
    if declared and config.filter != "implicit":
        raise OptionError(f"declared effects ({names}) need the filter 'implicit'; this one is {config.filter!r}.")
    if declared and config.membrane != "triangles":
        raise OptionError(f"declared effects ({names}) need membrane 'triangles'; it is {config.membrane!r}.")
    for effect in LIBRARY:
        if effect.name in declared and effect.needs_later_reports:
            raise OptionError(
                f"Declaration.effects: {effect.name} needs what the tool reports after each frame, which an estimate "
                "does not have yet; shift the tool's stamps instead (tool_clock_offset in recording.toml)."
            )


@dataclass(kw_only=True)
class CorrectedFrames:
    """The frames with closed jaws so far, and the model of each."""

    model: CorrectedModel
    """The declared sheet with its effects."""
    rest_time: int
    """Time at which the sheet was in its rest shape [ns]."""
    records: list[FrameRecord] = field(default_factory=list)
    """Frames so far."""

    def update(
        self,
        filter: Filter[Any],
        state: FilterState,
        *,
        observation: Observation,
        track: Track,
        hold: GripHold,
        before: Float[np.ndarray, "n 3"],
        fuse: Fuse,
    ) -> tuple[FusedFrame, FilterState, Update]:
        """Return a frame as it was fused, the filter's state after it, and the outcome; see `Filter.update`.

        Args:
            filter: takes the frame.
            state: of the filter before the frame.
            observation: the frame.
            track: what is seen of the particles, with the view's errors.
            hold: the grasp, with the view's errors in the positions that were observed.
            before: positions after the frame before, or at rest where the jaws have just closed [m].
            fuse: combines what is seen and what the tool reports.

        Raises:
            OptionError: the recording has no such view or tool as an effect changes.
        """
        self._refuse_without_evidence(track, observation.tool)
        record, rest = self._record(observation, hold, before), np.asarray(self.model.energy.rest)

        def fused(x: Float[np.ndarray, "n 3"]) -> FusedFrame:
            context = self._context(replace(record, state=x), rest)
            model = self.model.model(context, jnp.asarray(observation.tool.position - hold.tip))
            seen = replace(track, positions=track.positions - _view_error(model, x))
            frame = fuse(seen, *self._grip(model, context, hold, observation.tool, seen))
            return replace(frame, evidence=replace(frame.evidence, energy=model.energy))

        frame, x = fused(before), before
        after, update = filter.update(state, frame.evidence, jnp.asarray(frame.start))
        for _ in range(MAX_PREDICTIONS - 1):
            moved, x = np.abs(np.asarray(update.x) - x).max(), np.asarray(update.x)
            if (
                not update.explains_the_frame
                or moved < CONVERGED
                or _same(frame.evidence, (again := fused(x)).evidence)
            ):
                break
            frame = again
            after, update = filter.update(state, frame.evidence, jnp.asarray(frame.start))
        if update.explains_the_frame:
            self.records.append(replace(record, state=np.asarray(update.x)))
        return frame, after, update

    def without_view(self, x: Float[np.ndarray, "n 3"], time: int) -> Float[np.ndarray, "n 3"]:
        """Return where particles are that are observed at x [m], at a time [ns] with open or just closed jaws."""
        context = resting(self.model.energy.rest, (time - self.rest_time) / 1e9)
        model, found = self.model.model(context, jnp.zeros(3)), x
        for _ in range(OPEN_PASSES):
            found = x - _view_error(model, found)
        return found

    def _refuse_without_evidence(self, track: Track, tool: ToolState) -> None:
        """Refuse effects on what a recording does not have.

        Raises:
            OptionError: an effect of the view, and points without identities; or one of the tool, whose position is
                that of points.
        """
        if track.cloud is not None and (names := self._of_view):
            raise OptionError(
                f"Declaration.effects: {', '.join(names)} cannot be used with points without identities; leave it out."
            )
        if tool.by_points and (names := self._of_tool):
            raise OptionError(
                f"Declaration.effects: {', '.join(names)} cannot be used where the tool's position is that of the held "
                "points; leave it out."
            )

    @cached_property
    def _of_view(self) -> list[str]:
        return self.model.that_change("view")

    @cached_property
    def _of_tool(self) -> list[str]:
        return self.model.that_change("tool")

    def _record(self, observation: Observation, hold: GripHold, state: Float[np.ndarray, "n 3"]) -> FrameRecord:
        """Return time, tool and state of a frame; the jaws closed in the first frame of its grasp."""
        tool, time = observation.tool, self._seconds(observation.time)
        last = self.records[-1] if self.records and self.records[-1].grasp == tool.grasp else None
        closed = 0.0 if last is None else time - last.time + last.closed
        reports = (*observation.reports, ToolReport(time=observation.time, position=tool.position))
        times = [(self._seconds(report.time), report.position - hold.tip) for report in reports]
        return FrameRecord(
            grasp=tool.grasp,
            time=time,
            closed=closed,
            state=state,
            reports=tuple(report for report in times if report[0] >= time - closed),
        )

    def _context(self, record: FrameRecord, rest: Float[np.ndarray, "n 3"]) -> FrameContext:
        """Return what an effect may know of a frame; of few sizes, as each is compiled."""
        remembers = any(effect.history_dependent for effect in self.model.effects)
        frames = [*(one for one in self.records if remembers or one.grasp == record.grasp), record]
        states = np.array([one.state for one in frames])
        context = FrameHistory(frames, rest).context(len(frames) - 1, states)
        series = [report for one in frames if one.grasp == record.grasp for report in one.reports]
        kept = frames if remembers else frames[-1:]
        more = _room(len(kept)) - len(kept)
        past = np.concatenate([states[-len(kept) :], np.tile(rest, (more, 1, 1))])
        began, ended = (  # what is not past yet has not begun
            np.append(np.asarray(times)[-len(kept) :], np.full(more, np.inf))
            for times in (context.began, context.ended)
        )
        return eqx.tree_at(
            lambda c: (c.report_times, c.reports, c.past, c.began, c.ended),
            context,
            (*padded(series, _room(len(series))), *map(jnp.asarray, (past, began, ended))),
        )

    def _grip(
        self, model: SheetModel, context: FrameContext, hold: GripHold, tool: ToolState, seen: Track
    ) -> tuple[GripHold, ToolState]:
        """Return the grasp and the tool without the errors of view and tool."""
        if self._of_view:
            at_closing = eqx.tree_at(
                lambda c: (c.time, c.closed), context, (context.time - context.closed, jnp.zeros_like(context.closed))
            )
            closing = self.model.model(at_closing, model.tool)
            corrected = np.asarray(without_view(closing, context.rest, jnp.asarray(hold.closed_at)))
            hold = replace(hold, closed_at=np.where(hold.observed[:, None], corrected, hold.closed_at))
        displacement, shown = np.asarray(model.tool), hold.held & seen.visible
        if tool.by_points and shown.any():
            displacement = np.mean((seen.positions - hold.rotated(tool))[shown], axis=0)
        return hold, replace(tool, position=hold.tip + displacement)

    def _seconds(self, time: int) -> float:
        return (time - self.rest_time) / 1e9


def _room(count: int) -> int:
    """Return the next of a few sizes."""
    return MIN_REPORTS * 2 ** max(0, (-(-count // MIN_REPORTS) - 1).bit_length())


@eqx.filter_jit
def _looked(model: SheetModel, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return look(model, x) - x


def _view_error(model: SheetModel, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return by how much particles at x are observed elsewhere [m]."""
    return np.asarray(_looked(model, jnp.asarray(x)))


def _same(one: Evidence, other: Evidence) -> bool:
    """Return whether two passes have the same energy, and positions that agree."""
    return bool(jnp.all(jnp.abs(one.y - other.y) < CONVERGED)) and bool(eqx.tree_equal(one.energy, other.energy))
