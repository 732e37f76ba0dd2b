"""Sentences of a report: what was found, how it compares with the truth, and why to doubt it."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from jiggle_mj.estimate import Belief, Detection, Sheet
from jiggle_mj.plausibility.problems import MAX_NOISE_RATIO

from ..metrics.detection_metrics import dilate, patches
from ..metrics.flat_map import Plane
from ..metrics.truth_transfer import TransferredTruth

NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
"""A number in a reason."""
MAX_SD_RATIO = 1.5
"""Largest ratio of the found to the assumed standard deviation of a noise that is no doubt yet."""
MAX_FORCE_NIS = 3.0
"""Largest normalised innovation squared of the measured force that is no doubt yet [1]."""
SURE_FACTOR = 2.0
"""Logarithm of the stiffness factor from which the declared stiffness is doubted [standard deviation]."""
MIN_FACTOR = 1.15
"""Stiffness factor, or one over it, below which it is no doubt [1]: the model and its bed are not better than that."""
MIN_CLOUD_SHARE = 0.8
"""Smallest share of a cloud's points on the sheet that is no doubt yet [1]: 0.95 where 5 % are outliers; the tool shows
as well. What lies below the sheet pulls it down where both are near."""
LISTED_PATCHES = 3
"""Patches whose place is given; the others are counted."""


def found(sheet: Sheet, detection: Detection, plane: Plane) -> str:
    """Return how many particles are reported attached, in which patches, where, and how stiff."""
    groups = patches(detection.attached, sheet.faces)
    total = int(detection.attached.sum())
    if not groups:
        return "No particle is reported attached."
    flat, (first, second) = plane.flatten(sheet.rest) * 1e3, plane.names
    places = []
    for group in groups[:LISTED_PATCHES]:
        x, y = flat[group].mean(axis=0)
        places.append(f"{len(group)} around {first} = {_integer(x)} mm, {second} = {_integer(y)} mm")
    rest = len(groups) - len(places)
    listed = "; ".join(places) + (f"; and {rest} smaller {'one' if rest == 1 else 'ones'}" if rest > 0 else "")
    verb = "particle is" if total == 1 else "particles are"
    counted = "in one patch" if len(groups) == 1 else f"in {len(groups)} patches"
    stiffness = float(np.mean(detection.stiffness[detection.attached]))
    return f"{total} {verb} reported attached, {counted} ({listed}), at {stiffness:.2g} N/m each on average."


def against_truth(sheet: Sheet, detection: Detection, transferred: TransferredTruth) -> str:
    """Return how many reports are right, and how many of the attached were found, exactly and within one ring."""
    detected, attached = detection.attached, transferred.attached
    n_detected, n_attached = int(detected.sum()), int(attached.sum())
    if not n_attached:
        return "In truth nothing is attached." + (f" All {n_detected} reports are false." if n_detected else "")
    wide, grown = dilate(attached, sheet.faces, 1), dilate(detected, sheet.faces, 1)
    exact, near = int((attached & detected).sum()), int((attached & grown).sum())
    text = f"In truth {n_attached} {'is' if n_attached == 1 else 'are'} attached: "
    text += f"{exact} of them reported exactly, {near} within one mesh ring"
    if n_detected:
        false = int((detected & ~wide).sum())
        verb = "lie" if false > 1 else "lies"
        text += f"; {false or 'none'} of the {n_detected} reports {verb} more than one ring off"
    return text + "."


def stiffness_sums(sheet: Sheet, belief: Belief, detection: Detection, transferred: TransferredTruth) -> str:
    """Return the estimated sum of b, its standard deviation and the true sum, over the attached and one ring around."""
    if not transferred.attached.any() or not np.isfinite(transferred.stiffness).all():
        return ""
    near = dilate(transferred.attached, sheet.faces, 1)
    sd = belief.deviation_of_sum(detection.stiffness, near)
    deviation = f"a standard deviation of {sd:.1f}" if np.isfinite(sd) else "no standard deviation"
    total, true = detection.stiffness[near].sum(), transferred.stiffness[near].sum()
    return f"Over these and one ring around them b sums to {total:.1f} N/m, with {deviation}; the truth is {true:.1f}."


def skipped_frames(figures: Mapping[str, Any]) -> list[str]:
    """Return a line for each reason for which frames were skipped, from `result.json`.

    Reasons that differ in their numbers alone are one.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for skipped in figures["frames"]["skipped"]:
        groups.setdefault(NUMBER.sub("#", skipped["why"]), []).append(skipped)
    lines = []
    for first, *more in groups.values():
        which = f"frame {first['index']} skipped"
        if more:
            count, last = 1 + len(more), more[-1]["index"]
            which = f"{count} of {figures['n_frames']} frames skipped, from frame {first['index']} to {last}"
        lines.append(f"{which}: {first['why']}")
    return lines


def doubts(figures: Mapping[str, Any]) -> list[str]:
    """Return reasons to doubt what was found, from `result.json`; none from a version that did not write them."""
    sentences = []
    noise = figures.get("noise", {})
    if (share := noise.get("cloud_share")) is not None and share < MIN_CLOUD_SHARE:
        sentences.append(
            f"{1 - share:.0%} of the clouds' points lie off the sheet: those of the bed, the tool or a second sheet "
            "bend it where they are near. Crop the clouds to the sheet, and estimate again."
        )
    if not figures["detection"].get("converged", True):
        sentences.append("Two halves of the samples disagree: more samples would give other probabilities.")
    for name, what in (("force_sd_ratio", "The model's forces"), ("position_sd_ratio", "The positions")):
        if (ratio := noise.get(name)) is not None and ratio > MAX_SD_RATIO:
            sentences.append(
                f"{what} are off by {ratio:.1f} times the assumed standard deviation, and got that much less weight."
            )
    points = noise.get("points") or {}
    if points.get("from") == "measured" and (stated := points["stated_sd_m"]) is not None:
        measured = float(np.hypot(points["point_sd_m"], points["smooth_sd_m"]))
        if measured > MAX_NOISE_RATIO * stated:
            sentences.append(
                f"Frames at rest show a noise of {1e3 * measured:.2g} mm where the recording states "
                f"{1e3 * stated:.2g} mm; the larger one counted."
            )
    return [*sentences, *_force_doubts(figures.get("force"))]


def _force_doubts(force: Mapping[str, Any] | None) -> list[str]:
    """Return what the measured force says against itself, the declared stiffness or the model."""
    if force is None:
        return []
    if not force["used"]:
        return [f"The force on the tool is not used: {force['why_not']}"]
    sentences = []
    if (factor := force["stiffness_factor"]) is not None:
        log_sd = force["stiffness_factor_log_sd"]
        if abs(np.log(factor)) > max(SURE_FACTOR * log_sd, np.log(MIN_FACTOR)):
            sentences.append(
                f"By the force on the tool the sheet is {factor:.2f} times as stiff as declared, to {log_sd:.0%}; "
                "every b has that factor. Declare that membrane_stiffness, or see whether the force is right."
            )
    if (nis := force["scaled_nis"]) is not None and nis > MAX_FORCE_NIS:
        sentences.append(
            f"The force on the tool differs from the predicted one by {nis**0.5:.1f} times its standard deviation, at "
            "any stiffness of the sheet: something pulls that the model lacks, or the sensor's offset or axes are off."
        )
    return sentences


def _integer(value: float) -> str:
    return f"{value:+.0f}".replace("-", "\N{MINUS SIGN}").replace("+0", "0").lstrip("+")
