"""Keys of `result.json`, as documented."""

BY_DILATION = {rings: dict.fromkeys(("pcd", "pug", "f1")) for rings in "012"}
KEYS = {
    **dict.fromkeys(("scene", "seed", "sensing", "estimator", "policy", "disturbances", "n_particles", "n_frames")),
    "detection": {
        **dict.fromkeys(("rule", "n_detected", "n_expected", "n_attached", "n_observable")),
        **dict.fromkeys(("average_precision", "converged")),
        "by_dilation": BY_DILATION,
        "observable": {"by_dilation": BY_DILATION},
    },
    "settings": {
        "declaration": {
            name: dict.fromkeys(("value", "from"))
            for name in ("membrane_stiffness", "poisson", "thickness", "areal_density", "gravity", "bed")
        },
        "estimator": {},
    },
    "noise": dict.fromkeys(("force_sd_ratio", "position_sd_ratio", "points", "cloud_share")),
    "force": None,
    "calibration": dict.fromkeys(
        (
            "nees_per_dof",
            "nees_attached",
            "coverage_90",
            "coverage_attached",
            "nees_observable",
            "coverage_observable",
            "ece",
        )
    ),
    "tracking": {"rms_m": None},
    "safety": dict.fromkeys(
        ("limit_j", "max_mean_boundary_energy_j", "violations", "limit_n", "max_force_n", "force_violations")
    ),
    "decisions": None,
    "ended": None,
    "procedure": None,
    "entropy": dict.fromkeys(("prior", "final")),
    "frames": dict.fromkeys(("used", "skipped", "not_converged")),
    "timing": {
        "update_s": dict.fromkeys(("median", "p95")),
        **dict.fromkeys(("perception_s", "plan_s", "simulation_s")),
    },
}
NOISE_OF_POINTS = dict.fromkeys(("from", "point_sd_m", "smooth_sd_m", "smooth_length_m", "stated_sd_m", "still_frames"))
KEYS_OF_POINTS = KEYS | {"noise": KEYS["noise"] | {"points": NOISE_OF_POINTS}}
"""Keys where points were measured; of images `noise.points` is null."""


def keys(value: object) -> object:
    """Return the tree of keys of nested dictionaries."""
    return {name: keys(inner) for name, inner in value.items()} if isinstance(value, dict) else None
