"""Effects against each other, and against having none: by what they explain, and by what they foretell."""

from .held_out import HeldOut
from .hypotheses import ABSURD, ENTER, REMAINDER, FitContext, Hypothesis

LEAD = 3.0
"""By how much an effect must lead the next to be named alone, whatever the shares [nat]."""
FORETELLING = 0.25
"""Power of the error by which the nats that an effect explains are divided when the best is looked for."""
AS_GOOD, CONFUSED = 0.8, 0.6
"""Shares of its error from which an effect counts as no worse than the best, and one that is often confused with it."""
EXPLAINED = 0.85
"""Share of the best log Bayes factor from which an effect counts as explaining as much."""
BETTER, DECISIVE = 0.97, 0.8
"""Shares of the error over all parts left out that an effect must bring it to, unless it accounts for all that was left
over or is certain, and from which on it need be neither likely nor beat larger errors without a cause."""
LIKELY, LITTLE = 30.0, 20.0
"""Log Bayes factor from which an effect is added [nat]: a mesh that is not the sheet's, and noise that is not quite as
it is taken, were worth up to 26. And what it leaves to larger errors up to which such an effect is certain [nat]: it
need not foretell better then, but no worse, one part aside if there are more than two. What is felt in one grasp alone
cannot be foretold by others, and a part that is missed by far, for attachments that only it would show, outweighs the
rest."""
OUTDONE = 0.75
"""Share of the log Bayes factor of one that is refused up to which a less likely effect is not added in its place."""


def best(passed: list[Hypothesis]) -> Hypothesis:
    """The one with most nats over the fourth root of its error."""
    if not passed[0].folds:
        return max(passed, key=lambda one: one.log_bayes_factor)
    return max(passed, key=lambda one: one.log_bayes_factor / one.residual**FORETELLING)


def behind(one: Hypothesis, best: Hypothesis) -> str:
    """Why an effect is neither added nor named beside the best."""
    explains_more = one.log_bayes_factor > best.log_bayes_factor
    if best.folds and (explains_more or best.residual < AS_GOOD * one.residual):
        return f"{best.effect.name} foretells better, to {1e3 * best.residual:.2f} mm against {1e3 * one.residual:.2f}"
    return f"{best.effect.name} is likelier by {best.log_bayes_factor - one.log_bayes_factor:.0f} nat"


def not_told_from(one: Hypothesis, best: Hypothesis) -> bool:
    """Whether an effect explains as much as the best, and foretells what was left out about as well.

    For two that are often confused with each other it takes less, and where one explains more and the other foretells
    better. It takes more where it has more parameters and yet explains less: whatever else is wrong favours these.
    """
    likelier = best.log_bayes_factor - one.log_bayes_factor
    if not best.folds:
        return likelier < LEAD
    confused = one.effect.name in best.effect.confounded_with and best.effect.name in one.effect.confounded_with
    if confused or likelier < 0:
        return one.residual * CONFUSED <= best.residual
    lead = LEAD if len(one.at) > len(best.at) else max(LEAD, (1 - EXPLAINED) * best.log_bayes_factor)
    return likelier < lead and one.residual * AS_GOOD <= best.residual


def outdone(one: Hypothesis, refused: list[Hypothesis]) -> str | None:
    """Why an effect is not added where a far likelier one was refused; None if there is none such.

    What is wrong is then something like that one, of which this explains a little.
    """
    for other in refused:
        if other.sensible and one.log_bayes_factor < OUTDONE * other.log_bayes_factor:
            lead = other.log_bayes_factor - one.log_bayes_factor
            return f"{other.effect.name} is likelier by {lead:.0f} nat, and refused itself"
    return None


def against(best: Hypothesis, context: FitContext, head_start: float = 0.0) -> str | None:
    """Why an effect is not added; None if it is.

    Against a stage than which the one that it is added to is likelier by `head_start` [nat].
    """
    assert best.left is not None and best.folds is not None
    if not best.sensible:
        return f"its size is beyond {ABSURD:g} prior standard deviations"
    before, after = _residual(context.folds), _residual(best.folds)
    likelier = best.log_bayes_factor + head_start + best.left.gain - context.left.gain
    if after > DECISIVE * before:
        if best.log_bayes_factor < LIKELY:
            return f"it explains {best.log_bayes_factor:.0f} nat, less than the {LIKELY:g} from which one is added"
        if likelier < ENTER:
            return "larger errors without a cause explain the frames as well"
    parts = list(zip(context.folds, best.folds, strict=True))
    better = sum(b.rms < a.rms for a, b in parts)
    certain = best.log_bayes_factor >= LIKELY and best.left.gain < LITTLE
    enough = 1.0 if certain or best.left.gain < REMAINDER < context.left.gain else BETTER
    counted = sorted(parts, key=lambda pair: pair[1].rms / pair[0].rms)[: max(len(parts) - 1, 2)] if certain else parts
    worse = _residual([b for _, b in counted]) > enough * _residual([a for a, _ in counted])
    if parts and (worse or 2 * better < len(parts)):
        return (
            f"parts left out are foretold to {1e3 * after:.2f} mm with it and {1e3 * before:.2f} mm without, "
            f"better in {better} of {len(parts)}"
        )
    return None


def _residual(parts: list[HeldOut]) -> float:
    """Root mean square error over some parts [m]; 1 without any."""
    return HeldOut.together(parts).rms if parts else 1.0
