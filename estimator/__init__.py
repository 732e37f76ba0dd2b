"""The estimator: perception, the surrogate's physics, and the belief over attachments. Never imports MuJoCo."""

from .config import EstimatorConfig
from .estimator import Estimator

__all__ = ["Estimator", "EstimatorConfig"]
