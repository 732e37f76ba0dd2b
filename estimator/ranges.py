"""Ranges of settings, which every config of the estimator checks alike, and the refusal of too many particles."""

from dataclasses import fields, is_dataclass

from jiggle_mj.argument_checks import as_instance, as_number
from jiggle_mj.errors import OptionError, PerceptionError
from jiggle_mj.observation import MAX_PARTICLES


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
        OptionError: a field is no number, or out of its range.
    """
    name = type(config).__name__
    for key in positive:
        as_number(getattr(config, key), f"{name}.{key}", above=0)
    for key in shares:
        if not 0 <= (value := as_number(getattr(config, key), f"{name}.{key}")) <= 1:
            raise OptionError(f"{name}.{key} must lie between 0 and 1; got {value}.")


def check_parts(config: object) -> None:
    """Check that each nested config of a config is of its own type.

    Raises:
        OptionError: one is not.
    """
    for part in fields(config):  # pyright: ignore[reportArgumentType]
        if isinstance(part.type, type) and is_dataclass(part.type):
            as_instance(getattr(config, part.name), f"{type(config).__name__}.{part.name}", part.type)
