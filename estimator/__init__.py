"""The estimator: perception, the surrogate's physics, and the belief over attachments. Never imports MuJoCo."""

from jiggle_mj.estimator.estimator import Estimator, EstimatorConfig

__all__ = ["Estimator", "EstimatorConfig"]
