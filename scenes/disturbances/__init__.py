"""The disturbances of a scene, which the estimator is not informed of; `scene/disturbance.py` says how to add one."""
