"""Hypotheses with made-up evidences, for tests that need no fits."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.attribution.fit import Fits
from jiggle_mj.estimator.attribution.hypotheses import AddedEffect, Hypothesis
from jiggle_mj.estimator.attribution.linear import NormalEquations
from jiggle_mj.estimator.attribution.scores import Score
from jiggle_mj.estimator.effects import LIBRARY
from tests.support.small_fit import small_fit

EFFECTS = {effect.name: effect for effect in LIBRARY}


def hypothesis(*names: str, nat: float = 0.0, before: Hypothesis | None = None) -> Hypothesis:
    """Return a hypothesis of some effects, fitted to one frame and reached through those before."""
    before = hypothesis(*names[:-1]) if names and before is None else before
    added = tuple(
        AddedEffect(
            effect=EFFECTS[name],
            score=Score(name=name, log_bayes_factor=nat, site=0, theta=np.zeros(1), p_value=0.0, kept=1.0),
            at=np.arange(1),
        )
        for name in names
    )
    fit = replace(small_fit(), equations={0: NormalEquations(square=jnp.eye(3), tool=jnp.zeros((3, 1)))})
    return Hypothesis(added=added, fits=Fits(fit, fit), log_evidence=nat, before=before)
