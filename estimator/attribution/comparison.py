"""Compare effects with each other, and with none: by log Bayes factors and held-out predictions."""

from .held_out import HeldOut
from .hypotheses import (
    MAX_PRIOR_SDS,
    MAX_UNEXPLAINED_GAIN,
    MIN_LOG_BAYES_FACTOR,
    FitContext,
    Hypothesis,
)

MIN_LEAD = 3.0
"""Difference of log Bayes factors by which an effect must at least lead the next one to be named alone [nat]."""
ERROR_EXPONENT = 0.25
"""Power of the held-out error by which log Bayes factors are divided to find the best effect."""
EQUAL_ERROR, CONFUSED_EQUAL_ERROR = 0.8, 0.6
"""Best error over an effect's error from which the two predict equally well; the second if both are often confused."""
EQUAL_EVIDENCE = 0.85
"""Share of the best log Bayes factor from which an effect explains as much."""
REQUIRED_ERROR = 0.97
"""Share of the held-out error without an effect that it must reach with it, unless the effect accounts for the whole
unexplained residual or is certain."""
DECISIVE_ERROR = 0.8
"""Share of the held-out error below which an effect need neither be likely nor beat larger unexplained errors."""
LIKELY_LOG_BAYES_FACTOR = 30.0
"""Log Bayes factor from which an effect is added [nat]. Measured: a mesh that is not the sheet's, and noise that is not
quite as assumed, reached up to 26."""
CERTAIN_UNEXPLAINED_GAIN = 20.0
"""Gain of larger unexplained errors up to which a likely effect is certain [nat]. It must then predict held-out parts
no worse, instead of better, the worst part aside if there are more than two. What acts in one grasp alone cannot be
predicted from the others; and one part with a large error, for attachments that only it would show, outweighs the
rest."""
REFUSED_SHARE = 0.75
"""Share of a refused effect's log Bayes factor below which a less likely effect is not added in its place."""


def best(passed: list[Hypothesis]) -> Hypothesis:
    """Return the hypothesis with the largest log Bayes factor over the fourth root of its held-out error."""
    if not passed[0].folds:
        return max(passed, key=lambda one: one.log_bayes_factor)
    return max(passed, key=lambda one: one.log_bayes_factor / one.held_out_rms**ERROR_EXPONENT)


def behind(one: Hypothesis, best: Hypothesis) -> str:
    """Return why an effect is neither added nor named beside the best."""
    explains_more = one.log_bayes_factor > best.log_bayes_factor
    if best.folds and (explains_more or best.held_out_rms < EQUAL_ERROR * one.held_out_rms):
        errors = f"{1e3 * best.held_out_rms:.2f} mm against {1e3 * one.held_out_rms:.2f} mm"
        return f"{best.effect.name} predicts held-out parts better, to {errors}"
    return f"{best.effect.name} is likelier by {best.log_bayes_factor - one.log_bayes_factor:.0f} nat"


def indistinguishable(one: Hypothesis, best: Hypothesis) -> bool:
    """Return whether an effect explains as much as the best one, and predicts held-out parts about as well.

    Less is required if the two are often confused with each other, or if one explains more and the other predicts
    better. More is required if the effect has more parameters and yet explains less, because any other error of the
    model favours more parameters.
    """
    likelier = best.log_bayes_factor - one.log_bayes_factor
    if not best.folds:
        return likelier < MIN_LEAD
    confused = one.effect.name in best.effect.confounded_with and best.effect.name in one.effect.confounded_with
    if confused or likelier < 0:
        return one.held_out_rms * CONFUSED_EQUAL_ERROR <= best.held_out_rms
    lead = MIN_LEAD if len(one.at) > len(best.at) else max(MIN_LEAD, (1 - EQUAL_EVIDENCE) * best.log_bayes_factor)
    return likelier < lead and one.held_out_rms * EQUAL_ERROR <= best.held_out_rms


def outdone(one: Hypothesis, refused: list[Hypothesis]) -> str | None:
    """Return why an effect is not added, if a far likelier one was refused; None if there is no such one.

    The true cause then resembles the refused effect, of which this one explains a part.
    """
    for other in refused:
        if other.sensible and one.log_bayes_factor < REFUSED_SHARE * other.log_bayes_factor:
            lead = other.log_bayes_factor - one.log_bayes_factor
            return f"{other.effect.name} is likelier by {lead:.0f} nat, and was refused itself"
    return None


def against(best: Hypothesis, context: FitContext, head_start: float = 0.0) -> str | None:
    """Return why an effect is not added; None if it is.

    Args:
        best: the effect.
        context: the fit that it is compared with.
        head_start: log Bayes factor of the fit that the effect is added to, against `context` [nat].
    """
    assert best.unexplained is not None and best.folds is not None
    if not best.sensible:
        return f"its size is beyond {MAX_PRIOR_SDS:g} prior standard deviations"
    before, after = _rms(context.folds), _rms(best.folds)
    likelier = best.log_bayes_factor + head_start + best.unexplained.gain - context.unexplained.gain
    if after > DECISIVE_ERROR * before:
        if best.log_bayes_factor < LIKELY_LOG_BAYES_FACTOR:
            return f"its log Bayes factor is {best.log_bayes_factor:.0f} nat, below {LIKELY_LOG_BAYES_FACTOR:g} nat"
        if likelier < MIN_LOG_BAYES_FACTOR:
            return "larger errors without a named cause explain the frames as well"
    parts = list(zip(context.folds, best.folds, strict=True))
    better = sum(b.rms < a.rms for a, b in parts)
    certain = best.log_bayes_factor >= LIKELY_LOG_BAYES_FACTOR and best.unexplained.gain < CERTAIN_UNEXPLAINED_GAIN
    accounts_for_all = best.unexplained.gain < MAX_UNEXPLAINED_GAIN < context.unexplained.gain
    required = 1.0 if certain or accounts_for_all else REQUIRED_ERROR
    counted = sorted(parts, key=lambda pair: pair[1].rms / pair[0].rms)[: max(len(parts) - 1, 2)] if certain else parts
    worse = _rms([b for _, b in counted]) > required * _rms([a for a, _ in counted])
    if parts and (worse or 2 * better < len(parts)):
        return (
            f"held-out parts are predicted to {1e3 * after:.2f} mm with it and {1e3 * before:.2f} mm without, "
            f"better in {better} of {len(parts)}"
        )
    return None


def _rms(parts: list[HeldOut]) -> float:
    """Return the root mean square error over some parts [m]; 1 without any."""
    return HeldOut.together(parts).rms if parts else 1.0
