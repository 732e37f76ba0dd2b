"""Ranges of settings, which every config of the estimator checks alike, and the largest number of particles."""

from jiggle_mj.errors import PerceptionError

MAX_PARTICLES = 20_000
"""Most particles of a sheet: the belief of more, a square matrix, does not fit a few GB."""


def refuse_many_particles(n: float, cause: str) -> None:
    """Refuse a sheet of more than `MAX_PARTICLES` particles.

    Args:
        n: number of particles, or an estimate of it.
        cause: what gives so many, for the message.

    Raises:
        PerceptionError: there are more.
    """
    if n > MAX_PARTICLES:
        raise PerceptionError(
            f"{cause} gives {n:.3g} particles; at most {MAX_PARTICLES} can be estimated. Is a length in another unit "
            "(baseline, points, EstimatorConfig.spacing), or the spacing too small?"
        )


def check_ranges(config: object, *, positive: tuple[str, ...], shares: tuple[str, ...] = ()) -> None:
    """Check that the named fields of a config are positive, or lie between 0 and 1.

    Raises:
        ValueError: a field is out of its range.
    """
    name = type(config).__name__
    for key in positive:
        if not (value := getattr(config, key)) > 0:
            raise ValueError(f"{name}.{key} must be above 0; got {value}.")
    for key in shares:
        if not 0 <= (value := getattr(config, key)) <= 1:
            raise ValueError(f"{name}.{key} must lie between 0 and 1; got {value}.")
