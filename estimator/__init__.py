"""The estimator: perception, the surrogate's physics, and the belief over attachments. Never imports MuJoCo."""

from jiggle_mj.estimator.config import EstimatorConfig
from jiggle_mj.estimator.estimator import Estimator

__all__ = ["Estimator", "EstimatorConfig"]
